//! OdometerState between scans: the local map, the pose, the motion, and how well it predicts.
//!
//! The bias of a gyroscope changes while it warms up and along the way. A registration that determines all of the motion shows the
//! change,
//!
//! ```text
//! b ← b − (Δt / τ) · log(R̂⁻¹ R) / Δt        R̂: measured rotation since the last one,  R: that of the registration
//! ```
//!
//! in which the noise of the registrations, σ per pose, leaves about σ / τ.

use nalgebra::{UnitQuaternion, Vector3, Vector6};

use super::alignment::{Alignment, Problem, best};
use super::config::OdometryConfig;
use super::residuals::Observation;
use super::sampling::{Sample, sensor_range};
use super::search::{search, search_widely};
use super::voxel_map::VoxelMap;
use crate::geometry::Pose3;
use crate::inertial::MeasuredRotation;
use crate::lidar::{Motion, PERIOD_S, Scan};

/// Step of a search, in voxels.
const STEP: f64 = 4.0;
/// Deviations from the prediction that are possible, in usual ones.
const SIGMAS: f64 = 3.0;

/// OdometerState after a scan.
#[derive(Clone, Debug)]
pub struct OdometerState {
    map: VoxelMap,
    /// Range of the sensor, for all lengths [m].
    range_m: f64,
    /// Mean range of the last scans [m].
    mean_range_m: f64,
    /// `p_odom = odom_from_lidar * p_lidar` of the last scan.
    pub odom_from_lidar: Pose3,
    /// The pose of the last scan in the local map.
    mapped: Pose3,
    /// Time since then [s].
    waited_s: f64,
    /// The last motion that was measured; `None` before the second scan.
    motion: Option<Motion>,
    /// The only scan of the local map, which is compensated once its motion is known.
    first: Option<Sample>,
    /// Mean square of the deviations from the predictions [m², rad²].
    deviation: [f64; 2],
    /// Mean cost of the registered scans.
    cost: f64,
    /// Mean share of common surfaces of the registered scans, where it is known.
    common_share: Option<f64>,
    /// Scans since the last that was registered.
    missed: usize,
    /// Whether the last scan fits where it cannot be.
    is_surprised: bool,
    /// Change of the bias of the gyroscope since its calibration, about the axes of the lidar [rad/s].
    bias_change_rad_s: Vector3<f64>,
}

/// A scan that was registered.
pub struct Registered {
    /// Where.
    pub found: Alignment,
    /// Whether its motion was a surprise, or found by a wide search only.
    pub is_doubtful: bool,
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
            mapped: Pose3::identity(),
            waited_s: 0.0,
            motion: None,
            first: None,
            deviation: [0.0; 2],
            cost: 1.0,
            common_share: None,
            missed: 0,
            is_surprised: false,
            bias_change_rad_s: Vector3::zeros(),
        };
        state.restart(scan, config);
        Some(state)
    }

    /// Whether the motion to the last scan is unknown: it is the only one of its local map.
    pub fn is_lost(&self) -> bool {
        self.first.is_some()
    }

    /// Sets the motion by which the next scan is predicted.
    pub fn set_motion(&mut self, motion: Motion, config: &OdometryConfig) {
        if let Some(first) = self.first.take() {
            self.map = self.map_of(&first, Some(&motion), config);
        }
        self.motion = Some(motion);
    }

    /// Pose after a time at constant velocity, turned as was measured, where it was.
    pub fn predicted(&self, duration_s: f64, turn: Option<UnitQuaternion<f64>>) -> Pose3 {
        let mut motion = (self.motion).map_or(Pose3::identity(), |motion| {
            motion.after(self.waited_s + duration_s)
        });
        motion.rotation = turn.unwrap_or(motion.rotation);
        self.mapped * motion
    }

    /// The measured rotation since the pose in the local map until a time after the last scan.
    fn turn(
        &self,
        rotation: Option<&MeasuredRotation>,
        duration_s: f64,
    ) -> Option<UnitQuaternion<f64>> {
        rotation?.since(self.waited_s + duration_s)
    }

    /// Variances of the prediction, (x, y, z, roll, pitch, yaw) in the lidar frame [m², rad²], whose rotation is measured or
    /// that of constant velocity.
    pub fn prior(
        &self,
        duration_s: f64,
        is_turn_measured: bool,
        config: &OdometryConfig,
    ) -> Vector6<f64> {
        /// Least standard deviation per period, in voxels.
        const FLOOR: f64 = 0.3;
        if self.is_lost() {
            return self.unknown_motion(is_turn_measured, config);
        }
        let periods = self.periods(duration_s);
        let floor_m = FLOOR * self.voxel_m(config) * periods;
        let shift = SIGMAS * SIGMAS * self.deviation[0] + floor_m.powi(2);
        let turn = self.turn_variance(if is_turn_measured { 1.0 } else { periods });
        Vector6::new(shift, shift, shift, turn, turn, turn)
    }

    /// Variances of a motion of which nothing predicts the translation, nor the rotation unless it is measured [m², rad²].
    fn unknown_motion(&self, is_turn_measured: bool, config: &OdometryConfig) -> Vector6<f64> {
        /// Standard deviation of the turn [rad].
        const TURN_RAD: f64 = 0.3;
        let shift = self.reach_m(config).powi(2);
        let turn = if is_turn_measured {
            self.turn_variance(1.0)
        } else {
            TURN_RAD.powi(2)
        };
        Vector6::new(shift, shift, shift, turn, turn, turn)
    }

    /// Time since the pose in the local map, in periods, at least one.
    fn periods(&self, duration_s: f64) -> f64 {
        ((self.waited_s + duration_s) / PERIOD_S).max(1.0)
    }

    /// Variance of the predicted rotation over some periods [rad²]. That of a measured one is that of one period: its error
    /// does not grow as that of an assumed rate does.
    fn turn_variance(&self, periods: f64) -> f64 {
        /// Least standard deviation per period [rad].
        const FLOOR_RAD: f64 = 0.02;
        SIGMAS * SIGMAS * self.deviation[1] + (FLOOR_RAD * periods).powi(2)
    }

    /// Registers a scan to the local map and adds it; `None` if it does not fit, then the pose is unchanged.
    pub fn register(
        &mut self,
        scan: &Scan,
        duration_s: f64,
        config: &OdometryConfig,
    ) -> Option<Registered> {
        self.follow_range(sensor_range(scan)?, config);
        let sample = self.sample(scan, config);
        let sparse = sample.thinned(config.registration_spacing * self.voxel_m(config));
        let min_kernel_m = config.min_kernel * self.voxel_m(config);
        let since_s = self.waited_s + duration_s;
        let turn = self.turn(sample.rotation.as_ref(), duration_s);
        let turns = sample.turns();
        let problem = Problem {
            observation: Observation {
                map: &self.map,
                points: &sparse,
                sweep: sample.sweep,
                turns: turns.as_deref(),
                odom_from_previous: self.mapped,
                duration_s: since_s,
                noise_m: min_kernel_m,
            },
            predicted: self.predicted(duration_s, turn),
            unmoved: turn.map_or(self.mapped, |turn| self.mapped * turn),
            is_turn_measured: turn.is_some(),
            prior: self.prior(duration_s, turn.is_some(), config),
            min_kernel_m,
            iterations: config.iterations,
        };
        let predicted = problem.predicted;
        let (found, is_searched) = match &self.first {
            None => self.track(&problem, config),
            Some(first) => (self.first_motion(first, &problem, config), false),
        };
        let found = found.filter(|found| self.fits(found, config));
        let was_surprised = std::mem::replace(&mut self.is_surprised, false);
        let found = found?;
        let is_smooth = self.is_smooth(&found, &predicted, since_s, config);
        if !is_smooth && !was_surprised {
            // Where the next scan fits as well, this is how the sensor moves.
            self.is_surprised = true;
            return None;
        }
        if turn.is_some() && is_smooth && !is_searched && found.degenerate_directions.is_empty() {
            let predicted_from_found =
                predicted.rotation.inverse() * found.odom_from_lidar.rotation;
            self.update_bias(&predicted_from_found, since_s);
        }
        self.update(&found, &predicted, &sample, since_s, config);
        Some(Registered {
            found,
            is_doubtful: is_searched || !is_smooth,
        })
    }

    /// Registers a scan from the prediction; if the result is worse than usual or a surprise, from several starts around it, and
    /// if none of them fits as a motion that is possible, from starts all around the last pose. Also returns whether it was
    /// found there.
    fn track(&self, problem: &Problem, config: &OdometryConfig) -> (Option<Alignment>, bool) {
        /// Increase of the cost that starts a search.
        const WORSE: f64 = 0.1;
        /// Deviation from the prediction that does so: in root mean squares, at least one voxel and [rad]. Between panels of a
        /// façade that are alike, a wrong pose has the usual cost.
        const SURPRISE: f64 = 2.0;
        const SURPRISE_RAD: f64 = 0.05;
        /// Limits of the initial kernel, in voxels.
        const KERNEL: [f64; 2] = [1.0, 4.0];
        /// Reach of the search, in voxels.
        const REACH: f64 = 8.0;
        let voxel_m = self.voxel_m(config);
        let [shift, turn] = self.deviation.map(f64::sqrt);
        let kernel_m = SIGMAS * (shift + 0.5 * self.range_m * turn);
        let kernel_m = kernel_m.clamp(KERNEL[0] * voxel_m, KERNEL[1] * voxel_m);
        let found = problem.align(&problem.predicted, kernel_m);
        let is_expected = |found: &Alignment| {
            let deviation = problem.predicted.inverse() * found.odom_from_lidar;
            deviation.translation.vector.norm() <= (SURPRISE * shift).max(voxel_m)
                && deviation.rotation.angle() <= (SURPRISE * turn).max(SURPRISE_RAD)
        };
        let is_usual = |found: &Alignment| {
            found.cost < self.cost + WORSE && self.fits(found, config) && is_expected(found)
        };
        if found.as_ref().is_some_and(is_usual) {
            return (found, false);
        }
        let searched = search(problem, STEP * voxel_m, REACH * voxel_m);
        let found = best(found.into_iter().chain(searched));
        let since_s = problem.observation.duration_s;
        let holds = |found: &Alignment| {
            self.fits(found, config) && self.is_smooth(found, &problem.predicted, since_s, config)
        };
        if found.as_ref().is_some_and(holds) {
            return (found, false);
        }
        let from = found.as_ref().map(|found| found.odom_from_lidar);
        let unpredicted = Problem {
            prior: self.unknown_motion(problem.is_turn_measured, config),
            ..*problem
        };
        let searched = search_widely(&unpredicted, from, STEP * voxel_m, self.reach_m(config));
        // Along a street without end every place looks alike.
        let searched = searched.filter(|found| found.degenerate_directions.is_empty());
        match searched {
            Some(searched) if self.fits(&searched, config) => (Some(searched), true),
            _ => (found, false),
        }
    }

    /// The motion from the only scan of the local map to the next, without a prediction: the better of none and what a
    /// search finds. The first scan is compensated by it, and the second is registered again.
    fn first_motion(
        &self,
        first: &Sample,
        problem: &Problem,
        config: &OdometryConfig,
    ) -> Option<Alignment> {
        let (step_m, reach_m) = (STEP * self.voxel_m(config), self.reach_m(config));
        let compensated =
            |found: Option<Alignment>| self.with_first_compensated(first, problem, &found?, config);
        let still = problem.align(&problem.unmoved, self.voxel_m(config));
        let near = search(problem, step_m, reach_m);
        let found = best([still, near].into_iter().filter_map(compensated));
        if found.as_ref().is_some_and(|found| self.fits(found, config)) {
            return found;
        }
        let wide = compensated(search_widely(problem, None, step_m, reach_m));
        best(found.into_iter().chain(wide))
    }

    /// Registers a scan again, to the first one compensated by the motion between them.
    fn with_first_compensated(
        &self,
        first: &Sample,
        problem: &Problem,
        found: &Alignment,
        config: &OdometryConfig,
    ) -> Option<Alignment> {
        const PASSES: usize = 3;
        let mut found = found.clone();
        for _ in 0..PASSES {
            let motion = Motion {
                previous_from_current: self.mapped.inverse() * found.odom_from_lidar,
                duration_s: problem.observation.duration_s,
            };
            let map = self.map_of(first, Some(&motion), config);
            let observation = Observation {
                map: &map,
                ..problem.observation
            };
            let problem = Problem {
                observation,
                ..*problem
            };
            found = problem.align(&found.odom_from_lidar, self.voxel_m(config))?;
        }
        Some(found)
    }

    /// Whether a scan fits the local map about as well as those before it.
    fn fits(&self, found: &Alignment, config: &OdometryConfig) -> bool {
        let usual_cost = match self.first {
            None => self.cost + config.max_cost_increase,
            Some(_) => config.max_cost,
        };
        found.cost <= usual_cost.min(config.max_cost)
            && found.matched_share >= config.min_matched_share
            && (found.common_share).is_none_or(|share| self.is_common(share, config))
    }

    /// Whether as many points lie on the planes near them as is usual: at least half of those beyond chance.
    fn is_common(&self, share: f64, config: &OdometryConfig) -> bool {
        /// Share of the points near a plane that lie on it at wrong poses.
        const CHANCE: f64 = 0.3;
        let least = (self.common_share).map_or(0.0, |usual| CHANCE + 0.5 * (usual - CHANCE));
        config.min_common_share == 0.0 || share >= least.max(config.min_common_share)
    }

    /// Whether a motion deviates from the prediction by no more than a vehicle or a hand can accelerate, or than is usual.
    fn is_smooth(
        &self,
        found: &Alignment,
        predicted: &Pose3,
        since_s: f64,
        config: &OdometryConfig,
    ) -> bool {
        if self.is_lost() {
            return true;
        }
        let square_s = since_s.max(PERIOD_S).powi(2);
        let deviation = predicted.inverse() * found.odom_from_lidar;
        let [shift_m, turn_rad] = self.deviation.map(|square| SIGMAS * square.sqrt());
        let most_m = (config.max_acceleration_m_per_s2 * square_s).max(shift_m);
        let most_rad =
            (config.max_turn_acceleration_deg_per_s2.to_radians() * square_s).max(turn_rad);
        deviation.translation.vector.norm() <= most_m && deviation.rotation.angle() <= most_rad
    }

    /// Estimates the change of the bias of the gyroscope from the difference of a registered rotation since the last scan and the
    /// measured one, unless that is an outlier.
    fn update_bias(&mut self, predicted_from_found: &UnitQuaternion<f64>, since_s: f64) {
        /// Time constant [s]: it keeps less than 0.002 deg/s of a registration that errs by 0.05 deg, and
        /// is behind an MPU-6050 that warms by 1 K per minute (its data sheet: 20 deg/s over 125 K) by 0.08 deg/s.
        const TIME_CONSTANT_S: f64 = 30.0;
        let turn = predicted_from_found.angle();
        if turn.powi(2) > self.turn_variance(1.0) {
            return;
        }
        self.bias_change_rad_s -= predicted_from_found.scaled_axis() / since_s.max(TIME_CONSTANT_S);
    }

    /// Takes over a registered scan.
    fn update(
        &mut self,
        found: &Alignment,
        predicted: &Pose3,
        sample: &Sample,
        since_s: f64,
        config: &OdometryConfig,
    ) {
        /// Weight of a scan in the mean deviation.
        const NEW_DEVIATION: f64 = 0.1;
        /// Weight of a scan in the mean cost and share.
        const NEW_COST: f64 = 0.2;
        let motion = Motion {
            previous_from_current: self.mapped.inverse() * found.odom_from_lidar,
            duration_s: since_s,
        };
        if let Some(first) = self.first.take() {
            self.map = self.map_of(&first, Some(&motion), config);
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
        if let Some(share) = found.common_share {
            let usual = self.common_share.unwrap_or(share);
            self.common_share = Some(usual + NEW_COST * (share - usual));
        }
        self.odom_from_lidar = found.odom_from_lidar;
        self.mapped = found.odom_from_lidar;
        self.waited_s = 0.0;
        self.motion = Some(motion);
        self.missed = 0;
        self.map
            .insert(&sample.mapped(&self.odom_from_lidar, Some(&motion)));
        let center = self.odom_from_lidar.translation.vector.into();
        self.map
            .move_sensor(center, config.map_radius_share * self.range_m);
    }

    /// Moves by the prediction. After several scans in turn that do not fit, the local map restarts with this one.
    pub fn coast(&mut self, scan: &Scan, duration_s: f64, config: &OdometryConfig) {
        let turn = self.turn(self.measured_rotation(scan).as_ref(), duration_s);
        self.odom_from_lidar = self.predicted(duration_s, turn);
        self.waited_s += duration_s;
        self.missed += 1;
        if (self.is_lost() || self.missed >= config.restart_after) && sensor_range(scan).is_some() {
            self.restart(scan, config);
        }
    }

    /// Begins a new local map with a scan at the last pose.
    fn restart(&mut self, scan: &Scan, config: &OdometryConfig) {
        let sample = self.sample(scan, config);
        self.mapped = self.odom_from_lidar;
        self.waited_s = 0.0;
        self.missed = 0;
        self.map = self.map_of(&sample, self.motion.as_ref(), config);
        self.first = Some(sample);
    }

    /// Changes all lengths where the range of the sensor has changed much, such as from a room to a street.
    fn follow_range(&mut self, range_m: f64, config: &OdometryConfig) {
        /// Weight of a scan in the mean range.
        const NEW: f64 = 0.05;
        /// Ratio of the mean range to that of the lengths.
        const CHANGE: f64 = 2.5;
        self.mean_range_m += NEW * (range_m - self.mean_range_m);
        let ratio = self.mean_range_m / self.range_m;
        if (1.0 / CHANGE..=CHANGE).contains(&ratio) || self.is_lost() {
            return;
        }
        self.range_m = self.mean_range_m;
        let means = self.map.means();
        self.map = self.empty_map(config);
        self.map.insert(&means);
    }

    /// Longest motion that a search finds [m].
    fn reach_m(&self, config: &OdometryConfig) -> f64 {
        config.first_motion_share * self.range_m
    }

    fn voxel_m(&self, config: &OdometryConfig) -> f64 {
        config.voxel_share * self.range_m
    }

    /// The local map of one scan at the last pose, compensated by a motion.
    fn map_of(&self, scan: &Sample, motion: Option<&Motion>, config: &OdometryConfig) -> VoxelMap {
        let mut map = self.empty_map(config);
        map.insert(&scan.mapped(&self.mapped, motion));
        map
    }

    fn empty_map(&self, config: &OdometryConfig) -> VoxelMap {
        VoxelMap::new(self.voxel_m(config), config.voxel_points)
    }

    fn sample(&self, scan: &Scan, config: &OdometryConfig) -> Sample {
        Sample::new(scan, self.measured_rotation(scan), self.range_m, config)
    }

    /// The measured rotation around the moment of a scan.
    fn measured_rotation(&self, scan: &Scan) -> Option<MeasuredRotation> {
        let calibrated = scan.measured_rotation()?;
        Some(MeasuredRotation {
            bias_change_rad_s: self.bias_change_rad_s,
            ..calibrated
        })
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Matrix6;

    use super::*;

    /// A state with a range of 50 m, a motion of 1 m per period, and a usual cost of 0.3 and share of 0.9.
    fn moving() -> OdometerState {
        OdometerState {
            map: VoxelMap::new(0.5, 50.0),
            range_m: 50.0,
            mean_range_m: 50.0,
            odom_from_lidar: Pose3::identity(),
            mapped: Pose3::identity(),
            waited_s: 0.0,
            motion: Some(Motion {
                previous_from_current: Pose3::translation(1.0, 0.0, 0.0),
                duration_s: PERIOD_S,
            }),
            first: None,
            deviation: [0.0; 2],
            cost: 0.3,
            common_share: Some(0.9),
            missed: 0,
            is_surprised: false,
            bias_change_rad_s: Vector3::zeros(),
        }
    }

    fn config() -> OdometryConfig {
        OdometryConfig {
            max_acceleration_m_per_s2: 50.0,
            max_turn_acceleration_deg_per_s2: 2000.0,
            min_common_share: 0.4,
            min_matched_share: 0.3,
            max_cost: 0.85,
            max_cost_increase: 0.2,
            ..OdometryConfig::default()
        }
    }

    fn found(cost: f64, matched_share: f64, common_share: f64) -> Alignment {
        Alignment {
            odom_from_lidar: Pose3::identity(),
            covariance: Matrix6::identity(),
            degenerate_directions: vec![],
            residual_m: 0.02,
            matched_share,
            cost,
            common_share: Some(common_share),
        }
    }

    #[test]
    fn a_motion_is_possible_within_the_largest_acceleration() {
        let state = moving();
        let is_smooth = |off: Pose3, since_s: f64| {
            let predicted = state.predicted(since_s, None);
            let found = Alignment {
                odom_from_lidar: predicted * off,
                ..found(0.3, 0.9, 0.9)
            };
            state.is_smooth(&found, &predicted, since_s, &config())
        };
        let aside = |shift_m| Pose3::translation(0.0, shift_m, 0.0);
        let turned =
            |turn_deg: f64| Pose3::new(Vector3::zeros(), Vector3::z() * turn_deg.to_radians());
        // 50 m/s² and 2000 deg/s², times the square of the time.
        for (off, since_s, expected) in [
            (aside(0.49), 0.1, true),
            (aside(0.51), 0.1, false),
            (aside(1.99), 0.2, true),
            (aside(2.01), 0.2, false),
            (turned(19.0), 0.1, true),
            (turned(-21.0), 0.1, false),
            (turned(79.0), 0.2, true),
            (turned(81.0), 0.2, false),
        ] {
            assert_eq!(is_smooth(off, since_s), expected, "{off}");
        }
        // A motion that nothing predicts is none that surprises.
        let lost = OdometerState {
            first: Some(Sample::empty()),
            ..moving()
        };
        let far = Alignment {
            odom_from_lidar: aside(9.0) * turned(50.0),
            ..found(0.3, 0.9, 0.9)
        };
        assert!(lost.is_smooth(&far, &Pose3::identity(), 0.1, &config()));
    }

    #[test]
    fn each_measure_of_a_fit_refuses_what_is_worse() {
        let fits = |state: &OdometerState, found: Alignment| state.fits(&found, &config());
        let state = moving();
        assert!(fits(&state, found(0.49, 0.31, 0.9)));
        assert!(!fits(&state, found(0.51, 0.31, 0.9)));
        assert!(!fits(&state, found(0.49, 0.29, 0.9)));
        // Half of 0.9 beyond a chance of 0.3.
        assert!(fits(&state, found(0.49, 0.31, 0.61)));
        assert!(!fits(&state, found(0.49, 0.31, 0.59)));
        let unknown = Alignment {
            common_share: None,
            ..found(0.49, 0.31, 0.0)
        };
        assert!(fits(&state, unknown));
        // Whatever is usual, a cost above 0.85 or a share below 0.4 is none of a fit.
        let usually_bad = OdometerState {
            cost: 0.8,
            common_share: Some(0.4),
            ..moving()
        };
        assert!(fits(&usually_bad, found(0.84, 0.9, 0.41)));
        assert!(!fits(&usually_bad, found(0.86, 0.9, 0.41)));
        assert!(!fits(&usually_bad, found(0.84, 0.9, 0.39)));
        let first = OdometerState {
            first: Some(Sample::empty()),
            common_share: None,
            ..moving()
        };
        assert!(fits(&first, found(0.84, 0.9, 0.41)));
        assert!(!fits(&first, found(0.86, 0.9, 0.41)));
    }

    #[test]
    fn the_prediction_and_its_standard_deviations_are_proportional_to_the_time() {
        let state = moving();
        for periods in [1.0, 2.0, 5.0] {
            let predicted = state.predicted(periods * PERIOD_S, None);
            assert_relative_eq!(predicted.translation.x, periods, epsilon = 1e-9);
            // Without deviations so far: 0.3 voxels of 0.5 m, and 0.02 rad per period.
            let prior = state
                .prior(periods * PERIOD_S, false, &config())
                .map(f64::sqrt);
            assert_relative_eq!(prior.x, 0.15 * periods, epsilon = 1e-12);
            assert_relative_eq!(prior[5], 0.02 * periods, epsilon = 1e-12);
        }
    }
}
