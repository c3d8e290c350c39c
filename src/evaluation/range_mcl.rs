//! Evaluation as in range-mcl: success, and the RMSE after the frames granted for convergence.
//!
//! ```text
//! estimate  = Σ w (x, y, θ) / Σ w        over the top 80 % of the stored rows by weight
//! success   = dₖ < 5 m at every 100th row k from start + 100 on
//! RMSE      = √ mean dₖ²                 over all rows k from start + 100 on
//! ```
//!
//! dₖ is the planar distance to the ground truth. Chen et al., *Range Image-based LiDAR
//! Localization for Autonomous Vehicles*, ICRA 2021, as their evaluation script has it.

use nalgebra::Vector2;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::planar::{PlanarError, planar_errors};
use crate::geometry::{Pose2, wrap_angle};

/// A particle: x, y [m], heading [rad], weight.
pub type ParticleRow = [f32; 4];

/// Parameters of range-mcl's evaluation.
///
/// Defaults: the values of range-mcl's `evaluation.yml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RangeMclRules {
    /// Interval of the rows whose error decides on success, and number of rows before the first
    /// (frames).
    #[default(100)]
    pub convergence_interval: usize,
    /// Position error below which a row is a success [m].
    #[default(5.0)]
    pub converge_thres: f64,
    /// Share of the stored rows, by descending weight, that the estimate averages (unitless).
    #[default(0.8)]
    pub particle_select_ratio: f64,
}

/// Errors of a trajectory by range-mcl's rules.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct RangeMclErrors {
    /// Whether the position error was below the threshold at every checked row; absent if the run is too
    /// short for one.
    pub success: Option<bool>,
    /// RMSE of the planar position [m]; absent without success, or without counted rows.
    pub rmse_location_m: Option<f64>,
    /// RMSE of the heading [deg]; absent without success, or without counted rows.
    pub rmse_yaw_deg: Option<f64>,
}

impl RangeMclRules {
    /// Compares estimates with the ground truth, both one pose per row from the start on.
    pub fn evaluate(&self, estimates: &[Pose2], ground_truth: &[Pose2]) -> RangeMclErrors {
        let errors = planar_errors(estimates, ground_truth);
        let counted = errors.get(self.convergence_interval..).unwrap_or_default();
        let mut checked = counted.iter().step_by(self.convergence_interval.max(1));
        let success = (!counted.is_empty())
            .then(|| checked.all(|error| error.distance_m() < self.converge_thres));
        let rmse = |number: fn(&PlanarError) -> f64| {
            let sum: f64 = counted.iter().map(|error| number(error).powi(2)).sum();
            (success == Some(true)).then(|| (sum / counted.len() as f64).sqrt())
        };
        RangeMclErrors {
            success,
            rmse_location_m: rmse(PlanarError::distance_m),
            rmse_yaw_deg: rmse(|error| error.turn_rad.to_degrees()),
        }
    }

    /// The weighted mean of the particles of a frame with `capacity` stored rows; `None` if all
    /// weights are zero.
    ///
    /// Rows of zeros count towards the share, as in range-mcl: of 10,000 rows with 100 particles,
    /// all 100 are selected. Headings are averaged relative to that of the heaviest particle, so
    /// that the mean is continuous at ±π.
    pub fn estimate(&self, particles: &[ParticleRow], capacity: usize) -> Option<Pose2> {
        let selected = (self.particle_select_ratio * capacity as f64) as usize;
        let mut order: Vec<[f64; 4]> = particles.iter().map(|row| row.map(f64::from)).collect();
        order.sort_by(|a, b| b[3].total_cmp(&a[3]));
        order.truncate(selected);
        let heaviest = order.first()?;
        let mut sum = [0.0; 4];
        for [x, y, heading, weight] in &order {
            sum[0] += weight * x;
            sum[1] += weight * y;
            sum[2] += weight * wrap_angle(heading - heaviest[2]);
            sum[3] += weight;
        }
        let [x, y, turn_rad, weight] = sum;
        (weight > 0.0).then(|| {
            let heading = heaviest[2] + turn_rad / weight;
            Pose2::new(Vector2::new(x / weight, y / weight), heading)
        })
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use approx::assert_relative_eq;

    use super::*;

    fn straight(rows: usize) -> Vec<Pose2> {
        (0..rows)
            .map(|row| Pose2::new(Vector2::new(row as f64, 0.0), 0.0))
            .collect()
    }

    fn shifted(poses: &[Pose2], left_m: f64, turn_rad: f64) -> Vec<Pose2> {
        poses
            .iter()
            .map(|pose| pose * Pose2::new(Vector2::new(0.0, left_m), turn_rad))
            .collect()
    }

    #[test]
    fn a_constant_offset_is_the_rmse() {
        let truth = straight(301);
        let errors = RangeMclRules::default().evaluate(&shifted(&truth, 0.3, 0.02), &truth);
        assert_eq!(errors.success, Some(true));
        assert_relative_eq!(errors.rmse_location_m.unwrap(), 0.3, epsilon = 1e-12);
        let expected_deg = 0.02_f64.to_degrees();
        assert_relative_eq!(errors.rmse_yaw_deg.unwrap(), expected_deg, epsilon = 1e-12);
    }

    #[test]
    fn every_hundredth_row_decides_on_success_and_the_first_hundred_are_skipped() {
        let truth = straight(301);
        let rules = RangeMclRules::default();
        let mut estimates = truth.clone();
        estimates[99].translation.y = 50.0;
        assert_eq!(
            rules.evaluate(&estimates, &truth).rmse_location_m,
            Some(0.0)
        );
        estimates[150].translation.y = 5.1;
        assert_eq!(rules.evaluate(&estimates, &truth).success, Some(true));
        estimates[200].translation.y = 5.1;
        let errors = rules.evaluate(&estimates, &truth);
        assert_eq!(
            (errors.success, errors.rmse_location_m),
            (Some(false), None)
        );
    }

    #[test]
    fn a_run_shorter_than_the_interval_has_no_rmse_and_is_not_checked() {
        let truth = straight(100);
        let errors = RangeMclRules::default().evaluate(&truth, &truth);
        assert_eq!((errors.success, errors.rmse_location_m), (None, None));
    }

    #[test]
    fn the_estimate_ignores_the_lightest_fifth_and_the_scale_of_the_weights() {
        let rules = RangeMclRules::default();
        let mut particles: Vec<ParticleRow> = (0..4).map(|i| [i as f32, 1.0, 0.1, 2.0]).collect();
        particles.push([1000.0, 1.0, 0.1, 1.0]);
        let estimate = rules.estimate(&particles, 5).unwrap();
        assert_relative_eq!(estimate.translation.x, 1.5, epsilon = 1e-12);
        for particle in &mut particles {
            particle[3] *= 1e-6;
        }
        assert_relative_eq!(
            rules.estimate(&particles, 5).unwrap(),
            estimate,
            epsilon = 1e-6
        );
    }

    #[test]
    fn headings_on_both_sides_of_pi_average_to_pi() {
        let particles = [[0.0, 0.0, 3.1, 1.0], [0.0, 0.0, -3.1, 1.0]];
        let estimate = RangeMclRules::default().estimate(&particles, 10).unwrap();
        assert_relative_eq!(estimate.rotation.angle().abs(), PI, epsilon = 1e-6);
    }

    #[test]
    fn particles_without_weight_have_no_mean() {
        let rules = RangeMclRules::default();
        assert_eq!(rules.estimate(&[[1.0, 2.0, 3.0, 0.0]], 10), None);
        assert_eq!(rules.estimate(&[], 10), None);
    }
}
