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
//! distances of its returns to the mapped ground ([`GroundMap::attitude_at`]).
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
pub struct SensorAttitude {
    /// Height of the sensor over the road, along the road's normal [m].
    pub height_m: f64,
    /// About the forward axis [rad].
    pub roll_rad: f64,
    /// About the left axis; positive looks down [rad].
    pub pitch_rad: f64,
}

impl Default for SensorAttitude {
    /// KITTI's car on a level road.
    fn default() -> Self {
        Self {
            height_m: 1.73,
            roll_rad: 0.0,
            pitch_rad: 0.0,
        }
    }
}

impl SensorAttitude {
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

    /// The ground at a place: a plane fitted to the known cells within `radius_m`. Of several levels
    /// it is the one at about `level_m`, or where there is none the nearest to it that enough cells
    /// have; the lowest such where that is not known. `None` where no level has a third of the
    /// cells, and where the one at `level_m` has fewer: nobody falls from a bridge through a gap in
    /// its map.
    pub fn patch_at(
        &self,
        x: f64,
        y: f64,
        radius_m: f64,
        level_m: Option<f64>,
    ) -> Option<GroundPatch> {
        let on_level = level_m.and_then(|level_m| self.patch_on_level(x, y, radius_m, level_m));
        on_level.or_else(|| self.patch_on_fitting_level(x, y, radius_m, level_m))
    }

    /// The patch of the level nearest to a height, or the lowest one, among those that enough cells
    /// have; where some cells are at about that height, the level is one of theirs.
    fn patch_on_fitting_level(
        &self,
        x: f64,
        y: f64,
        radius_m: f64,
        level_m: Option<f64>,
    ) -> Option<GroundPatch> {
        let mut heights = self.heights.reader();
        let mut known_m = Vec::new();
        let mut all = 0;
        for (cell, _) in self.cells_around(x, y, radius_m)? {
            all += 1;
            known_m.extend(heights.levels_m(cell));
        }
        let near = |height_m: f64| known_m.iter().filter(move |&&m| is_near(m, height_m));
        let off = |height_m: f64| level_m.map_or(height_m, |level_m| (height_m - level_m).abs());
        let mut levels_m = match level_m {
            Some(level_m) if near(level_m).next().is_some() => near(level_m).copied().collect(),
            _ => known_m.clone(),
        };
        levels_m.sort_unstable_by(|&a, &b| off(a).total_cmp(&off(b)));
        levels_m.dedup();
        (levels_m.into_iter())
            .filter(|&level_m| is_enough(near(level_m).count(), all))
            .find_map(|level_m| self.patch_on_level(x, y, radius_m, level_m))
    }

    /// The patches of all levels at a place, from the lowest up; where its own cell has none that
    /// enough others share, the one around it.
    pub fn levels_at(&self, x: f64, y: f64) -> Vec<GroundPatch> {
        let Some(cell) = self.heights.cell_at(x, y) else {
            return Vec::new();
        };
        let mut heights = self.heights.reader();
        let own: Vec<GroundPatch> = (heights.levels_m(cell))
            .filter_map(|level_m| self.patch_on_level(x, y, RADIUS_M, level_m))
            .collect();
        if own.is_empty() {
            return self.patch_at(x, y, RADIUS_M, None).into_iter().collect();
        }
        own
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
        let rows = row.saturating_sub(reach)..=row.saturating_add(reach);
        let cells = rows.flat_map(move |row| {
            let columns = column.saturating_sub(reach)..=column.saturating_add(reach);
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
        let mut heights = self.heights.reader();
        let mut normal_matrix = Matrix3::zeros();
        let mut right_side = Vector3::zeros();
        let (mut known, mut all) = (0, 0);
        for (cell, offset) in self.cells_around(x, y, radius_m)? {
            all += 1;
            let Some(height_m) = heights.nearest_m(cell, level_m) else {
                continue;
            };
            if is_near(height_m, level_m) {
                known += 1;
                let offset = offset.push(1.0);
                normal_matrix += offset * offset.transpose();
                right_side += offset * height_m;
            }
        }
        if !is_enough(known, all) {
            return None;
        }
        let plane = normal_matrix.cholesky()?.solve(&right_side);
        Some(GroundPatch {
            height_m: plane.z,
            normal: Vector3::new(-plane.x, -plane.y, 1.0).normalize(),
        })
    }

    /// Where in space a planar pose is, standing on the (lowest) ground as `attitude` says; `None` where
    /// there is no ground. `map_from_lidar = map_from_road · road_from_lidar`, with the sensor at the
    /// pose's x and y.
    pub fn lift(&self, planar: &Pose2, attitude: &SensorAttitude) -> Option<Pose3> {
        Some(self.patch_under(planar, None)?.lift(planar, attitude))
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

    /// How the sensor stands over the road at a planar pose: the attitude with which the returns
    /// from the road (`points`, lidar frame; others among them do no harm) lie on the mapped
    /// ground. Robust least squares from `start`; `None` where too few returns meet known ground.
    ///
    /// The plane of the road that a scan sees and the patch of the map under the car are fitted to
    /// different stretches of a road that is not flat; this asks one surface only.
    pub fn attitude_at(
        &self,
        planar: &Pose2,
        level_m: Option<f64>,
        start: &SensorAttitude,
        points: &[Vec3],
    ) -> Option<SensorAttitude> {
        /// What lies farther off the ground than this is none of it, from blunt to sharp [m].
        const GATES_M: [f64; 4] = [0.4, 0.2, 0.1, 0.1];
        /// Fewer returns on the ground than this do not tell.
        const ENOUGH: usize = 50;
        let patch = self.patch_under(planar, level_m)?;
        let mut heights = self.heights.reader();
        let mut attitude = *start;
        for gate_m in GATES_M {
            let map_from_lidar = patch.lift(planar, &attitude);
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
            attitude.height_m += step.x;
            attitude.roll_rad += step.y;
            attitude.pitch_rad += step.z;
        }
        Some(attitude)
    }

    /// The ground that a car at a planar pose stands on; `None` where there is none. Of several
    /// levels as in [`patch_at`](Self::patch_at).
    pub fn patch_under(&self, planar: &Pose2, level_m: Option<f64>) -> Option<GroundPatch> {
        let t = planar.translation.vector;
        self.patch_at(t.x, t.y, RADIUS_M, level_m)
    }
}

/// Whether a height within the radius is of the ground at a level.
fn is_near(height_m: f64, level_m: f64) -> bool {
    /// Up or down to here the ground may lead within the radius and since the level was known:
    /// the level above begins no nearer than twice this.
    const REACH_M: f64 = 0.5 * LEVEL_GAP_M;
    (height_m - level_m).abs() <= REACH_M
}

/// Whether so many known cells of all tell where the plane of the ground is.
fn is_enough(known: usize, all: usize) -> bool {
    known >= 3 && 3 * known >= all
}

impl GroundPatch {
    /// Where in space a planar pose is, standing on the plane of this patch as `attitude` says.
    /// [`planar`](crate::geometry::pose2_from_pose3) gives the planar pose back, on every slope.
    pub fn lift(&self, planar: &Pose2, attitude: &SensorAttitude) -> Pose3 {
        let t = planar.translation.vector;
        let heading = planar.rotation.angle();
        let up = self.normal;
        let forward = Vector3::new(heading.cos(), heading.sin(), 0.0);
        let left = up.cross(&forward).normalize();
        let rotation =
            Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[left.cross(&up), left, up]));
        let map_from_road = UnitQuaternion::from_rotation_matrix(&rotation);
        let tilted = map_from_road
            * UnitQuaternion::from_euler_angles(attitude.roll_rad, attitude.pitch_rad, 0.0);
        // Leaning on a slope turns the nose a little; the heading is the one that was asked for.
        let nose = tilted * Vector3::x();
        let turn_rad = heading - nose.y.atan2(nose.x);
        // The road plane passes through the patch; the sensor hangs `height_m` along its normal over it.
        let height_m = self.height_m + attitude.height_m / up.z;
        Pose3::from_parts(
            Translation3::new(t.x, t.y, height_m),
            UnitQuaternion::from_euler_angles(0.0, 0.0, turn_rad) * tilted,
        )
    }

    /// How a sensor at a pose in space stands over the plane of this patch; [`lift`](Self::lift) of
    /// the same pose seen from above undoes it, but for the turn of the nose on a slope.
    pub fn attitude_of(&self, map_from_lidar: &Pose3) -> SensorAttitude {
        let up = map_from_lidar.rotation.inverse() * self.normal;
        let above_m = map_from_lidar.translation.z - self.height_m;
        SensorAttitude::from_plane(
            Vec3::new(up.x as f32, up.y as f32, up.z as f32),
            above_m * self.normal.z,
        )
    }
}

#[cfg(test)]
#[path = "elevation_tests.rs"]
mod tests;
