//! The sensor: from a scan to a range image, and its attitude above the ground.

use crate::ground::{GroundClassifier, GroundConfig, road_plane};
use crate::lidar::{LidarModel, Motion, RangeImage, Scan};
use crate::map::SensorAttitude;
use crate::validation::{InvalidValue, Validate, nested, positive, rectangle};
use smart_default::SmartDefault;

/// The sensor and the preparation of its scans.
///
/// Defaults: KITTI's.
#[derive(Clone, Debug, PartialEq, SmartDefault)]
pub struct SensorConfig {
    /// Projection and range limits.
    pub lidar: LidarModel,
    /// Rectangle of the own car in the lidar frame, whose points are dropped: x_min, x_max, y_min, y_max [m].
    #[default(crate::map::build::scan_cloud::ScanConfig::default().own_car_m)]
    pub own_car_m: [f32; 4],
    /// Ground segmentation of the scans.
    pub ground: GroundConfig,
    /// Height of the sensor above the ground [m]; `None` measures it in the scans.
    pub height_m: Option<f64>,
}

impl Validate for SensorConfig {
    /// Errors have the keys of `localization.yml`.
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("range_image", &self.lidar)?;
        rectangle("own_car_m", self.own_car_m)?;
        if let Some(height_m) = self.height_m {
            positive("sensor_height_m", height_m)?;
        }
        self.ground.validate_with_flat_ransac()
    }
}

impl SensorConfig {
    /// Attitude to assume while no scan shows enough ground: level, at the configured height, or at
    /// that of KITTI's car.
    pub fn assumed_attitude(&self) -> SensorAttitude {
        let assumed = SensorAttitude::default();
        SensorAttitude {
            height_m: self.height_m.unwrap_or(assumed.height_m),
            ..assumed
        }
    }
}

/// Prepares scans.
pub struct Sensor {
    lidar: LidarModel,
    own_car_m: [f32; 4],
    classifier: Box<dyn GroundClassifier>,
    /// `None`: measured.
    height_m: Option<f64>,
}

impl Sensor {
    /// Prepares the ground classifier.
    pub fn new(config: &SensorConfig) -> Result<Self, InvalidValue> {
        Ok(Self {
            lidar: config.lidar.clone(),
            own_car_m: config.own_car_m,
            classifier: config.ground.classifier()?,
            height_m: config.height_m,
        })
    }

    /// Projects a scan, deskewed by a motion, without the points on the own car and out of range.
    pub fn range_image(&self, scan: &Scan, motion: Option<&Motion>) -> RangeImage {
        let mut scan = scan.clone();
        scan.drop_inside(self.own_car_m);
        if let Some(motion) = motion {
            motion.deskew(&mut scan);
        }
        RangeImage::project(&scan.points, &self.lidar)
    }

    /// Attitude of the sensor above the ground in the scan, with the height of the configuration if it
    /// has one; `None` where too little ground is visible.
    pub fn attitude(&self, image: &RangeImage) -> Option<SensorAttitude> {
        let points: Vec<_> = (0..image.ranges.len())
            .filter(|&index| image.has_return(index))
            .map(|index| image.points[index])
            .collect();
        let ground = self.classifier.ground_confidence(&points);
        let plane = road_plane(&points, &ground)?;
        let measured = SensorAttitude::from_plane(plane.up, plane.height_m);
        Some(SensorAttitude {
            height_m: self.height_m.unwrap_or(measured.height_m),
            ..measured
        })
    }
}
