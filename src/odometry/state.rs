//! OdometerState between scans: the local map, the pose, the motion, and how well it predicts.

use nalgebra::Vector6;

use super::alignment::{Alignment, Problem};
use super::config::OdometryConfig;
use super::residuals::Observation;
use super::sampling::{Sample, sensor_range};
use super::search::search;
use super::voxel_map::VoxelMap;
use crate::geometry::Pose3;
use crate::lidar::{Motion, PERIOD_S, Scan};

/// OdometerState after a scan.
#[derive(Clone, Debug)]
pub struct OdometerState {
    map: VoxelMap,
    /// Range of the sensor, for all lengths [m].
    range_m: f64,
    /// Mean range of the last scans [m].
    mean_range_m: f64,
    /// `p_odom = odom_from_lidar * p_lidar`.
    pub odom_from_lidar: Pose3,
    /// The last motion; `None` before the second scan.
    pub motion: Option<Motion>,
    /// The first scan, which is compensated once its motion is known.
    first: Option<Sample>,
    /// Mean square of the deviations from the predictions [m², rad²].
    deviation: [f64; 2],
    /// Mean cost of the registered scans.
    cost: f64,
    /// Scans since the last that was registered.
    missed: usize,
}

impl OdometerState {
    /// The state after the first scan; `None` if it has too few points.
    pub fn begin(scan: &Scan, config: &OdometryConfig) -> Option<Self> {
        let range_m = sensor_range(scan)?;
        let mut state = Self {
            map: VoxelMap::new(config.voxel_share * range_m, config.voxel_points),
            range_m,
            mean_range_m: range_m,
            odom_from_lidar: Pose3::identity(),
            motion: None,
            first: None,
            deviation: [0.0; 2],
            cost: 1.0,
            missed: 0,
        };
        let sample = state.sample(scan, config);
        state.map.insert(&sample.mapped(&Pose3::identity(), None));
        state.first = Some(sample);
        Some(state)
    }

    /// Pose after a time at constant velocity.
    pub fn predicted(&self, duration_s: f64) -> Pose3 {
        let motion = self
            .motion
            .map_or(Pose3::identity(), |motion| motion.after(duration_s));
        self.odom_from_lidar * motion
    }

    /// Variances of the prediction, (x, y, z, roll, pitch, yaw) in the lidar frame [m², rad²].
    pub fn prior(&self, duration_s: f64, config: &OdometryConfig) -> Vector6<f64> {
        /// Standard deviations of the mean deviation.
        const SIGMAS: f64 = 3.0;
        /// Least standard deviation per period, in voxels.
        const FLOOR: f64 = 0.3;
        /// Least standard deviation per period [rad].
        const FLOOR_RAD: f64 = 0.02;
        /// Standard deviation of the first motion [rad].
        const FIRST_RAD: f64 = 0.3;
        let periods = (duration_s / PERIOD_S).max(1.0);
        let floor_m = FLOOR * self.voxel_m(config) * periods;
        let [shift, turn] = match self.motion {
            Some(_) => {
                let [shift, turn] = self.deviation.map(|square| SIGMAS * SIGMAS * square);
                [
                    shift + floor_m.powi(2),
                    turn + (FLOOR_RAD * periods).powi(2),
                ]
            }
            None => [
                (config.first_motion_share * self.range_m).powi(2),
                FIRST_RAD.powi(2),
            ],
        };
        Vector6::new(shift, shift, shift, turn, turn, turn)
    }

    /// Registers a scan to the local map and adds it; `None` if it does not fit, then the pose is unchanged.
    pub fn register(
        &mut self,
        scan: &Scan,
        duration_s: f64,
        config: &OdometryConfig,
    ) -> Option<Alignment> {
        self.follow_range(sensor_range(scan)?, config);
        let sample = self.sample(scan, config);
        let sparse = sample.thinned(config.registration_spacing * self.voxel_m(config));
        let min_kernel_m = config.min_kernel * self.voxel_m(config);
        let problem = Problem {
            observation: Observation {
                map: &self.map,
                points: &sparse,
                sweep: sample.sweep,
                odom_from_previous: self.odom_from_lidar,
                duration_s,
                noise_m: min_kernel_m,
            },
            predicted: self.predicted(duration_s),
            prior: self.prior(duration_s, config),
            min_kernel_m,
            iterations: config.iterations,
        };
        let found = match &self.first {
            None => self.track(&problem, config),
            Some(first) => self.first_motion(first, &problem, config),
        }?;
        if !self.is_possible(&found, &problem.predicted, duration_s, config) {
            return None;
        }
        let predicted = problem.predicted;
        self.update(&found, &predicted, &sample, duration_s, config);
        Some(found)
    }

    /// Registers a scan from the prediction; if the result is worse than usual, from several starts.
    fn track(&self, problem: &Problem, config: &OdometryConfig) -> Option<Alignment> {
        /// Increase of the cost that starts a search.
        const WORSE: f64 = 0.1;
        /// Limits of the initial kernel, in voxels.
        const KERNEL: [f64; 2] = [1.0, 4.0];
        /// Step and reach of the search, in voxels.
        const STEP: f64 = 4.0;
        const REACH: f64 = 8.0;
        let voxel_m = self.voxel_m(config);
        let [shift, turn] = self.deviation.map(f64::sqrt);
        let kernel_m = 3.0 * (shift + 0.5 * self.range_m * turn);
        let kernel_m = kernel_m.clamp(KERNEL[0] * voxel_m, KERNEL[1] * voxel_m);
        let found = problem.align(&problem.predicted, kernel_m);
        if found
            .as_ref()
            .is_some_and(|found| found.cost < self.cost + WORSE)
        {
            return found;
        }
        let searched = search(problem, STEP * voxel_m, REACH * voxel_m);
        (found.into_iter().chain(searched)).min_by(|a, b| a.cost.total_cmp(&b.cost))
    }

    /// The motion from the first scan to the second, without a prediction. The first scan is compensated by it, and the
    /// second is registered again.
    fn first_motion(
        &self,
        first: &Sample,
        problem: &Problem,
        config: &OdometryConfig,
    ) -> Option<Alignment> {
        const PASSES: usize = 3;
        const STEP: f64 = 4.0;
        let voxel_m = self.voxel_m(config);
        let mut found = search(
            problem,
            STEP * voxel_m,
            config.first_motion_share * self.range_m,
        )?;
        for _ in 0..PASSES {
            let motion = Motion {
                previous_from_current: self.odom_from_lidar.inverse() * found.odom_from_lidar,
                duration_s: problem.observation.duration_s,
            };
            let mut map = self.empty_map(config);
            map.insert(&first.mapped(&self.odom_from_lidar, Some(&motion)));
            let observation = Observation {
                map: &map,
                ..problem.observation
            };
            let problem = Problem {
                observation,
                ..*problem
            };
            found = problem.align(&found.odom_from_lidar, voxel_m)?;
        }
        Some(found)
    }

    /// Whether a motion fits the local map, and deviates from the prediction by no more than a vehicle can accelerate.
    fn is_possible(
        &self,
        found: &Alignment,
        predicted: &Pose3,
        duration_s: f64,
        config: &OdometryConfig,
    ) -> bool {
        let periods = (duration_s / PERIOD_S).max(1.0);
        let deviation = predicted.inverse() * found.odom_from_lidar;
        let is_smooth = self.motion.is_none()
            || deviation.translation.vector.norm()
                <= config.max_deviation_share * self.range_m * periods
                && deviation.rotation.angle() <= config.max_deviation_deg.to_radians() * periods;
        let usual_cost = match self.motion {
            Some(_) => self.cost + config.max_cost_increase,
            None => config.max_cost,
        };
        is_smooth
            && found.cost <= usual_cost.min(config.max_cost)
            && found.matched_share >= config.min_matched_share
    }

    /// Takes over a registered scan.
    fn update(
        &mut self,
        found: &Alignment,
        predicted: &Pose3,
        sample: &Sample,
        duration_s: f64,
        config: &OdometryConfig,
    ) {
        /// Weight of a scan in the mean deviation.
        const NEW_DEVIATION: f64 = 0.1;
        /// Weight of a scan in the mean cost.
        const NEW_COST: f64 = 0.2;
        let motion = Motion {
            previous_from_current: self.odom_from_lidar.inverse() * found.odom_from_lidar,
            duration_s,
        };
        if let Some(first) = self.first.take() {
            self.map = self.empty_map(config);
            self.map
                .insert(&first.mapped(&self.odom_from_lidar, Some(&motion)));
            self.cost = found.cost;
        } else {
            let deviation = predicted.inverse() * found.odom_from_lidar;
            let squares = [
                deviation.translation.vector.norm_squared(),
                deviation.rotation.angle().powi(2),
            ];
            for (mean, square) in self.deviation.iter_mut().zip(squares) {
                *mean += NEW_DEVIATION * (square - *mean);
            }
            self.cost += NEW_COST * (found.cost - self.cost);
        }
        self.odom_from_lidar = found.odom_from_lidar;
        self.motion = Some(motion);
        self.missed = 0;
        self.map
            .insert(&sample.mapped(&self.odom_from_lidar, Some(&motion)));
        let center = self.odom_from_lidar.translation.vector.into();
        self.map
            .remove_beyond(center, config.map_radius_share * self.range_m);
    }

    /// Moves by the prediction. After several scans in turn that do not fit, the local map restarts with this one.
    pub fn coast(&mut self, scan: &Scan, duration_s: f64, config: &OdometryConfig) {
        self.odom_from_lidar = self.predicted(duration_s);
        self.missed += 1;
        if self.motion.is_some() && self.missed < config.restart_after
            || sensor_range(scan).is_none()
        {
            return;
        }
        let sample = self.sample(scan, config);
        self.map = self.empty_map(config);
        self.map
            .insert(&sample.mapped(&self.odom_from_lidar, self.motion.as_ref()));
        self.first = self.motion.is_none().then_some(sample);
        self.missed = 0;
        self.cost = config.max_cost;
    }

    /// Changes all lengths where the range of the sensor has changed much, such as from a room to a street.
    fn follow_range(&mut self, range_m: f64, config: &OdometryConfig) {
        /// Weight of a scan in the mean range.
        const NEW: f64 = 0.05;
        /// Ratio of the mean range to that of the lengths.
        const CHANGE: f64 = 2.5;
        self.mean_range_m += NEW * (range_m - self.mean_range_m);
        let ratio = self.mean_range_m / self.range_m;
        if (1.0 / CHANGE..=CHANGE).contains(&ratio) || self.motion.is_none() {
            return;
        }
        self.range_m = self.mean_range_m;
        let means = self.map.means();
        self.map = self.empty_map(config);
        self.map.insert(&means);
    }

    fn voxel_m(&self, config: &OdometryConfig) -> f64 {
        config.voxel_share * self.range_m
    }

    fn empty_map(&self, config: &OdometryConfig) -> VoxelMap {
        VoxelMap::new(self.voxel_m(config), config.voxel_points)
    }

    fn sample(&self, scan: &Scan, config: &OdometryConfig) -> Sample {
        Sample::new(scan, self.range_m, config)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::{Matrix6, Vector3};

    use super::*;

    /// A state with a range of 50 m, a motion of 1 m per period, and a usual cost of 0.3.
    fn moving() -> OdometerState {
        OdometerState {
            map: VoxelMap::new(0.5, 50.0),
            range_m: 50.0,
            mean_range_m: 50.0,
            odom_from_lidar: Pose3::identity(),
            motion: Some(Motion {
                previous_from_current: Pose3::translation(1.0, 0.0, 0.0),
                duration_s: PERIOD_S,
            }),
            first: None,
            deviation: [0.0; 2],
            cost: 0.3,
            missed: 0,
        }
    }

    fn config() -> OdometryConfig {
        OdometryConfig {
            max_deviation_share: 0.04,
            max_deviation_deg: 20.0,
            min_matched_share: 0.3,
            max_cost: 0.85,
            max_cost_increase: 0.2,
            ..OdometryConfig::default()
        }
    }

    #[test]
    fn each_gate_refuses_what_exceeds_it() {
        let is_possible = |state: &OdometerState, off: Pose3, cost, matched_share, periods: f64| {
            let duration_s = periods * PERIOD_S;
            let predicted = state.predicted(duration_s);
            let found = Alignment {
                odom_from_lidar: predicted * off,
                covariance: Matrix6::identity(),
                degenerate_directions: vec![],
                residual_m: 0.02,
                matched_share,
                cost,
            };
            state.is_possible(&found, &predicted, duration_s, &config())
        };
        let aside = |shift_m| Pose3::translation(0.0, shift_m, 0.0);
        let turned =
            |turn_deg: f64| Pose3::new(Vector3::zeros(), Vector3::z() * turn_deg.to_radians());
        let none = Pose3::identity();
        let state = moving();
        // 4 % of 50 m and 20 degrees, per period.
        for (off, periods, expected) in [
            (aside(1.9), 1.0, true),
            (aside(2.1), 1.0, false),
            (aside(3.9), 2.0, true),
            (aside(4.1), 2.0, false),
            (turned(19.0), 1.0, true),
            (turned(-21.0), 1.0, false),
            (turned(39.0), 2.0, true),
            (turned(41.0), 2.0, false),
        ] {
            assert_eq!(
                is_possible(&state, off, 0.3, 0.9, periods),
                expected,
                "{off}"
            );
        }
        assert!(is_possible(&state, none, 0.49, 0.31, 1.0));
        assert!(!is_possible(&state, none, 0.51, 0.31, 1.0));
        assert!(!is_possible(&state, none, 0.49, 0.29, 1.0));
        // Whatever is usual, a cost above 0.85 is none of a fit.
        let usually_bad = OdometerState {
            cost: 0.8,
            ..moving()
        };
        assert!(is_possible(&usually_bad, none, 0.84, 0.9, 1.0));
        assert!(!is_possible(&usually_bad, none, 0.86, 0.9, 1.0));
        // The first motion is not predicted.
        let first = OdometerState {
            motion: None,
            ..moving()
        };
        assert!(is_possible(
            &first,
            aside(9.0) * turned(50.0),
            0.84,
            0.9,
            1.0
        ));
        assert!(!is_possible(&first, none, 0.86, 0.9, 1.0));
    }

    #[test]
    fn the_prediction_and_its_standard_deviations_are_proportional_to_the_time() {
        let state = moving();
        for periods in [1.0, 2.0, 5.0] {
            let predicted = state.predicted(periods * PERIOD_S);
            assert_relative_eq!(predicted.translation.x, periods, epsilon = 1e-9);
            // Without deviations so far: 0.3 voxels of 0.5 m, and 0.02 rad per period.
            let prior = state.prior(periods * PERIOD_S, &config()).map(f64::sqrt);
            assert_relative_eq!(prior.x, 0.15 * periods, epsilon = 1e-12);
            assert_relative_eq!(prior[5], 0.02 * periods, epsilon = 1e-12);
        }
    }
}
