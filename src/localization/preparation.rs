//! Preparation of scans: range images, and the attitude of the sensor above the ground.

use crate::ground::{GroundClassifier, GroundConfig, RoadConfig, road_plane};
use crate::lidar::{Motion, RangeImage, Scan, is_inside};
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
        let deskewing = motion.map(|motion| motion.deskewing(scan));
        let moved = |number: usize| {
            let point = scan.points[number];
            let is_kept = !is_inside(point, self.sensor.own_car_m);
            is_kept.then(|| match (&deskewing, scan.times_s.get(number)) {
                (Some(deskewing), Some(&time_s)) => deskewing.moved(point, time_s),
                _ => point,
            })
        };
        RangeImage::project_each(scan.len(), moved, &self.sensor.range_image)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Pose3, Vec3};
    use crate::sensor::SensorConfig;

    #[test]
    fn a_range_image_is_that_of_the_deskewed_points_outside_of_the_own_car() {
        let points: Vec<Vec3> = (0..4000)
            .map(|number| {
                let (sine, cosine) = (0.01 * number as f32).sin_cos();
                let range_m = 2.0 + 0.005 * number as f32;
                Vec3::new(range_m * cosine, range_m * sine, -0.002 * number as f32)
            })
            .collect();
        let scan = Scan {
            times_s: (0..4000).map(|it| 2.5e-5 * it as f32 - 0.05).collect(),
            points,
            ..Scan::default()
        };
        let mut sensor =
            Sensor::infer(std::slice::from_ref(&scan), &SensorConfig::default()).unwrap();
        sensor.own_car_m = [-4.0, 3.0, -2.5, 2.5];
        let preparation = ScanPreparation::new(&sensor, &GroundConfig::default()).unwrap();
        let motion = Motion {
            previous_from_current: Pose3::translation(1.5, 0.1, 0.0),
            duration_s: 0.1,
        };
        for motion in [None, Some(motion)] {
            let mut moved = scan.clone();
            if let Some(motion) = &motion {
                motion.deskew(&mut moved);
            }
            let own = |point: &Vec3| is_inside(*point, sensor.own_car_m);
            let pairs = scan.points.iter().zip(&moved.points);
            let outside = pairs.filter(|(measured, _)| !own(measured));
            let expected: Vec<Vec3> = outside.map(|(_, moved)| *moved).collect();
            assert!(expected.len() < scan.len() - 100);
            let expected = RangeImage::project(&expected, &sensor.range_image);
            let found = preparation.range_image(&scan, motion.as_ref());
            assert!(expected.beams().count() > 500);
            assert!(found.ranges == expected.ranges && found.points == expected.points);
        }
    }
}
