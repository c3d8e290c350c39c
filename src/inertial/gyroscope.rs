//! Rotations of a lidar from the rates of a calibrated sensor.
//!
//! ```text
//! R(t₁, t₂) = lidar_from_imu · ∏ exp((ω_imu(t) − b_ω) dt) · inv(lidar_from_imu)       t on the clock of the sensor
//! b_ω: bias of the calibration, and its change since then
//! ```

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};

use super::calibration::ImuCalibration;
use super::samples::{Imu, ImuSamples};

/// A calibrated sensor of angular rates, which measures how the lidar turns between times of the clock of its scans.
#[derive(Clone, Debug, PartialEq)]
pub struct Gyroscope {
    samples: Arc<ImuSamples>,
    calibration: ImuCalibration,
}

impl Gyroscope {
    /// The sensor with its calibration.
    pub fn new(imu: &Imu, calibration: ImuCalibration) -> Self {
        Self {
            samples: imu.samples.clone(),
            calibration,
        }
    }

    /// How the sensor is mounted and what it adds.
    pub fn calibration(&self) -> &ImuCalibration {
        &self.calibration
    }

    /// A sensor without errors, in the axes and on the clock of the lidar.
    #[cfg(test)]
    pub fn exact(imu: &Imu) -> Self {
        let calibration = ImuCalibration {
            lidar_from_imu: UnitQuaternion::identity(),
            offset_s: 0.0,
            rate_bias_rad_s: Vector3::zeros(),
            residual_rad_s: 0.0,
            axes_sigma_rad: 0.0,
        };
        Self::new(imu, calibration)
    }

    /// Rotation `first_from_last` of the lidar from a time to a later one [s], with a change of the bias since the calibration
    /// about the axes of the lidar [rad/s]; `None` where measurements are missing.
    pub fn turn(
        &self,
        from_s: f64,
        to_s: f64,
        bias_change_rad_s: &Vector3<f64>,
    ) -> Option<UnitQuaternion<f64>> {
        let ImuCalibration {
            lidar_from_imu,
            offset_s,
            rate_bias_rad_s,
            ..
        } = self.calibration;
        let bias_rad_s = rate_bias_rad_s + lidar_from_imu.inverse() * bias_change_rad_s;
        let [from_s, to_s] = [from_s, to_s].map(|time_s| time_s + offset_s);
        let turn = self.samples.turn(from_s, to_s, &bias_rad_s)?;
        Some(lidar_from_imu * turn * lidar_from_imu.inverse())
    }
}

/// The rotation of a lidar around the moment of a scan.
#[derive(Clone, Debug, PartialEq)]
pub struct MeasuredRotation {
    /// The sensor.
    pub gyroscope: Arc<Gyroscope>,
    /// The moment, on the clock of the scans [s].
    pub moment_s: f64,
    /// How much the bias has changed since the calibration, about the axes of the lidar [rad/s].
    pub bias_change_rad_s: Vector3<f64>,
}

impl MeasuredRotation {
    /// Rotation `previous_from_current` since a time before the moment [s]; `None` where measurements are missing.
    pub fn since(&self, duration_s: f64) -> Option<UnitQuaternion<f64>> {
        self.turn(-duration_s, 0.0)
    }

    /// Rotations `moment_from_lidar` at ascending times after the moment, negative before it [s]; `None` where measurements
    /// are missing.
    pub fn around(&self, times_s: &[f64]) -> Option<Vec<UnitQuaternion<f64>>> {
        let first_s = *times_s.first()?;
        let mut moment_from_lidar = if first_s < 0.0 {
            self.turn(first_s, 0.0)?.inverse()
        } else {
            self.turn(0.0, first_s)?
        };
        let mut turns = vec![moment_from_lidar];
        for pair in times_s.windows(2) {
            moment_from_lidar *= self.turn(pair[0], pair[1])?;
            turns.push(moment_from_lidar);
        }
        Some(turns)
    }

    /// Rotation `first_from_last` between two times after the moment [s].
    fn turn(&self, from_s: f64, to_s: f64) -> Option<UnitQuaternion<f64>> {
        let [from_s, to_s] = [from_s, to_s].map(|after_s| self.moment_s + after_s);
        (self.gyroscope).turn(from_s, to_s, &self.bias_change_rad_s)
    }
}

#[cfg(test)]
mod tests {
    use super::super::samples::{GRAVITY_M_S2, ImuSample};
    use super::*;
    use approx::assert_relative_eq;

    /// A sensor that is turned by a quarter about x, whose clock is 0.3 s ahead and whose bias is 0.1 rad/s, on a lidar that
    /// turns about z with a rate of t.
    fn gyroscope() -> Arc<Gyroscope> {
        let lidar_from_imu =
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
        let rate_bias_rad_s = Vector3::new(0.1, -0.1, 0.1);
        let rows = (0..300).map(|row| {
            let time_s = 0.01 * f64::from(row);
            ImuSample {
                time_s: time_s + 0.3,
                rate_rad_s: lidar_from_imu.inverse() * Vector3::z() * time_s + rate_bias_rad_s,
                force_m_s2: Vector3::z() * GRAVITY_M_S2,
            }
        });
        let imu = Imu {
            samples: Arc::new(ImuSamples::new(rows.collect()).unwrap()),
            lidar_from_imu: None,
        };
        let calibration = ImuCalibration {
            lidar_from_imu,
            offset_s: 0.3,
            rate_bias_rad_s,
            residual_rad_s: 0.0,
            axes_sigma_rad: 0.0,
        };
        Arc::new(Gyroscope::new(&imu, calibration))
    }

    #[test]
    fn rotations_are_those_of_the_lidar_on_the_clock_of_its_scans() {
        // ∫ t dt from 0.5 to 1.5, about z.
        let still = Vector3::zeros();
        let turn = gyroscope().turn(0.5, 1.5, &still).unwrap();
        assert_relative_eq!(turn.scaled_axis(), Vector3::z(), epsilon = 1e-9);
        assert_eq!(gyroscope().turn(2.5, 3.1, &still), None);
        // The sensor is turned; the change is about the axes of the lidar.
        let turn = gyroscope().turn(0.5, 1.5, &(0.2 * Vector3::z())).unwrap();
        assert_relative_eq!(turn.scaled_axis(), 0.8 * Vector3::z(), epsilon = 1e-9);
    }

    #[test]
    fn rotations_around_a_moment_are_those_from_it_to_each_time() {
        let rotation = MeasuredRotation {
            gyroscope: gyroscope(),
            moment_s: 1.0,
            bias_change_rad_s: Vector3::zeros(),
        };
        assert_relative_eq!(rotation.since(1.0).unwrap().angle(), 0.5, epsilon = 1e-9);
        for times_s in [&[-0.05, -0.013, 0.0, 0.02, 0.05][..], &[0.01, 0.04]] {
            let turns = rotation.around(times_s).unwrap();
            for (turn, time_s) in turns.iter().zip(times_s) {
                let angle = 0.5 * ((1.0 + time_s).powi(2) - 1.0);
                assert_relative_eq!(turn.scaled_axis().z, angle, epsilon = 1e-9);
            }
        }
        assert_eq!(rotation.around(&[0.0, 2.5]), None);
        assert_eq!(rotation.around(&[]), None);
    }
}
