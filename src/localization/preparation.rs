//! Preparation of scans: range images, and the attitude of the sensor above the ground.

use crate::ground::{GroundClassifier, GroundConfig, RoadConfig, road_plane};
use crate::lidar::{Motion, RangeImage, Scan};
use crate::map::SensorAttitude;
use crate::sensor::Sensor;
use crate::validation::{InvalidValue, Validate as _};

/// Prepares the scans of a sensor.
pub(crate) struct ScanPreparation {
    /// The sensor.
    pub sensor: Sensor,
    classifier: Box<dyn GroundClassifier>,
    road: RoadConfig,
}

impl ScanPreparation {
    /// Prepares the ground classifier.
    pub fn new(sensor: &Sensor, ground: &GroundConfig) -> Result<Self, InvalidValue> {
        sensor.validate()?;
        Ok(Self {
            sensor: sensor.clone(),
            classifier: ground.classifier(sensor.height_m())?,
            road: ground.road,
        })
    }

    /// Attitude to assume while no scan shows enough ground: level, at the given height, else at that of its mounting, else
    /// at that of KITTI's car.
    pub fn assumed_attitude(&self) -> SensorAttitude {
        let assumed = SensorAttitude::default();
        SensorAttitude {
            height_m: self.sensor.height_m().unwrap_or(assumed.height_m),
            ..assumed
        }
    }

    /// Projects a scan, deskewed by a motion, without the points on the own car and out of range.
    pub fn range_image(&self, scan: &Scan, motion: Option<&Motion>) -> RangeImage {
        let mut scan = scan.clone();
        scan.drop_inside(self.sensor.own_car_m);
        if let Some(motion) = motion {
            motion.deskew(&mut scan);
        }
        RangeImage::project(&scan.points, &self.sensor.range_image)
    }

    /// Attitude of the sensor above the ground in the scan, with the given height if there is one; `None` where too
    /// little ground is visible.
    pub fn attitude(&self, image: &RangeImage) -> Option<SensorAttitude> {
        let points: Vec<_> = (0..image.ranges.len())
            .filter(|&index| image.has_return(index))
            .map(|index| image.points[index])
            .collect();
        let ground = self.classifier.ground_confidence(&points);
        let plane = road_plane(&points, &ground, &self.road)?;
        let measured = SensorAttitude::from_plane(plane.up, plane.height_m);
        Some(SensorAttitude {
            height_m: self.sensor.sensor_height_m.unwrap_or(measured.height_m),
            ..measured
        })
    }
}
