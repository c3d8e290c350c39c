//! The ground of the map on slopes, under bridges and in gaps.

use approx::assert_relative_eq;

use super::*;
use crate::geometry::pose2_from_pose3;

/// A square of 40 m that climbs along x.
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
fn a_patch_of_a_slope_has_its_height_and_its_normal() {
    let ground = GroundMap::from_mesh(&slope(0.1), |_| true, 0.5);
    let patch = ground.patch_at(3.0, -2.0, 2.0, None).unwrap();
    assert_relative_eq!(patch.height_m, 0.3, epsilon = 1e-3);
    let expected = Vector3::new(-0.1, 0.0, 1.0).normalize();
    assert_relative_eq!(patch.normal, expected, epsilon = 1e-3);
}

#[test]
fn between_cells_the_height_follows_the_slope() {
    let ground = GroundMap::from_mesh(&slope(0.1), |_| true, 0.5);
    for (x, y) in [(0.0, 0.0), (3.13, -2.2), (-7.5, 4.99)] {
        let height_m = ground.height_at(x, y, 0.0).unwrap();
        assert_relative_eq!(height_m, 0.1 * x, epsilon = 1e-3);
    }
    assert_eq!(ground.height_at(20.5, 0.0, 0.0), None);
    assert_eq!(ground.height_at(f64::NAN, 0.0, 0.0), None);
}

#[test]
fn beside_the_map_there_is_no_ground() {
    let ground = GroundMap::from_mesh(&slope(0.0), |_| true, 0.5);
    assert_eq!(ground.patch_at(25.0, 0.0, 2.0, None), None);
    let nothing = GroundMap::from_mesh(&TriangleMesh::default(), |_| true, 0.5);
    assert_eq!(nothing.patch_at(0.0, 0.0, 2.0, None), None);
    assert_eq!(nothing.levels_at(0.0, 0.0), []);
}

/// Two squares above one another, the upper one climbing from the lower by a ramp.
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
fn who_drives_up_a_ramp_stays_above_and_who_drives_below_stays_below() {
    let ground = GroundMap::from_mesh(&bridge(), |_| true, 0.5);
    let mut above_m = 0.0;
    for step in 0..170 {
        let x = -70.0 + 0.5 * f64::from(step);
        let expected_m = (0.1 * (x + 70.0)).min(6.0);
        let pose = Pose2::translation(x, 0.3);
        above_m = ground.patch_under(&pose, Some(above_m)).unwrap().height_m;
        // Where the ramp ends, the patch rounds the edge.
        assert_relative_eq!(above_m, expected_m, epsilon = 0.1);
    }
    let mut below_m = 0.0;
    for step in 0..70 {
        let pose = Pose2::translation(0.0, -17.0 + 0.5 * f64::from(step));
        below_m = ground.patch_under(&pose, Some(below_m)).unwrap().height_m;
        assert_relative_eq!(below_m, 0.0, epsilon = 1e-6);
    }
    let levels = ground.levels_at(0.0, 0.0);
    let heights: Vec<f64> = levels.iter().map(|patch| patch.height_m).collect();
    assert_relative_eq!(heights[..], [0.0, 6.0][..], epsilon = 1e-6);
    assert_eq!(ground.levels_at(0.0, 12.0).len(), 1);
}

#[test]
fn a_height_that_was_told_wrong_leads_to_the_nearest_ground_that_there_is() {
    let ground = GroundMap::from_mesh(&bridge(), |_| true, 0.5);
    let height_m = |level_m: Option<f64>| {
        let patch = ground.patch_under(&Pose2::identity(), level_m);
        patch.unwrap().height_m
    };
    assert_relative_eq!(height_m(Some(30.0)), 6.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(Some(4.0)), 6.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(Some(-9.0)), 0.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(None), 0.0, epsilon = 1e-6);
}

/// One small triangle in each half-metre cell within 8 m, as high as is told of its middle.
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
fn a_single_cell_above_or_below_the_ground_takes_no_place_away() {
    let is_stray = |x: f32, y: f32| (x, y) == (0.25, 0.25);
    for stray_m in [-3.0, 3.0] {
        let mesh = mosaic(|x, y| Some(if is_stray(x, y) { stray_m } else { 0.0 }));
        let ground = GroundMap::from_mesh(&mesh, |_| true, 0.5);
        for (x, y) in [(0.25, 0.25), (0.8, 0.25), (-1.0, 0.5)] {
            for level_m in [None, Some(0.0), Some(3.0 * f64::from(stray_m))] {
                let patch = ground.patch_at(x, y, RADIUS_M, level_m).unwrap();
                assert_relative_eq!(patch.height_m, 0.0, epsilon = 1e-6);
            }
            let levels = ground.levels_at(x, y);
            assert_eq!(levels.len(), 1);
            assert_relative_eq!(levels[0].height_m, 0.0, epsilon = 1e-6);
        }
    }
}

/// A deck up to y = 4 m, and a road below that is known from some y on.
fn deck_over_road(known_from_m: f32) -> GroundMap {
    let mut mesh = mosaic(|_, y| (y < 4.0).then_some(6.0));
    mesh.append(&mosaic(|_, y| (y > known_from_m).then_some(0.0)));
    GroundMap::from_mesh(&mesh, |_| true, 0.5)
}

#[test]
fn at_the_edge_of_a_bridge_a_strip_of_the_road_below_hides_the_deck_from_nobody() {
    let ground = deck_over_road(2.0);
    let height_m = |y: f64, level_m: Option<f64>| {
        let patch = ground.patch_at(0.0, y, RADIUS_M, level_m);
        patch.map(|patch| patch.height_m)
    };
    // A fifth of the cells around know the road; the deck is all around.
    assert_relative_eq!(height_m(1.0, None).unwrap(), 6.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(1.0, Some(-9.0)).unwrap(), 6.0, epsilon = 1e-6);
    assert_relative_eq!(height_m(3.0, None).unwrap(), 0.0, epsilon = 1e-6);
    // Who is on the deck does not fall where only its rim is near.
    assert_eq!(height_m(5.0, Some(6.0)), None);
    assert_relative_eq!(height_m(5.0, Some(9.0)).unwrap(), 0.0, epsilon = 1e-6);
}

#[test]
fn at_the_edge_of_a_bridge_a_place_has_the_levels_of_its_own_cell() {
    let ground = deck_over_road(4.0);
    let levels_m = |y: f64| {
        let levels = ground.levels_at(0.0, y);
        levels
            .iter()
            .map(|patch| patch.height_m)
            .collect::<Vec<_>>()
    };
    // Either side of the edge, well over a third of the cells around are of the other level.
    assert_relative_eq!(levels_m(3.8)[..], [6.0][..], epsilon = 1e-6);
    assert_relative_eq!(levels_m(4.2)[..], [0.0][..], epsilon = 1e-6);
}

#[test]
fn on_level_ground_the_lifted_pose_is_the_stance_at_the_planar_pose() {
    let ground = GroundMap::flat(Point2::new(-10.0, -10.0), Point2::new(10.0, 10.0), -1.73);
    let pose = Pose2::new(Vector2::new(1.0, 2.0), 2.5);
    let lifted = ground.lift(&pose, &SensorAttitude::default()).unwrap();
    assert_relative_eq!(pose2_from_pose3(&lifted), pose, epsilon = 1e-9);
    assert_relative_eq!(lifted.translation.z, 0.0, epsilon = 1e-6);
}

#[test]
fn a_lifted_pose_casts_its_planar_pose_as_shadow_on_every_slope() {
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
        let shadow = pose2_from_pose3(&patch.lift(&pose, &attitude));
        assert_relative_eq!(shadow, pose, epsilon = 1e-12);
    }
}

#[test]
fn the_stance_is_found_from_returns_off_a_slope_among_others_that_are_not_off_it() {
    let ground = GroundMap::from_mesh(&slope(0.06), |_| true, 0.5);
    let pose = Pose2::new(Vector2::new(1.0, 2.0), 0.6);
    let truth = SensorAttitude {
        height_m: 1.65,
        roll_rad: 0.015,
        pitch_rad: -0.02,
    };
    let lidar_from_map = ground.lift(&pose, &truth).unwrap().inverse();
    let points: Vec<Vec3> = (0..900)
        .map(|i| {
            let (x, y) = (f64::from(i % 30) - 14.0, f64::from(i / 30) - 14.0);
            let above = if i % 4 == 0 { 0.5 } else { 0.0 };
            let point = lidar_from_map * nalgebra::Point3::new(x, y, 0.06 * x + above);
            Vec3::new(point.x as f32, point.y as f32, point.z as f32)
        })
        .collect();
    let start = SensorAttitude::default();
    let found = ground.attitude_at(&pose, None, &start, &points).unwrap();
    assert_relative_eq!(found.height_m, truth.height_m, epsilon = 5e-3);
    assert_relative_eq!(found.roll_rad, truth.roll_rad, epsilon = 5e-4);
    assert_relative_eq!(found.pitch_rad, truth.pitch_rad, epsilon = 5e-4);
    assert_eq!(ground.attitude_at(&pose, None, &start, &points[..40]), None);
}

#[test]
fn uphill_the_nose_points_up_and_downhill_down() {
    let ground = GroundMap::from_mesh(&slope(0.1), |_| true, 0.5);
    for (heading, sign) in [(0.0, 1.0), (std::f64::consts::PI, -1.0)] {
        let pose = Pose2::new(Vector2::new(0.0, 0.0), heading);
        let lifted = ground.lift(&pose, &SensorAttitude::default()).unwrap();
        let nose = lifted.rotation * Vector3::x();
        assert_relative_eq!(nose.z, sign * 0.1_f64.atan().sin(), epsilon = 1e-3);
    }
}

#[test]
fn a_stance_from_the_plane_that_it_makes_is_itself() {
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
