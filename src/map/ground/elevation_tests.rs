//! Elevation maps of slopes, bridges and maps with gaps.

use approx::assert_relative_eq;

use super::*;
use crate::geometry::TriangleMesh;
use crate::geometry::pose2_from_pose3;

impl GroundMap {
    /// Builds the elevation map of the triangles for which `is_ground` holds, in cells of `cell_m`.
    pub(crate) fn from_mesh(
        mesh: &TriangleMesh,
        is_ground: impl Fn(usize) -> bool,
        cell_m: f64,
    ) -> Self {
        let ground = (0..mesh.triangles.len()).filter(|&triangle| is_ground(triangle));
        Self {
            heights: Heights::of_triangles(
                ground.map(|triangle| mesh.corners(triangle).map(|corner| corner.as_dvec3())),
                cell_m,
            ),
        }
    }

    /// Flat ground in a rectangle.
    pub(crate) fn flat(min: Point2<f64>, max: Point2<f64>, height_m: f64) -> Self {
        Self {
            heights: Heights::flat(min, max, height_m, 1.0),
        }
    }
}

/// A square of 40 m with a slope along x.
fn slope(grade: f32) -> TriangleMesh {
    let at = |x: f32, y: f32| Vec3::new(x, y, grade * x);
    TriangleMesh {
        vertices: vec![
            at(-20.0, -20.0),
            at(20.0, -20.0),
            at(20.0, 20.0),
            at(-20.0, 20.0),
        ],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..TriangleMesh::default()
    }
}

#[test]
fn a_patch_of_a_slope_has_the_height_and_normal_of_the_slope() {
    let ground = GroundMap::from_mesh(&slope(0.1), |_| true, 0.5);
    let patch = ground.patch_at(3.0, -2.0, 2.0, None).unwrap().unwrap();
    assert_relative_eq!(patch.height_m, 0.3, epsilon = 1e-3);
    let expected = Vector3::new(-0.1, 0.0, 1.0).normalize();
    assert_relative_eq!(patch.normal, expected, epsilon = 1e-3);
}

fn height_at(ground: &GroundMap, x: f64, y: f64) -> Option<f64> {
    ground
        .height_at(&mut ground.heights.reader(), x, y, 0.0)
        .unwrap()
}

#[test]
fn heights_are_interpolated_between_cells() {
    let ground = GroundMap::from_mesh(&slope(0.1), |_| true, 0.5);
    for (x, y) in [(0.0, 0.0), (3.13, -2.2), (-7.5, 4.99)] {
        let height_m = height_at(&ground, x, y).unwrap();
        assert_relative_eq!(height_m, 0.1 * x, epsilon = 1e-3);
    }
    assert_eq!(height_at(&ground, 20.5, 0.0), None);
    assert_eq!(height_at(&ground, f64::NAN, 0.0), None);
}

#[test]
fn outside_the_map_there_is_no_ground() {
    let ground = GroundMap::from_mesh(&slope(0.0), |_| true, 0.5);
    assert_eq!(ground.patch_at(25.0, 0.0, 2.0, None).unwrap(), None);
    let nothing = GroundMap::from_mesh(&TriangleMesh::default(), |_| true, 0.5);
    assert_eq!(nothing.patch_at(0.0, 0.0, 2.0, None).unwrap(), None);
    assert_eq!(nothing.levels_at(0.0, 0.0).unwrap(), []);
}

/// A square with a deck above it, connected by a ramp.
fn bridge() -> TriangleMesh {
    let mut mesh = slope(0.0);
    let deck = |x0: f32, z0: f32, x1: f32, z1: f32| TriangleMesh {
        vertices: vec![
            Vec3::new(x0, -4.0, z0),
            Vec3::new(x1, -4.0, z1),
            Vec3::new(x1, 4.0, z1),
            Vec3::new(x0, 4.0, z0),
        ],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..TriangleMesh::default()
    };
    mesh.append(&deck(-70.0, 0.0, -10.0, 6.0));
    mesh.append(&deck(-10.0, 6.0, 15.0, 6.0));
    mesh
}

#[test]
fn a_car_stays_on_its_level_up_a_ramp_and_under_a_bridge() {
    let ground = GroundMap::from_mesh(&bridge(), |_| true, 0.5);
    let mut above_m = 0.0;
    for step in 0..170 {
        let x = -70.0 + 0.5 * f64::from(step);
        let expected_m = (0.1 * (x + 70.0)).min(6.0);
        let pose = Pose2::translation(x, 0.3);
        above_m = ground
            .patch_under(&pose, Some(above_m))
            .unwrap()
            .unwrap()
            .height_m;
        // Where the ramp ends, the patch rounds the edge.
        assert_relative_eq!(above_m, expected_m, epsilon = 0.1);
    }
    let mut below_m = 0.0;
    for step in 0..70 {
        let pose = Pose2::translation(0.0, -17.0 + 0.5 * f64::from(step));
        below_m = ground
            .patch_under(&pose, Some(below_m))
            .unwrap()
            .unwrap()
            .height_m;
        assert_relative_eq!(below_m, 0.0, epsilon = 1e-6);
    }
    let levels = ground.levels_at(0.0, 0.0).unwrap();
    let heights: Vec<f64> = levels.iter().map(|patch| patch.height_m).collect();
    assert_relative_eq!(heights[..], [0.0, 6.0][..], epsilon = 1e-6);
    assert_eq!(ground.levels_at(0.0, 12.0).unwrap().len(), 1);
}

#[test]
fn a_wrong_level_height_selects_the_nearest_level() {
    let ground = GroundMap::from_mesh(&bridge(), |_| true, 0.5);
    let height_m = |level_m: Option<f64>| {
        let patch = ground.patch_under(&Pose2::identity(), level_m).unwrap();
        patch.unwrap().height_m
    };
    assert_relative_eq!(height_m(Some(30.0)), 6.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(Some(4.0)), 6.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(Some(-9.0)), 0.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(None), 0.0, epsilon = 1e-6);
}

/// One small triangle in each half-metre cell within 8 m, with the height at its centre.
fn mosaic(height_m: impl Fn(f32, f32) -> Option<f32>) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for (column, row) in (-16..16).flat_map(|column| (-16..16).map(move |row| (column, row))) {
        let (x, y) = (0.5 * column as f32, 0.5 * row as f32);
        let Some(z) = height_m(x + 0.25, y + 0.25) else {
            continue;
        };
        mesh.append(&TriangleMesh {
            vertices: vec![
                Vec3::new(x + 0.1, y + 0.1, z),
                Vec3::new(x + 0.3, y + 0.1, z),
                Vec3::new(x + 0.1, y + 0.3, z),
            ],
            triangles: vec![[0, 1, 2]],
            ..TriangleMesh::default()
        });
    }
    mesh
}

#[test]
fn an_outlier_cell_above_or_below_the_ground_does_not_change_the_patch() {
    let is_outlier = |x: f32, y: f32| (x, y) == (0.25, 0.25);
    for outlier_m in [-3.0, 3.0] {
        let mesh = mosaic(|x, y| Some(if is_outlier(x, y) { outlier_m } else { 0.0 }));
        let ground = GroundMap::from_mesh(&mesh, |_| true, 0.5);
        for (x, y) in [(0.25, 0.25), (0.8, 0.25), (-1.0, 0.5)] {
            for level_m in [None, Some(0.0), Some(3.0 * f64::from(outlier_m))] {
                let patch = ground.patch_at(x, y, RADIUS_M, level_m).unwrap().unwrap();
                assert_relative_eq!(patch.height_m, 0.0, epsilon = 1e-6);
            }
            let levels = ground.levels_at(x, y).unwrap();
            assert_eq!(levels.len(), 1);
            assert_relative_eq!(levels[0].height_m, 0.0, epsilon = 1e-6);
        }
    }
}

/// A deck up to y = 4 m, and a road below it that is mapped from some y on.
fn deck_over_road(mapped_from_m: f32) -> GroundMap {
    let mut mesh = mosaic(|_, y| (y < 4.0).then_some(6.0));
    mesh.append(&mosaic(|_, y| (y > mapped_from_m).then_some(0.0)));
    GroundMap::from_mesh(&mesh, |_| true, 0.5)
}

#[test]
fn at_the_edge_of_a_bridge_a_strip_of_the_road_below_does_not_hide_the_deck() {
    let ground = deck_over_road(2.0);
    let height_m = |y: f64, level_m: Option<f64>| {
        let patch = ground.patch_at(0.0, y, RADIUS_M, level_m).unwrap();
        patch.map(|patch| patch.height_m)
    };
    // A fifth of the cells around contain the road, all of them the deck.
    assert_relative_eq!(height_m(1.0, None).unwrap(), 6.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(1.0, Some(-9.0)).unwrap(), 6.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(3.0, None).unwrap(), 0.0, epsilon = 1e-6);
    // A car on the deck does not drop to the road where only the edge of the deck is near.
    assert_eq!(height_m(5.0, Some(6.0)), None);
    assert_relative_eq!(height_m(5.0, Some(9.0)).unwrap(), 0.0, epsilon = 1e-6);
}

#[test]
fn at_the_edge_of_a_bridge_a_position_has_the_levels_of_its_own_cell() {
    let ground = deck_over_road(4.0);
    let levels_m = |y: f64| {
        let levels = ground.levels_at(0.0, y).unwrap();
        levels
            .iter()
            .map(|patch| patch.height_m)
            .collect::<Vec<_>>()
    };
    // On both sides of the edge, more than a third of the cells around are of the other level.
    assert_relative_eq!(levels_m(3.8)[..], [6.0][..], epsilon = 1e-6);
    assert_relative_eq!(levels_m(4.2)[..], [0.0][..], epsilon = 1e-6);
}

#[test]
fn on_level_ground_a_lifted_pose_has_the_sensor_height_at_the_planar_pose() {
    let ground = GroundMap::flat(Point2::new(-10.0, -10.0), Point2::new(10.0, 10.0), -1.73);
    let pose = Pose2::new(Vector2::new(1.0, 2.0), 2.5);
    let lifted = ground
        .lift(&pose, &SensorAttitude::default())
        .unwrap()
        .unwrap();
    assert_relative_eq!(pose2_from_pose3(&lifted), pose, epsilon = 1e-9);
    assert_relative_eq!(lifted.translation.z, 0.0, epsilon = 1e-6);
}

#[test]
fn a_lifted_pose_projects_to_its_planar_pose_on_every_slope() {
    let patch = GroundPatch {
        height_m: 4.0,
        normal: Vector3::new(-0.1, 0.08, 1.0).normalize(),
    };
    let attitude = SensorAttitude {
        height_m: 1.7,
        roll_rad: 0.04,
        pitch_rad: -0.05,
    };
    for heading in [-3.0, -1.0, 0.0, 0.7, 2.5] {
        let pose = Pose2::new(Vector2::new(1.0, 2.0), heading);
        let projected = pose2_from_pose3(&patch.lift(&pose, &attitude));
        assert_relative_eq!(projected, pose, epsilon = 1e-12);
    }
}

#[test]
fn a_shifted_patch_is_the_same_plane() {
    let normal = Vector3::new(-0.2, 0.1, 1.0).normalize();
    let patch = GroundPatch {
        height_m: 2.0,
        normal,
    };
    let shift = Vector2::new(3.0, -5.0);
    let shifted = patch.shifted(&shift);
    let along = shift.push(shifted.height_m - patch.height_m);
    assert_relative_eq!(normal.dot(&along), 0.0, epsilon = 1e-12);
    assert_eq!(shifted.normal, normal);
}

#[test]
fn the_attitude_is_estimated_from_returns_of_a_slope_with_outliers() {
    let ground = GroundMap::from_mesh(&slope(0.06), |_| true, 0.5);
    let pose = Pose2::new(Vector2::new(1.0, 2.0), 0.6);
    let truth = SensorAttitude {
        height_m: 1.65,
        roll_rad: 0.015,
        pitch_rad: -0.02,
    };
    let lidar_from_map = ground.lift(&pose, &truth).unwrap().unwrap().inverse();
    let points: Vec<Vec3> = (0..900)
        .map(|i| {
            let (x, y) = (f64::from(i % 30) - 14.0, f64::from(i / 30) - 14.0);
            let above = if i % 4 == 0 { 0.5 } else { 0.0 };
            let point = lidar_from_map * nalgebra::Point3::new(x, y, 0.06 * x + above);
            Vec3::new(point.x as f32, point.y as f32, point.z as f32)
        })
        .collect();
    let start = SensorAttitude::default();
    let found = ground
        .attitude_at(&pose, None, &start, &points)
        .unwrap()
        .unwrap();
    assert_relative_eq!(found.height_m, truth.height_m, epsilon = 5e-3);
    assert_relative_eq!(found.roll_rad, truth.roll_rad, epsilon = 5e-4);
    assert_relative_eq!(found.pitch_rad, truth.pitch_rad, epsilon = 5e-4);
    assert_eq!(
        ground
            .attitude_at(&pose, None, &start, &points[..40])
            .unwrap(),
        None
    );
}

#[test]
fn the_pitch_follows_the_slope_uphill_and_downhill() {
    let ground = GroundMap::from_mesh(&slope(0.1), |_| true, 0.5);
    for (heading, sign) in [(0.0, 1.0), (std::f64::consts::PI, -1.0)] {
        let pose = Pose2::new(Vector2::new(0.0, 0.0), heading);
        let lifted = ground
            .lift(&pose, &SensorAttitude::default())
            .unwrap()
            .unwrap();
        let forward = lifted.rotation * Vector3::x();
        assert_relative_eq!(forward.z, sign * 0.1_f64.atan().sin(), epsilon = 1e-3);
    }
}

#[test]
fn the_attitude_from_its_own_plane_is_the_same() {
    let attitude = SensorAttitude {
        height_m: 1.7,
        roll_rad: 0.03,
        pitch_rad: -0.02,
    };
    let up = attitude.road_from_lidar().rotation.inverse() * Vector3::z();
    let up = Vec3::new(up.x as f32, up.y as f32, up.z as f32);
    let back = SensorAttitude::from_plane(up, 1.7);
    assert_relative_eq!(back.roll_rad, attitude.roll_rad, epsilon = 1e-6);
    assert_relative_eq!(back.pitch_rad, attitude.pitch_rad, epsilon = 1e-6);
}
