//! Point clouds with normals and ground confidences.

use foldhash::{HashMap, HashMapExt as _};
use glam::{IVec3, Vec3};

use super::Rigid3f;

/// Points with unit normals and ground confidences; all columns have one entry per point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// Positions [m].
    pub positions: Vec<Vec3>,
    /// Unit normals that face the sensor.
    pub normals: Vec<Vec3>,
    /// Confidence that the point is ground, 0 to 1 (unitless).
    pub ground: Vec<f32>,
}

impl PointCloud {
    /// An empty cloud with capacity for `capacity` points.
    pub fn with_capacity(capacity: usize) -> Self {
        Self {
            positions: Vec::with_capacity(capacity),
            normals: Vec::with_capacity(capacity),
            ground: Vec::with_capacity(capacity),
        }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Appends a point: its position [m], its unit normal, and the confidence that it is ground, 0 to 1.
    pub fn push(&mut self, position: Vec3, normal: Vec3, ground: f32) {
        self.positions.push(position);
        self.normals.push(normal);
        self.ground.push(ground);
    }

    /// Appends all points of `other`.
    pub(crate) fn append(&mut self, mut other: Self) {
        self.positions.append(&mut other.positions);
        self.normals.append(&mut other.normals);
        self.ground.append(&mut other.ground);
    }

    /// Keeps the points whose index satisfies `keep`, in order.
    pub(crate) fn retain(&mut self, keep: impl Fn(usize) -> bool) {
        let mut kept = 0;
        for index in 0..self.len() {
            if keep(index) {
                self.positions[kept] = self.positions[index];
                self.normals[kept] = self.normals[index];
                self.ground[kept] = self.ground[index];
                kept += 1;
            }
        }
        self.positions.truncate(kept);
        self.normals.truncate(kept);
        self.ground.truncate(kept);
    }

    /// Transforms all points from frame b to frame a.
    pub(crate) fn transform(&mut self, a_from_b: &Rigid3f) {
        for position in &mut self.positions {
            *position = a_from_b.apply(*position);
        }
        for normal in &mut self.normals {
            *normal = a_from_b.rotate(*normal);
        }
    }

    /// Voxel grid filter: mean position, normalized mean normal and mean confidence per voxel.
    ///
    /// Voxels are in the order of their first points. A voxel whose normals cancel out (two sides
    /// of a sheet) has the normal of its first point.
    pub(crate) fn downsample(&self, voxel_m: f32) -> Self {
        let mut voxel_of: HashMap<IVec3, usize> = HashMap::with_capacity(self.len());
        let mut sums = Self::with_capacity(self.len());
        let mut first = Vec::with_capacity(self.len());
        let mut counts: Vec<f32> = Vec::with_capacity(self.len());
        for index in 0..self.len() {
            let key = (self.positions[index] / voxel_m).floor().as_ivec3();
            let voxel = *voxel_of.entry(key).or_insert_with(|| {
                sums.push(Vec3::ZERO, Vec3::ZERO, 0.0);
                first.push(index);
                counts.push(0.0);
                counts.len() - 1
            });
            sums.positions[voxel] += self.positions[index];
            sums.normals[voxel] += self.normals[index];
            sums.ground[voxel] += self.ground[index];
            counts[voxel] += 1.0;
        }
        for voxel in 0..counts.len() {
            sums.positions[voxel] /= counts[voxel];
            sums.ground[voxel] /= counts[voxel];
            let mean = sums.normals[voxel] / counts[voxel];
            sums.normals[voxel] = if mean.length() > 0.1 {
                mean.normalize()
            } else {
                self.normals[first[voxel]]
            };
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_points_in_one_voxel_and_one_elsewhere() -> PointCloud {
        let mut cloud = PointCloud::default();
        cloud.push(Vec3::new(0.01, 0.01, 0.01), Vec3::X, 1.0);
        cloud.push(Vec3::new(0.03, 0.03, 0.03), Vec3::Y, 0.0);
        cloud.push(Vec3::new(1.0, 1.0, -1.0), Vec3::Z, 0.5);
        cloud
    }

    #[test]
    fn a_voxel_becomes_the_mean_of_its_points_with_a_unit_normal() {
        let thin = two_points_in_one_voxel_and_one_elsewhere().downsample(0.1);
        assert_eq!(thin.len(), 2);
        assert!((thin.positions[0] - Vec3::splat(0.02)).length() < 1e-6);
        assert!((thin.normals[0] - Vec3::new(1.0, 1.0, 0.0).normalize()).length() < 1e-6);
        assert_eq!(thin.ground, [0.5, 0.5]);
    }

    #[test]
    fn downsampling_is_idempotent() {
        let once = two_points_in_one_voxel_and_one_elsewhere().downsample(0.1);
        let twice = once.downsample(0.1);
        assert_eq!(twice.positions, once.positions);
        for (a, b) in once.normals.iter().zip(&twice.normals) {
            assert!((a - b).length() < 1e-6);
        }
    }

    #[test]
    fn retain_keeps_columns_together() {
        let mut cloud = two_points_in_one_voxel_and_one_elsewhere();
        cloud.retain(|index| index != 1);
        assert_eq!(cloud.normals, [Vec3::X, Vec3::Z]);
        assert_eq!(cloud.ground, [1.0, 0.5]);
    }
}
