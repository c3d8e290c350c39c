//! The ground of the map: how high the road is and how it leans, and with it where in space a
//! pose in the plane is.
//!
//! ```text
//! map_from_lidar = map_from_road(x, y, heading) · road_from_lidar
//! ```
//!
//! The road frame lies on the mapped ground under the sensor, z along the ground's normal, x
//! forward. How the sensor stands over it (height, roll, pitch) is the car's own affair and
//! comes from the scan: from the plane of its road, or, where the place is known, better from the
//! distances of its returns to the mapped ground ([`GroundMap::stance_at`]).

use glam::Vec3;
use nalgebra::{Matrix3, Point2, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::heights::Heights;
use crate::geometry::{Pose2, Pose3, TriangleMesh};

/// How the sensor stands over the road: height, roll and pitch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stance {
    /// Height of the sensor over the road, along the road's normal [m].
    pub height_m: f64,
    /// About the forward axis [rad].
    pub roll_rad: f64,
    /// About the left axis; positive looks down [rad].
    pub pitch_rad: f64,
}

impl Default for Stance {
    /// KITTI's car on a level road.
    fn default() -> Self {
        Self {
            height_m: 1.73,
            roll_rad: 0.0,
            pitch_rad: 0.0,
        }
    }
}

impl Stance {
    /// `p_road = road_from_lidar * p_lidar`.
    pub fn road_from_lidar(&self) -> Pose3 {
        Pose3::from_parts(
            Translation3::new(0.0, 0.0, self.height_m),
            UnitQuaternion::from_euler_angles(self.roll_rad, self.pitch_rad, 0.0),
        )
    }

    /// From the road's plane as the sensor sees it: unit normal (up) and distance of the sensor
    /// over the plane [m].
    pub fn from_plane(up_in_lidar: Vec3, height_m: f64) -> Self {
        let up: Vector3<f64> = Vector3::new(up_in_lidar.x, up_in_lidar.y, up_in_lidar.z).cast();
        // up = Rx(roll)ᵀ Ry(pitch)ᵀ z  (no yaw)  =  (-sin p, cos p sin r, cos p cos r)
        Self {
            height_m,
            roll_rad: up.y.atan2(up.z),
            pitch_rad: (-up.x).asin(),
        }
    }
}

/// The ground at one place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundPatch {
    /// Height in the map frame [m].
    pub height_m: f64,
    /// Unit normal, up.
    pub normal: Vector3<f64>,
}

/// Height of the ground on a grid over the map.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundMap {
    heights: Heights,
}

impl GroundMap {
    /// From the triangles for which `is_ground` holds, in cells of `cell_m`.
    pub fn from_mesh(mesh: &TriangleMesh, is_ground: impl Fn(usize) -> bool, cell_m: f64) -> Self {
        let ground = (0..mesh.triangles.len()).filter(|&triangle| is_ground(triangle));
        Self {
            heights: Heights::of_triangles(ground.map(|triangle| mesh.corners(triangle)), cell_m),
        }
    }

    /// Flat ground everywhere in a rectangle, for tests and for maps whose ground is not marked.
    pub fn flat(min: Point2<f64>, max: Point2<f64>, height_m: f64) -> Self {
        Self {
            heights: Heights::flat(min, max, height_m, 1.0),
        }
    }

    /// The ground at a place: a plane fitted to the known cells within `radius_m`; `None` where
    /// fewer than a third of them are known.
    pub fn patch_at(&self, x: f64, y: f64, radius_m: f64) -> Option<GroundPatch> {
        let (column, row) = self.heights.cell_at(x, y)?;
        let reach = (radius_m / self.heights.cell_m).ceil() as i64;
        let mut heights = self.heights.reader();
        let mut normal_matrix = Matrix3::zeros();
        let mut right_side = Vector3::zeros();
        let (mut known, mut all) = (0, 0);
        for row in row - reach..=row + reach {
            for column in column - reach..=column + reach {
                let center = self.heights.center((column, row));
                let offset = Vector3::new(center.x - x, center.y - y, 1.0);
                if offset.xy().norm() > radius_m {
                    continue;
                }
                all += 1;
                let height_m = heights.height_m((column, row));
                if height_m.is_finite() {
                    known += 1;
                    normal_matrix += offset * offset.transpose();
                    right_side += offset * height_m;
                }
            }
        }
        if known < 3 || 3 * known < all {
            return None;
        }
        let plane = normal_matrix.cholesky()?.solve(&right_side);
        Some(GroundPatch {
            height_m: plane.z,
            normal: Vector3::new(-plane.x, -plane.y, 1.0).normalize(),
        })
    }

    /// Where in space a planar pose is, standing on the ground as `stance` says; `None` where
    /// there is no ground. `map_from_lidar = map_from_road · road_from_lidar`, with the sensor at the
    /// pose's x and y.
    pub fn lift(&self, planar: &Pose2, stance: &Stance) -> Option<Pose3> {
        Some(self.patch_under(planar)?.lift(planar, stance))
    }

    /// Height of the ground at a place, between the middles of the four cells around it [m];
    /// `None` where one of them is not known.
    pub fn height_at(&self, x: f64, y: f64) -> Option<f64> {
        let cell_m = self.heights.cell_m;
        let (column, row) = self.heights.cell_at(x - 0.5 * cell_m, y - 0.5 * cell_m)?;
        let center = self.heights.center((column, row));
        let (right, up) = ((x - center.x) / cell_m, (y - center.y) / cell_m);
        let mut heights = self.heights.reader();
        let mut between = |row: i64| {
            (1.0 - right) * heights.height_m((column, row))
                + right * heights.height_m((column + 1, row))
        };
        let height_m = (1.0 - up) * between(row) + up * between(row + 1);
        // What is not known is not a number, and so is every sum with it.
        height_m.is_finite().then_some(height_m)
    }

    /// How the sensor stands over the road at a planar pose: the stance with which the returns
    /// from the road (`points`, lidar frame; others among them do no harm) lie on the mapped
    /// ground. Robust least squares from `start`; `None` where too few returns meet known ground.
    ///
    /// The plane of the road that a scan sees and the patch of the map under the car are fitted to
    /// different stretches of a road that is not flat; this asks one surface only.
    pub fn stance_at(&self, planar: &Pose2, start: &Stance, points: &[Vec3]) -> Option<Stance> {
        /// What lies farther off the ground than this is none of it, from blunt to sharp [m].
        const GATES_M: [f64; 4] = [0.4, 0.2, 0.1, 0.1];
        /// Fewer returns on the ground than this do not tell.
        const ENOUGH: usize = 50;
        let patch = self.patch_under(planar)?;
        let mut stance = *start;
        for gate_m in GATES_M {
            let map_from_lidar = patch.lift(planar, &stance);
            let mut normal_matrix = Matrix3::zeros();
            let mut right_side = Vector3::zeros();
            let mut used = 0;
            for point in points {
                let in_lidar = nalgebra::Point3::new(point.x, point.y, point.z).cast::<f64>();
                let in_map = map_from_lidar * in_lidar;
                let Some(ground_m) = self.height_at(in_map.x, in_map.y) else {
                    continue;
                };
                let above_m = in_map.z - ground_m;
                if above_m.abs() > gate_m {
                    continue;
                }
                // Slopes of the height of the point: by the height of the sensor, roll and pitch.
                let slopes = Vector3::new(1.0, in_lidar.y, -in_lidar.x);
                let weight = (1.0 - (above_m / gate_m).powi(2)).powi(2);
                normal_matrix += weight * slopes * slopes.transpose();
                right_side -= weight * above_m * slopes;
                used += 1;
            }
            if used < ENOUGH {
                return None;
            }
            let step = normal_matrix.cholesky()?.solve(&right_side);
            stance.height_m += step.x;
            stance.roll_rad += step.y;
            stance.pitch_rad += step.z;
        }
        Some(stance)
    }

    /// The ground that a car at a planar pose stands on; `None` where there is none.
    pub fn patch_under(&self, planar: &Pose2) -> Option<GroundPatch> {
        /// About the wheelbase and track of a car.
        const RADIUS_M: f64 = 2.0;
        let t = planar.translation.vector;
        self.patch_at(t.x, t.y, RADIUS_M)
    }
}

impl GroundPatch {
    /// Where in space a planar pose is, standing on the plane of this patch as `stance` says.
    /// [`planar`](crate::geometry::planar) gives the planar pose back, on every slope.
    pub fn lift(&self, planar: &Pose2, stance: &Stance) -> Pose3 {
        let t = planar.translation.vector;
        let heading = planar.rotation.angle();
        let up = self.normal;
        let forward = Vector3::new(heading.cos(), heading.sin(), 0.0);
        let left = up.cross(&forward).normalize();
        let rotation =
            Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[left.cross(&up), left, up]));
        let map_from_road = UnitQuaternion::from_rotation_matrix(&rotation);
        let tilted = map_from_road
            * UnitQuaternion::from_euler_angles(stance.roll_rad, stance.pitch_rad, 0.0);
        // Leaning on a slope turns the nose a little; the heading is the one that was asked for.
        let nose = tilted * Vector3::x();
        let turn_rad = heading - nose.y.atan2(nose.x);
        // The road plane passes through the patch; the sensor hangs `height_m` along its normal over it.
        let height_m = self.height_m + stance.height_m / up.z;
        Pose3::from_parts(
            Translation3::new(t.x, t.y, height_m),
            UnitQuaternion::from_euler_angles(0.0, 0.0, turn_rad) * tilted,
        )
    }

    /// How a sensor at a pose in space stands over the plane of this patch; [`lift`](Self::lift) of
    /// the same pose seen from above undoes it, but for the turn of the nose on a slope.
    pub fn stance_of(&self, map_from_lidar: &Pose3) -> Stance {
        let up = map_from_lidar.rotation.inverse() * self.normal;
        let above_m = map_from_lidar.translation.z - self.height_m;
        Stance::from_plane(
            Vec3::new(up.x as f32, up.y as f32, up.z as f32),
            above_m * self.normal.z,
        )
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector2;

    use super::*;
    use crate::geometry::planar;

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
        let patch = ground.patch_at(3.0, -2.0, 2.0).unwrap();
        assert_relative_eq!(patch.height_m, 0.3, epsilon = 1e-3);
        let expected = Vector3::new(-0.1, 0.0, 1.0).normalize();
        assert_relative_eq!(patch.normal, expected, epsilon = 1e-3);
    }

    #[test]
    fn between_cells_the_height_follows_the_slope() {
        let ground = GroundMap::from_mesh(&slope(0.1), |_| true, 0.5);
        for (x, y) in [(0.0, 0.0), (3.13, -2.2), (-7.5, 4.99)] {
            assert_relative_eq!(ground.height_at(x, y).unwrap(), 0.1 * x, epsilon = 1e-3);
        }
        assert_eq!(ground.height_at(20.5, 0.0), None);
        assert_eq!(ground.height_at(f64::NAN, 0.0), None);
    }

    #[test]
    fn beside_the_map_there_is_no_ground() {
        let ground = GroundMap::from_mesh(&slope(0.0), |_| true, 0.5);
        assert_eq!(ground.patch_at(25.0, 0.0, 2.0), None);
        let nothing = GroundMap::from_mesh(&TriangleMesh::default(), |_| true, 0.5);
        assert_eq!(nothing.patch_at(0.0, 0.0, 2.0), None);
    }

    #[test]
    fn on_level_ground_the_lifted_pose_is_the_stance_at_the_planar_pose() {
        let ground = GroundMap::flat(Point2::new(-10.0, -10.0), Point2::new(10.0, 10.0), -1.73);
        let pose = Pose2::new(Vector2::new(1.0, 2.0), 2.5);
        let lifted = ground.lift(&pose, &Stance::default()).unwrap();
        assert_relative_eq!(planar(&lifted), pose, epsilon = 1e-9);
        assert_relative_eq!(lifted.translation.z, 0.0, epsilon = 1e-6);
    }

    #[test]
    fn a_lifted_pose_casts_its_planar_pose_as_shadow_on_every_slope() {
        let patch = GroundPatch {
            height_m: 4.0,
            normal: Vector3::new(-0.1, 0.08, 1.0).normalize(),
        };
        let stance = Stance {
            height_m: 1.7,
            roll_rad: 0.04,
            pitch_rad: -0.05,
        };
        for heading in [-3.0, -1.0, 0.0, 0.7, 2.5] {
            let pose = Pose2::new(Vector2::new(1.0, 2.0), heading);
            let shadow = planar(&patch.lift(&pose, &stance));
            assert_relative_eq!(shadow, pose, epsilon = 1e-12);
        }
    }

    #[test]
    fn the_stance_is_found_from_returns_off_a_slope_among_others_that_are_not_off_it() {
        let ground = GroundMap::from_mesh(&slope(0.06), |_| true, 0.5);
        let pose = Pose2::new(Vector2::new(1.0, 2.0), 0.6);
        let truth = Stance {
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
        let start = Stance::default();
        let found = ground.stance_at(&pose, &start, &points).unwrap();
        assert_relative_eq!(found.height_m, truth.height_m, epsilon = 5e-3);
        assert_relative_eq!(found.roll_rad, truth.roll_rad, epsilon = 5e-4);
        assert_relative_eq!(found.pitch_rad, truth.pitch_rad, epsilon = 5e-4);
        assert_eq!(ground.stance_at(&pose, &start, &points[..40]), None);
    }

    #[test]
    fn uphill_the_nose_points_up_and_downhill_down() {
        let ground = GroundMap::from_mesh(&slope(0.1), |_| true, 0.5);
        for (heading, sign) in [(0.0, 1.0), (std::f64::consts::PI, -1.0)] {
            let pose = Pose2::new(Vector2::new(0.0, 0.0), heading);
            let lifted = ground.lift(&pose, &Stance::default()).unwrap();
            let nose = lifted.rotation * Vector3::x();
            assert_relative_eq!(nose.z, sign * 0.1_f64.atan().sin(), epsilon = 1e-3);
        }
    }

    #[test]
    fn a_stance_from_the_plane_that_it_makes_is_itself() {
        let stance = Stance {
            height_m: 1.7,
            roll_rad: 0.03,
            pitch_rad: -0.02,
        };
        let up = stance.road_from_lidar().rotation.inverse() * Vector3::z();
        let up = Vec3::new(up.x as f32, up.y as f32, up.z as f32);
        let back = Stance::from_plane(up, 1.7);
        assert_relative_eq!(back.roll_rad, stance.roll_rad, epsilon = 1e-6);
        assert_relative_eq!(back.pitch_rad, stance.pitch_rad, epsilon = 1e-6);
    }
}
