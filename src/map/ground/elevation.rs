//! Elevation map of the ground, and the pose in space that belongs to a planar pose.
//!
//! ```text
//! map_from_lidar = map_from_road(x, y, heading) · road_from_lidar
//! ```
//!
//! The origin of the road frame is the point of the mapped ground below the sensor; z is the normal
//! of the ground, x points forward. The sensor attitude (height, roll, pitch above the ground) changes
//! with the load and motion of the car and is estimated from the scan: from the plane of the road in
//! the scan or, once the planar pose is known, more accurately from the distances of the returns to
//! the mapped ground ([`GroundMap::attitude_at`]).
//!
//! Where roads cross above one another the map has several levels. The height of the last known
//! ground selects the level.

use std::sync::Arc;

use glam::Vec3;
use nalgebra::{
    Matrix3, Point2, Point3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3,
};
use smart_default::SmartDefault;

use super::heights::{ChunkSource, HeightReader, Heights, LEVEL_GAP_M};
use crate::geometry::{Pose2, Pose3};
use crate::raycasting::TileError;

/// Radius of the ground that carries a car, about its wheelbase [m].
const RADIUS_M: f64 = 2.0;

/// Sensor attitude: height, roll and pitch above the ground.
///
/// Defaults: KITTI's car on a level road, whose lidar is 1.73 m above it (Geiger et al., *Vision meets Robotics*, 2013). That is
/// assumed only while neither the ground in a scan nor a given height or mounting shows another height.
#[derive(Clone, Copy, Debug, PartialEq, SmartDefault)]
pub struct SensorAttitude {
    /// Height of the sensor above the road, along the normal of the road [m].
    #[default(1.73)]
    pub height_m: f64,
    /// Rotation about the forward axis [rad].
    pub roll_rad: f64,
    /// Rotation about the left axis; positive looks down [rad].
    pub pitch_rad: f64,
}

impl SensorAttitude {
    /// Returns the pose of the sensor above the road, `p_road = road_from_lidar * p_lidar`.
    pub fn road_from_lidar(&self) -> Pose3 {
        Pose3::from_parts(
            Translation3::new(0.0, 0.0, self.height_m),
            UnitQuaternion::from_euler_angles(self.roll_rad, self.pitch_rad, 0.0),
        )
    }

    /// Computes the attitude from the plane of the road in the lidar frame: its unit normal (up) and
    /// the distance of the sensor from it [m].
    pub(crate) fn from_plane(up_in_lidar: Vec3, height_m: f64) -> Self {
        let up: Vector3<f64> = Vector3::new(up_in_lidar.x, up_in_lidar.y, up_in_lidar.z).cast();
        // up = Rx(roll)ᵀ Ry(pitch)ᵀ z  (no yaw)  =  (-sin p, cos p sin r, cos p cos r)
        Self {
            height_m,
            roll_rad: up.y.atan2(up.z),
            pitch_rad: (-up.x).asin(),
        }
    }
}

/// Plane of the ground around a point; by default the plane z = 0 of the map.
#[derive(Clone, Copy, Debug, PartialEq, SmartDefault)]
pub struct GroundPatch {
    /// Height at the point, map frame [m].
    pub height_m: f64,
    /// Unit normal, up.
    #[default(Vector3::z())]
    pub normal: Vector3<f64>,
}

impl GroundPatch {
    /// Lifts a planar pose into space: a sensor of that `attitude` above the plane of this patch.
    /// [`pose2_from_pose3`](crate::geometry::pose2_from_pose3) is the inverse, on every slope.
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
        // Roll on a slope changes the heading; this turn restores it.
        let forward = tilted * Vector3::x();
        let turn_rad = heading - forward.y.atan2(forward.x);
        // The sensor is `height_m` above the plane along its normal, at the x and y of the pose.
        let height_m = self.height_m + attitude.height_m / up.z;
        Pose3::from_parts(
            Translation3::new(t.x, t.y, height_m),
            UnitQuaternion::from_euler_angles(0.0, 0.0, turn_rad) * tilted,
        )
    }

    /// The same plane around another point, a shift in x and y away [m].
    pub(crate) fn shifted(&self, shift: &Vector2<f64>) -> Self {
        let rise_m = -self.normal.xy().dot(shift) / self.normal.z;
        Self {
            height_m: self.height_m + rise_m,
            ..*self
        }
    }

    /// Computes the attitude of a sensor above the plane of this patch; [`lift`](Self::lift) of the
    /// planar pose with it gives the pose back, up to the turn of the heading on a slope.
    pub fn attitude_of(&self, map_from_lidar: &Pose3) -> SensorAttitude {
        let up = map_from_lidar.rotation.inverse() * self.normal;
        let above_m = map_from_lidar.translation.z - self.height_m;
        SensorAttitude::from_plane(
            Vec3::new(up.x as f32, up.y as f32, up.z as f32),
            above_m * self.normal.z,
        )
    }
}

/// Elevation map: heights of the ground on a grid, with several levels under bridges.
///
/// The ground of a map on disk is read when it is needed: its methods fail with the [`TileError`] of a tile that cannot
/// be read, and never treat it as one without ground.
#[derive(Clone, Debug)]
pub struct GroundMap {
    heights: Heights,
}

impl GroundMap {
    /// The elevation map whose chunks a source supplies, in cells of `cell_m`.
    pub(crate) fn over(chunks: Arc<dyn ChunkSource>, cell_m: f64) -> Self {
        Self {
            heights: Heights::over(chunks, cell_m),
        }
    }

    /// Fits a plane to the ground within `radius_m` of a position.
    ///
    /// Takes, of several levels, the one at about `level_m`, else the nearest to it that at least a
    /// third of the cells have; the lowest such without `level_m`. `None` where no level has that
    /// many, and where the one at `level_m` has fewer: a gap in a bridge does not drop the car
    /// onto the road below.
    pub(crate) fn patch_at(
        &self,
        x: f64,
        y: f64,
        radius_m: f64,
        level_m: Option<f64>,
    ) -> Result<Option<GroundPatch>, TileError> {
        if let Some(level_m) = level_m
            && let Some(patch) = self.patch_on_level(x, y, radius_m, level_m)?
        {
            return Ok(Some(patch));
        }
        self.patch_on_nearest_level(x, y, radius_m, level_m)
    }

    /// Fits a plane to the level nearest to a height, or to the lowest, among those of enough cells.
    /// If cells have a height at about `level_m`, only their levels are considered.
    fn patch_on_nearest_level(
        &self,
        x: f64,
        y: f64,
        radius_m: f64,
        level_m: Option<f64>,
    ) -> Result<Option<GroundPatch>, TileError> {
        let mut heights = self.heights.reader();
        let mut known_m = Vec::new();
        let mut all = 0;
        for (cell, _) in self.cells_around(x, y, radius_m) {
            all += 1;
            known_m.extend(heights.levels_m(cell)?);
        }
        let near = |height_m: f64| known_m.iter().filter(move |&&m| is_near(m, height_m));
        let distance_m =
            |height_m: f64| level_m.map_or(height_m, |level_m| (height_m - level_m).abs());
        let mut levels_m = match level_m {
            Some(level_m) if near(level_m).next().is_some() => near(level_m).copied().collect(),
            _ => known_m.clone(),
        };
        levels_m.sort_unstable_by(|&a, &b| distance_m(a).total_cmp(&distance_m(b)));
        levels_m.dedup();
        (levels_m.into_iter())
            .filter(|&level_m| is_enough(near(level_m).count(), all))
            .find_map(|level_m| self.patch_on_level(x, y, radius_m, level_m).transpose())
            .transpose()
    }

    /// Returns the patches of all levels at a position, the lowest first. If no level of its own cell
    /// has enough cells around it, returns the lowest patch of the surroundings.
    pub(crate) fn levels_at(&self, x: f64, y: f64) -> Result<Vec<GroundPatch>, TileError> {
        let Some(cell) = self.heights.cell_at(x, y) else {
            return Ok(Vec::new());
        };
        let mut heights = self.heights.reader();
        let own: Vec<GroundPatch> = (heights.levels_m(cell)?)
            .filter_map(|level_m| self.patch_on_level(x, y, RADIUS_M, level_m).transpose())
            .collect::<Result<_, _>>()?;
        if own.is_empty() {
            let around = self.patch_at(x, y, RADIUS_M, None)?;
            return Ok(around.into_iter().collect());
        }
        Ok(own)
    }

    /// Returns the cells within a radius of a position, with the offsets of their centres; none if a coordinate is not
    /// finite.
    fn cells_around(
        &self,
        x: f64,
        y: f64,
        radius_m: f64,
    ) -> impl Iterator<Item = ((i64, i64), Vector2<f64>)> {
        let middle = self.heights.cell_at(x, y);
        let reach = (radius_m / self.heights.cell_m).ceil() as i64;
        let cells = middle.into_iter().flat_map(move |(column, row)| {
            let rows = row.saturating_sub(reach)..=row.saturating_add(reach);
            rows.flat_map(move |row| {
                let columns = column.saturating_sub(reach)..=column.saturating_add(reach);
                columns.map(move |column| (column, row))
            })
        });
        cells.filter_map(move |cell| {
            let offset = self.heights.center(cell) - Point2::new(x, y);
            (offset.norm() <= radius_m).then_some((cell, offset))
        })
    }

    /// Fits a plane to the cells whose ground is at about a height.
    fn patch_on_level(
        &self,
        x: f64,
        y: f64,
        radius_m: f64,
        level_m: f64,
    ) -> Result<Option<GroundPatch>, TileError> {
        let mut heights = self.heights.reader();
        let mut normal_matrix = Matrix3::zeros();
        let mut right_side = Vector3::zeros();
        let (mut known, mut all) = (0, 0);
        for (cell, offset) in self.cells_around(x, y, radius_m) {
            all += 1;
            let height_m = heights.nearest_m(cell, level_m)?;
            if let Some(height_m) = height_m.filter(|&height_m| is_near(height_m, level_m)) {
                known += 1;
                let offset = offset.push(1.0);
                normal_matrix += offset * offset.transpose();
                right_side += offset * height_m;
            }
        }
        if !is_enough(known, all) {
            return Ok(None);
        }
        let plane = (normal_matrix.cholesky()).map(|factors| factors.solve(&right_side));
        Ok(plane.map(|plane| GroundPatch {
            height_m: plane.z,
            normal: Vector3::new(-plane.x, -plane.y, 1.0).normalize(),
        }))
    }

    /// Lifts a planar pose onto the (lowest) ground, `map_from_lidar = map_from_road ·
    /// road_from_lidar`, at the x and y of the planar pose; `None` where there is no ground.
    ///
    /// # Errors
    /// A tile of the map cannot be read.
    pub fn lift(
        &self,
        planar: &Pose2,
        attitude: &SensorAttitude,
    ) -> Result<Option<Pose3>, TileError> {
        let patch = self.patch_under(planar, None)?;
        Ok(patch.map(|patch| patch.lift(planar, attitude)))
    }

    /// Interpolates the height of the ground bilinearly on the level nearest to `level_m` [m]; `None`
    /// if it is unknown in one of the four cells.
    fn height_at(
        &self,
        heights: &mut HeightReader,
        x: f64,
        y: f64,
        level_m: f64,
    ) -> Result<Option<f64>, TileError> {
        let cell_m = self.heights.cell_m;
        let Some((column, row)) = self.heights.cell_at(x - 0.5 * cell_m, y - 0.5 * cell_m) else {
            return Ok(None);
        };
        let center = self.heights.center((column, row));
        let (right, up) = ((x - center.x) / cell_m, (y - center.y) / cell_m);
        let mut rows_m = [0.0; 2];
        for (row, between_m) in (row..).zip(&mut rows_m) {
            let near = heights.nearest_m((column, row), level_m)?;
            let far = heights.nearest_m((column + 1, row), level_m)?;
            let (Some(near), Some(far)) = (near, far) else {
                return Ok(None);
            };
            *between_m = (1.0 - right) * near + right * far;
        }
        Ok(Some((1.0 - up) * rows_m[0] + up * rows_m[1]))
    }

    /// Estimates the sensor attitude at a planar pose: minimizes the distances of the returns from
    /// the road (`points`, lidar frame) to the mapped ground by robust least squares from `start`;
    /// other returns among them are rejected as outliers. `None` if too few returns are near known ground.
    ///
    /// The plane of the road in the scan and the patch of the map under the car are fitted to different
    /// stretches of a road that is not flat; this estimate uses one surface only.
    ///
    /// # Errors
    /// A tile of the map cannot be read.
    pub fn attitude_at(
        &self,
        planar: &Pose2,
        level_m: Option<f64>,
        start: &SensorAttitude,
        points: &[Vec3],
    ) -> Result<Option<SensorAttitude>, TileError> {
        /// Returns farther from the ground are outliers, per iteration [m].
        const GATES_M: [f64; 4] = [0.4, 0.2, 0.1, 0.1];
        /// Least number of returns on the ground.
        const MIN_RETURNS: usize = 50;
        let Some(patch) = self.patch_under(planar, level_m)? else {
            return Ok(None);
        };
        let mut heights = self.heights.reader();
        let mut attitude = *start;
        for gate_m in GATES_M {
            let map_from_lidar = patch.lift(planar, &attitude);
            let mut normal_matrix = Matrix3::zeros();
            let mut right_side = Vector3::zeros();
            let mut used = 0;
            for point in points {
                let in_lidar = Point3::new(point.x, point.y, point.z).cast::<f64>();
                let in_map = map_from_lidar * in_lidar;
                let ground_m = self.height_at(&mut heights, in_map.x, in_map.y, in_map.z)?;
                let Some(above_m) = (ground_m.map(|ground_m| in_map.z - ground_m))
                    .filter(|above_m| above_m.abs() <= gate_m)
                else {
                    continue;
                };
                // Derivatives of the height of the point by sensor height, roll and pitch.
                let slopes = Vector3::new(1.0, in_lidar.y, -in_lidar.x);
                let weight = (1.0 - (above_m / gate_m).powi(2)).powi(2);
                normal_matrix += weight * slopes * slopes.transpose();
                right_side -= weight * above_m * slopes;
                used += 1;
            }
            let factors = normal_matrix.cholesky().filter(|_| used >= MIN_RETURNS);
            let Some(factors) = factors else {
                return Ok(None);
            };
            let step = factors.solve(&right_side);
            attitude.height_m += step.x;
            attitude.roll_rad += step.y;
            attitude.pitch_rad += step.z;
        }
        Ok(Some(attitude))
    }

    /// Returns the ground under a car at a planar pose; `None` where there is none. Of several
    /// levels it is the one at about `level_m` [m], else the lowest that most of the cells nearby have.
    ///
    /// # Errors
    /// A tile of the map cannot be read.
    pub fn patch_under(
        &self,
        planar: &Pose2,
        level_m: Option<f64>,
    ) -> Result<Option<GroundPatch>, TileError> {
        let t = planar.translation.vector;
        self.patch_at(t.x, t.y, RADIUS_M, level_m)
    }
}

/// Whether a height within the radius is on the level at `level_m`.
fn is_near(height_m: f64, level_m: f64) -> bool {
    /// Largest change of the height of a level within the radius and since the level was known [m]: no
    /// other level is nearer than twice this.
    const REACH_M: f64 = 0.5 * LEVEL_GAP_M;
    (height_m - level_m).abs() <= REACH_M
}

/// Whether `known` cells of `all` determine a plane.
fn is_enough(known: usize, all: usize) -> bool {
    known >= 3 && 3 * known >= all
}

#[cfg(test)]
#[path = "elevation_tests.rs"]
mod tests;
