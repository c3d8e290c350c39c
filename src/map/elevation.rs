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
//!
//! Where roads cross above one another, a place in the plane has several levels of ground. Who stood
//! on one of them a moment ago says how high that was, and stays on it.

use glam::Vec3;
use nalgebra::{Matrix3, Point2, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};

use super::heights::{Heights, LEVEL_GAP_M, Reader};
use crate::geometry::{Pose2, Pose3, TriangleMesh};

/// About the wheelbase and track of a car: so far the ground carries it [m].
const RADIUS_M: f64 = 2.0;

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
    /// fewer than a third of them are known. Of several levels it is the one at about `level_m`, or
    /// where there is none the one nearest to it; the lowest where that is not known.
    pub fn patch_at(
        &self,
        x: f64,
        y: f64,
        radius_m: f64,
        level_m: Option<f64>,
    ) -> Option<GroundPatch> {
        let on_level = level_m.and_then(|level_m| self.patch_on_level(x, y, radius_m, level_m));
        on_level.or_else(|| {
            let levels = self.cells_around(x, y, radius_m)?;
            let mut heights = self.heights.reader();
            let levels_m = levels.flat_map(|(cell, _)| heights.levels_m(cell).collect::<Vec<_>>());
            let off =
                |height_m: f64| level_m.map_or(height_m, |level_m| (height_m - level_m).abs());
            let nearest_m = levels_m.min_by(|&a, &b| off(a).total_cmp(&off(b)))?;
            self.patch_on_level(x, y, radius_m, nearest_m)
        })
    }

    /// The patches of all levels at a place, from the lowest up.
    pub fn levels_at(&self, x: f64, y: f64) -> Vec<GroundPatch> {
        let Some(cell) = self.heights.cell_at(x, y) else {
            return Vec::new();
        };
        let levels_m: Vec<f64> = self.heights.reader().levels_m(cell).collect();
        if levels_m.len() < 2 {
            // One level, or a gap in what may be one.
            return self.patch_at(x, y, RADIUS_M, None).into_iter().collect();
        }
        levels_m
            .into_iter()
            .filter_map(|level_m| self.patch_on_level(x, y, RADIUS_M, level_m))
            .collect()
    }

    /// The cells within a radius of a place, each with the offset of its middle.
    fn cells_around(
        &self,
        x: f64,
        y: f64,
        radius_m: f64,
    ) -> Option<impl Iterator<Item = ((i64, i64), Vector2<f64>)>> {
        let (column, row) = self.heights.cell_at(x, y)?;
        let reach = (radius_m / self.heights.cell_m).ceil() as i64;
        let rows = row - reach..=row + reach;
        let cells = rows.flat_map(move |row| {
            let columns = column - reach..=column + reach;
            columns.map(move |column| (column, row))
        });
        Some(cells.filter_map(move |cell| {
            let center = self.heights.center(cell);
            let offset = Vector2::new(center.x - x, center.y - y);
            (offset.norm() <= radius_m).then_some((cell, offset))
        }))
    }

    /// The plane through the cells whose ground is at about a height.
    fn patch_on_level(&self, x: f64, y: f64, radius_m: f64, level_m: f64) -> Option<GroundPatch> {
        /// Up or down to here the ground may lead within the radius and since the level was known:
        /// the level above begins no nearer than twice this.
        const REACH_M: f64 = 0.5 * LEVEL_GAP_M;
        let mut heights = self.heights.reader();
        let mut normal_matrix = Matrix3::zeros();
        let mut right_side = Vector3::zeros();
        let (mut known, mut all) = (0, 0);
        for (cell, offset) in self.cells_around(x, y, radius_m)? {
            all += 1;
            let Some(height_m) = heights.nearest_m(cell, level_m) else {
                continue;
            };
            if (height_m - level_m).abs() <= REACH_M {
                known += 1;
                let offset = offset.push(1.0);
                normal_matrix += offset * offset.transpose();
                right_side += offset * height_m;
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

    /// Where in space a planar pose is, standing on the (lowest) ground as `stance` says; `None` where
    /// there is no ground. `map_from_lidar = map_from_road · road_from_lidar`, with the sensor at the
    /// pose's x and y.
    pub fn lift(&self, planar: &Pose2, stance: &Stance) -> Option<Pose3> {
        Some(self.patch_under(planar, None)?.lift(planar, stance))
    }

    /// Height of the ground at a place, of the level nearest to `level_m`, between the middles of the
    /// four cells around it [m]; `None` where one of them is not known.
    pub fn height_at(&self, x: f64, y: f64, level_m: f64) -> Option<f64> {
        self.height_with(&mut self.heights.reader(), x, y, level_m)
    }

    fn height_with(&self, heights: &mut Reader, x: f64, y: f64, level_m: f64) -> Option<f64> {
        let cell_m = self.heights.cell_m;
        let (column, row) = self.heights.cell_at(x - 0.5 * cell_m, y - 0.5 * cell_m)?;
        let center = self.heights.center((column, row));
        let (right, up) = ((x - center.x) / cell_m, (y - center.y) / cell_m);
        let mut between = |row: i64| {
            let near = heights.nearest_m((column, row), level_m)?;
            let far = heights.nearest_m((column + 1, row), level_m)?;
            Some((1.0 - right) * near + right * far)
        };
        Some((1.0 - up) * between(row)? + up * between(row + 1)?)
    }

    /// How the sensor stands over the road at a planar pose: the stance with which the returns
    /// from the road (`points`, lidar frame; others among them do no harm) lie on the mapped
    /// ground. Robust least squares from `start`; `None` where too few returns meet known ground.
    ///
    /// The plane of the road that a scan sees and the patch of the map under the car are fitted to
    /// different stretches of a road that is not flat; this asks one surface only.
    pub fn stance_at(
        &self,
        planar: &Pose2,
        level_m: Option<f64>,
        start: &Stance,
        points: &[Vec3],
    ) -> Option<Stance> {
        /// What lies farther off the ground than this is none of it, from blunt to sharp [m].
        const GATES_M: [f64; 4] = [0.4, 0.2, 0.1, 0.1];
        /// Fewer returns on the ground than this do not tell.
        const ENOUGH: usize = 50;
        let patch = self.patch_under(planar, level_m)?;
        let mut heights = self.heights.reader();
        let mut stance = *start;
        for gate_m in GATES_M {
            let map_from_lidar = patch.lift(planar, &stance);
            let mut normal_matrix = Matrix3::zeros();
            let mut right_side = Vector3::zeros();
            let mut used = 0;
            for point in points {
                let in_lidar = nalgebra::Point3::new(point.x, point.y, point.z).cast::<f64>();
                let in_map = map_from_lidar * in_lidar;
                let ground_m = self.height_with(&mut heights, in_map.x, in_map.y, in_map.z);
                let Some(ground_m) = ground_m else {
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

    /// The ground that a car at a planar pose stands on; `None` where there is none. Of several
    /// levels as in [`patch_at`](Self::patch_at).
    pub fn patch_under(&self, planar: &Pose2, level_m: Option<f64>) -> Option<GroundPatch> {
        let t = planar.translation.vector;
        self.patch_at(t.x, t.y, RADIUS_M, level_m)
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
    use super::*;
    use crate::geometry::planar;
    use approx::assert_relative_eq;

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
        let found = ground.stance_at(&pose, None, &start, &points).unwrap();
        assert_relative_eq!(found.height_m, truth.height_m, epsilon = 5e-3);
        assert_relative_eq!(found.roll_rad, truth.roll_rad, epsilon = 5e-4);
        assert_relative_eq!(found.pitch_rad, truth.pitch_rad, epsilon = 5e-4);
        assert_eq!(ground.stance_at(&pose, None, &start, &points[..40]), None);
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
