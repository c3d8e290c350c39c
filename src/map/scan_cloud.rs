//! One scan made ready for mapping: oriented points with ground confidence in the map frame, and
//! the beams that later vote on what is free space.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::geometry::{PointCloud, Rigid3f};
use crate::ground::GroundClassifier;
use crate::lidar::{LidarModel, NormalConfig, RangeImage, estimate_normals};
use crate::recording::{Frame, RecordingError};
use crate::validation::{InvalidValue, Validate, nested, positive, rectangle};

/// What of a scan goes into the map.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanSettings {
    /// Projection and range limits.
    pub range_image: LidarModel,
    /// How normals are found.
    pub normals: NormalConfig,
    /// Edge of the voxels that keep one point each, in the frame of the scan [m].
    pub voxel_size_m: f32,
    /// Points farther than this from the sensor along x, y and z are not meshed [m].
    pub crop_m: Vec3,
    /// The own car: points in this box of the lidar frame are dropped, [x_min, x_max, y_min, y_max] [m].
    pub own_car_m: [f32; 4],
}

impl Default for ScanSettings {
    /// range-mcl's, with the outline of KITTI's car.
    fn default() -> Self {
        Self {
            range_image: LidarModel::default(),
            normals: NormalConfig::default(),
            voxel_size_m: 0.1,
            crop_m: Vec3::new(30.0, 30.0, 5.0),
            own_car_m: [-2.5, 2.7, -1.2, 1.2],
        }
    }
}

impl Validate for ScanSettings {
    /// With the keys of `build_map.yml`.
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("range_image", &self.range_image)?;
        nested("normals", &self.normals)?;
        positive("voxel_size", self.voxel_size_m)?;
        positive("crop_x", self.crop_m.x)?;
        positive("crop_y", self.crop_m.y)?;
        positive("crop_z", self.crop_m.z)?;
        rectangle("own_car_m", self.own_car_m)
    }
}

/// How many points a scan lost, and where.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PointCounts {
    /// In the file.
    pub read: usize,
    /// Not finite, out of the range limits, or on the own car.
    pub invalid: usize,
    /// Outside the field of view, or behind another point of the same pixel.
    pub not_in_image: usize,
    /// In the image, but without a good normal.
    pub without_normal: usize,
    /// Merged into a voxel with others.
    pub merged: usize,
    /// Outside the crop box.
    pub cropped: usize,
    /// Left for meshing.
    pub kept: usize,
}

impl PointCounts {
    /// Adds the counts of another scan.
    pub fn add(&mut self, other: &Self) {
        self.read += other.read;
        self.invalid += other.invalid;
        self.not_in_image += other.not_in_image;
        self.without_normal += other.without_normal;
        self.merged += other.merged;
        self.cropped += other.cropped;
        self.kept += other.kept;
    }
}

/// A scan ready for mapping.
#[derive(Clone, Debug)]
pub struct ScanCloud {
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Rigid3f,
    /// Oriented points in the map frame.
    pub cloud: PointCloud,
    /// All valid returns, lidar frame [m]: the ends of the beams that vote on free space. The image
    /// would not do, for of two returns in a pixel it keeps the nearer one, and so forgets the
    /// beams that pass close by an edge.
    pub returns: Vec<Vec3>,
    /// Per pixel of the range image the range up to which space is surely free [m]; 0 where unknown.
    pub free_range_m: Vec<f32>,
    /// Of the bytes that the scan was read from.
    pub hash: blake3::Hash,
    /// What was dropped on the way.
    pub counts: PointCounts,
}

impl ScanCloud {
    /// Reads the scan of a frame and makes it ready.
    pub fn prepare(
        frame: &Frame,
        settings: &ScanSettings,
        classifier: &dyn GroundClassifier,
    ) -> Result<Self, RecordingError> {
        let (mut scan, hash) = frame.read_and_hash()?;
        let mut counts = PointCounts {
            read: scan.len(),
            ..PointCounts::default()
        };
        counts.invalid = scan.drop_invalid(&settings.range_image);
        let [x_min, x_max, y_min, y_max] = settings.own_car_m;
        let on_own_car = |p: Vec3| p.x > x_min && p.x < x_max && p.y > y_min && p.y < y_max;
        let before = scan.points.len();
        scan.points.retain(|&point| !on_own_car(point));
        counts.invalid += before - scan.points.len();

        let image = RangeImage::project(&scan.points, &settings.range_image);
        let ground = classifier.ground_confidence(&scan.points);
        let normals = estimate_normals(&image, &settings.normals);
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

        let map_from_lidar = Rigid3f::from(&frame.map_from_lidar);
        cloud.transform(&map_from_lidar);
        Ok(Self {
            map_from_lidar,
            cloud,
            returns: scan.points,
            free_range_m: free_ranges(&image),
            hash,
            counts,
        })
    }
}

/// Per pixel the smallest range among it and its eight neighbours: nearer than that is surely
/// free. 0 where the pixel itself saw nothing, for "nothing came back" is no proof of free space.
pub(super) fn free_ranges(image: &RangeImage) -> Vec<f32> {
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

    #[test]
    fn free_space_ends_at_the_nearest_of_nine_pixels_and_is_unknown_where_nothing_came_back() {
        let model = LidarModel {
            height: 4,
            width: 8,
            ..LidarModel::default()
        };
        let mut ranges = vec![20.0; model.len()];
        ranges[8 + 7] = 5.0;
        ranges[2] = crate::lidar::NO_RETURN;
        let free = free_ranges(&RangeImage::from_ranges(ranges, &model));
        assert_eq!(free[2], 0.0);
        assert_eq!(free[3], 20.0);
        // Row 2, column 0 touches row 1, column 7 across the seam.
        assert_eq!(free[16], 5.0);
        assert_eq!(free[24], 20.0);
    }
}
