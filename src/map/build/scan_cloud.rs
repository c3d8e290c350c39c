//! A scan prepared for mapping: oriented points with ground confidence in the map frame, and the
//! beams that later vote on free space.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::geometry::{PointCloud, Pose3, Rigid3f};
use crate::ground::GroundClassifier;
use crate::lidar::{NormalConfig, RangeImage, Scan, estimate_normals, estimate_spatial_normals};
use crate::sensor::Sensor;

/// How the points of a scan are selected and prepared: what its sensor and the configuration of the map say.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ScanPreparation {
    /// Sensor of the scans.
    pub sensor: Sensor,
    /// Normal estimation.
    pub normals: NormalConfig,
    /// Edge of the voxels for downsampling, in the lidar frame [m].
    pub voxel_size_m: f32,
    /// Half extent of the crop box around the sensor along x, y and z [m].
    pub crop_m: Vec3,
}

/// Number of points dropped in each step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct PointCounts {
    /// Points of the scan.
    pub read: usize,
    /// Not finite, outside the range limits, or on the own car.
    pub invalid: usize,
    /// Outside the field of view, or behind another point of the same pixel.
    pub not_in_image: usize,
    /// In the image, without a reliable normal.
    pub without_normal: usize,
    /// Merged with others of the same voxel.
    pub merged: usize,
    /// Outside the crop box.
    pub cropped: usize,
    /// Kept for meshing.
    pub kept: usize,
}

impl PointCounts {
    /// Adds the counts of another scan.
    pub(crate) fn add(&mut self, other: &Self) {
        self.read += other.read;
        self.invalid += other.invalid;
        self.not_in_image += other.not_in_image;
        self.without_normal += other.without_normal;
        self.merged += other.merged;
        self.cropped += other.cropped;
        self.kept += other.kept;
    }
}

/// A scan prepared for mapping.
#[derive(Clone, Debug)]
pub struct ScanCloud {
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Rigid3f,
    /// Oriented points in the map frame.
    pub cloud: PointCloud,
    /// All valid returns, lidar frame [m]: the ends of the beams that vote on free space. The range
    /// image is not enough: of two returns in a pixel it keeps the nearer one, and loses the
    /// beams that pass close to an edge.
    pub returns: Vec<Vec3>,
    /// Per pixel of the range image, the range up to which space is free [m]; 0 where unknown.
    pub free_range_m: Vec<f32>,
    /// Number of points dropped in each step.
    pub counts: PointCounts,
}

impl ScanCloud {
    /// Prepares a scan taken at `map_from_lidar`.
    pub(crate) fn prepare(
        mut scan: Scan,
        map_from_lidar: &Pose3,
        settings: &ScanPreparation,
        classifier: &dyn GroundClassifier,
    ) -> Self {
        let mut counts = PointCounts {
            read: scan.len(),
            ..PointCounts::default()
        };
        counts.invalid = scan.drop_invalid(&settings.sensor.range_image);
        counts.invalid += scan.drop_inside(settings.sensor.own_car_m);

        let image = RangeImage::project(&scan.points, &settings.sensor.range_image);
        let ground = classifier.ground_confidence(&scan.points);
        let normals = if settings.sensor.has_rows {
            estimate_normals(&image, &settings.normals)
        } else {
            estimate_spatial_normals(&image.points, &settings.normals)
        };
        let mut cloud = PointCloud::with_capacity(image.ranges.len());
        for (index, normal) in normals.iter().enumerate() {
            let Some(number) = image.point_index(index) else {
                continue;
            };
            match *normal {
                Some(normal) => cloud.push(image.points[index], normal, ground[number]),
                None => counts.without_normal += 1,
            }
        }
        counts.not_in_image = scan.points.len() - cloud.len() - counts.without_normal;

        let in_image = cloud.len();
        let mut cloud = cloud.downsample(settings.voxel_size_m);
        counts.merged = in_image - cloud.len();
        let inside: Vec<bool> = cloud
            .positions
            .iter()
            .map(|position| position.abs().cmple(settings.crop_m).all())
            .collect();
        let merged = cloud.len();
        cloud.retain(|index| inside[index]);
        counts.cropped = merged - cloud.len();
        counts.kept = cloud.len();

        let map_from_lidar = Rigid3f::from(map_from_lidar);
        cloud.transform(&map_from_lidar);
        Self {
            map_from_lidar,
            cloud,
            returns: scan.points,
            free_range_m: free_ranges(&image),
            counts,
        }
    }
}

impl ScanCloud {
    /// Size in memory, and of the copy of its points among those of the local map [bytes].
    pub fn bytes(&self) -> usize {
        const POINT_BYTES: usize = 4 * (3 + 3 + 1);
        2 * self.cloud.len() * POINT_BYTES + 12 * self.returns.len() + 4 * self.free_range_m.len()
    }
}

/// Returns per pixel the smallest range among it and its eight neighbours: space nearer than that is
/// free. 0 where the pixel has no return, because a missing return does not prove free space.
pub(crate) fn free_ranges(image: &RangeImage) -> Vec<f32> {
    let (width, height) = (image.model.width, image.model.height);
    let row_minimum = |row: usize, column: usize| {
        let at = |column: usize| image.ranges[row * width + column];
        at((column + width - 1) % width)
            .min(at(column))
            .min(at((column + 1) % width))
    };
    let minima: Vec<f32> = (0..image.ranges.len())
        .map(|index| row_minimum(index / width, index % width))
        .collect();
    (0..image.ranges.len())
        .map(|index| {
            if !image.has_return(index) {
                return 0.0;
            }
            let row = index / width;
            let mut nearest = minima[index];
            if row > 0 {
                nearest = nearest.min(minima[index - width]);
            }
            if row + 1 < height {
                nearest = nearest.min(minima[index + width]);
            }
            nearest
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lidar::LidarModel;

    #[test]
    fn free_space_ends_at_the_nearest_of_nine_pixels_and_is_unknown_without_a_return() {
        let model = LidarModel {
            height: 4,
            width: 8,
            ..LidarModel::default()
        };
        let mut ranges = vec![20.0; model.len()];
        ranges[8 + 7] = 5.0;
        ranges[2] = crate::lidar::range_image::NO_RETURN;
        let free = free_ranges(&RangeImage::from_ranges(ranges, &model));
        assert_eq!(free[2], 0.0);
        assert_eq!(free[3], 20.0);
        // Row 2, column 0 touches row 1, column 7 across the seam.
        assert_eq!(free[16], 5.0);
        assert_eq!(free[24], 20.0);
    }
}
