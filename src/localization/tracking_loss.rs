//! Detection of tracking loss: the evidence by which the filter changes its phase.
//!
//! The share a of beams that agree with the map at the estimate, among those that reach it, is followed
//! by a fast and a slow average,
//!
//! ```text
//! fast ← fast + α_fast (a − fast)      slow ← slow + max(α_slow, 1/n) (a − slow)
//! lost  ⇔  fast < min_agreement  ∨  fast < lost_fraction · slow
//! ```
//!
//! with the n-th share a; the rate is α_slow for a share that is halfway to a loss, so that the slow average, the usual share, begins as
//! the mean of the shares of right poses. A single share below the usual one by a quarter of the way to a loss may be that of a pose next to
//! the right one, which is then looked for. One that fell halfway there from one frame to the next or, of the first ten, all the way is not
//! to be trusted, nor are those after it until one is nearer to the usual share.
//!
//! A place that was found by a search is confirmed by the share of one scan if nearly all of its beams agree, else by
//! those of several scans in turn: many places agree with a single scan of few beams. A pose that was uncertain in
//! between, as along a tunnel, is confirmed by a share that is not below the slow average, or by one of at least
//! `sure_agreement` that is nearer to that average than to a loss. Where nothing is compared, nothing is confirmed.
//!
//! Augmented MCL (Thrun, Burgard and Fox, *Probabilistic Robotics*, 2005, table 8.3) averages the
//! likelihood instead; here traffic in front of the map must not raise an alarm: beams that end far in front of the map are
//! ignored.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::validation::{
    InvalidValue, Validate, at_least_one, bounded, fraction, positive, require,
};

/// State of the filter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// The distribution is still wide.
    Searching,
    /// The distribution is narrow and the scan agrees with the map.
    Tracking,
    /// The scan disagrees with the map: the estimate must not be used.
    Lost,
}

impl State {
    /// The state of a number in a result; `None` if it is of no state.
    pub(crate) fn from_number(number: u8) -> Option<Self> {
        [Self::Searching, Self::Tracking, Self::Lost]
            .into_iter()
            .find(|state| *state as u8 == number)
    }

    /// Name of the state in reports.
    pub fn word(self) -> &'static str {
        match self {
            Self::Searching => "searching",
            Self::Tracking => "tracking",
            Self::Lost => "lost",
        }
    }
}

/// Thresholds of the detection.
///
/// Defaults: values of this project, by the shares of real sensors at right and wrong poses (`docs/method.md`, Convergence and
/// loss); what half and twice of them change on four sensors is in its section Thresholds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct TrackingLossConfig {
    /// Largest difference of an agreeing beam [m].
    #[default(0.3)]
    pub tolerance_m: f32,
    /// Beams that end up to this height above the road do not count: kerbs and low plants do not distinguish places [m].
    #[default(0.5)]
    pub low_height_m: f32,
    /// Weight of a new frame in the fast average, α_fast.
    #[default(0.4)]
    pub fast_rate: f64,
    /// Weight of a new frame in the slow average, α_slow; that average begins as the mean of the first frames.
    #[default(0.02)]
    pub slow_rate: f64,
    /// Tracking is lost below this share of agreeing beams (unitless).
    #[default(0.6)]
    pub min_agreement: f64,
    /// Tracking is lost below this fraction of the slow average (unitless).
    #[default(0.75)]
    pub lost_fraction: f64,
    /// A place that was found is the right one from this share of agreeing beams on; a pose that became uncertain too, if the
    /// share is also nearer to the slow average than to a loss (unitless).
    #[default(0.8)]
    pub sure_agreement: f64,
    /// Least share of updates that confirm it in turn (unitless).
    #[default(0.75)]
    pub confirming_agreement: f64,
    /// Number of these updates.
    #[default(3)]
    pub confirming_updates: usize,
    /// Updates without convergence after which the search restarts.
    #[default(25)]
    pub patience: usize,
    /// Tracking is lost where the distribution is wider than this, as outside the map: √(σ_x² + σ_y²) [m].
    #[default(2.0)]
    pub max_spread_m: f64,
    /// Largest standard deviation of the position, along its long axis, with which a frame is reported as tracked [m]:
    /// with more the pose is still followed, and reported as searching. Of normal errors, 1.2 % are beyond the half metre, 2.5 of
    /// these, from which on a position is wrong.
    #[default(0.2)]
    pub sure_spread_m: f64,
}

impl Validate for TrackingLossConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("tolerance_m", self.tolerance_m)?;
        bounded("low_height_m", self.low_height_m)?;
        fraction("fast_rate", self.fast_rate)?;
        fraction("slow_rate", self.slow_rate)?;
        require(
            self.slow_rate <= self.fast_rate,
            "slow_rate",
            self.slow_rate,
            format!(
                "it must not be greater than fast_rate, which is {}",
                self.fast_rate
            ),
        )?;
        fraction("min_agreement", self.min_agreement)?;
        fraction("lost_fraction", self.lost_fraction)?;
        fraction("sure_agreement", self.sure_agreement)?;
        fraction("confirming_agreement", self.confirming_agreement)?;
        at_least_one("confirming_updates", self.confirming_updates)?;
        at_least_one("patience", self.patience)?;
        positive("max_spread_m", self.max_spread_m)?;
        positive("sure_spread_m", self.sure_spread_m)
    }
}

/// Part of the way from the usual share to a loss, beyond which a share is nearer to the loss.
const HALFWAY: f64 = 0.5;

/// Averages of the share of agreeing beams.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AgreementMonitor {
    fast: Option<f64>,
    slow: Option<f64>,
    /// Number of shares in the averages.
    observed: usize,
    /// Last share.
    last: Option<f64>,
    /// Whether it was doubtful.
    is_in_doubt: bool,
    /// Updates in turn that agree with a place that was found.
    confirming: usize,
}

impl AgreementMonitor {
    /// Updates the averages by the share of a frame; `None` changes nothing.
    pub fn observe(&mut self, agreement: Option<f64>, config: &TrackingLossConfig) {
        let Some(agreement) = agreement else {
            return;
        };
        self.is_in_doubt = self.is_doubtful(Some(agreement), config);
        self.last = Some(agreement);
        self.observed += 1;
        let mean_rate = 1.0 / self.observed as f64;
        let slow_rate = if self.is_below_usual(Some(agreement), HALFWAY, config) {
            config.slow_rate
        } else {
            config.slow_rate.max(mean_rate)
        };
        let follow = |average: &mut Option<f64>, rate: f64| {
            let before = average.unwrap_or(agreement);
            *average = Some(before + rate * (agreement - before));
        };
        follow(&mut self.fast, config.fast_rate);
        follow(&mut self.slow, slow_rate);
    }

    /// Whether the place is confirmed to which the filter has converged, or not, in this update. What is not compared
    /// confirms nothing.
    pub fn confirm(
        &mut self,
        is_converged: bool,
        agreement: Option<f64>,
        config: &TrackingLossConfig,
    ) -> bool {
        let share = agreement.filter(|_| is_converged).unwrap_or(0.0);
        self.confirming = if share >= config.sure_agreement {
            config.confirming_updates
        } else if share >= config.confirming_agreement {
            self.confirming + 1
        } else {
            0
        };
        self.confirming >= config.confirming_updates
    }

    /// The usual share; `None` before the first one.
    pub fn usual(&self) -> Option<f64> {
        self.slow
    }

    /// Whether tracking is lost.
    pub fn is_lost(&self, config: &TrackingLossConfig) -> bool {
        let (Some(fast), Some(slow)) = (self.fast, self.slow) else {
            return false;
        };
        fast < config.min_agreement || fast < config.lost_fraction * slow
    }

    /// Whether a share is below the usual one as far as the fast average is where tracking is lost: the motion into the frame was not
    /// what the odometry found.
    pub fn is_far_below_usual(&self, agreement: Option<f64>, config: &TrackingLossConfig) -> bool {
        self.is_below_usual(agreement, 1.0, config)
    }

    /// Whether a frame with the next share is not to be called tracking: the share is nearer to a loss than to the usual one, and fell
    /// there from one frame to the next or has been there since. Where a street has changed, shares fall and rise over many frames. As long
    /// as the usual one is the mean of few shares, one far below it is doubtful.
    pub fn is_doubtful(&self, agreement: Option<f64>, config: &TrackingLossConfig) -> bool {
        /// Number of shares whose mean has a third of the standard deviation of a single one.
        const MANY: usize = 10;
        if self.observed < MANY {
            return self.is_far_below_usual(agreement, config);
        }
        let has_fallen = || self.is_below(agreement, self.last, HALFWAY, config);
        self.is_below_usual(agreement, HALFWAY, config) && (self.is_in_doubt || has_fallen())
    }

    /// Whether a share is so low that the pose of its frame may be another one around the prediction.
    pub fn suggests_another_pose(
        &self,
        agreement: Option<f64>,
        config: &TrackingLossConfig,
    ) -> bool {
        /// Part of the way to a loss.
        const WAY: f64 = 0.25;
        self.is_below_usual(agreement, WAY, config)
    }

    /// Whether a share is below the usual one by more than a part of the way to a loss.
    fn is_below_usual(
        &self,
        agreement: Option<f64>,
        way: f64,
        config: &TrackingLossConfig,
    ) -> bool {
        self.is_below(agreement, self.slow, way, config)
    }

    /// Whether a share is below another one by more than a part of the way from the usual one to a loss.
    fn is_below(
        &self,
        agreement: Option<f64>,
        other: Option<f64>,
        way: f64,
        config: &TrackingLossConfig,
    ) -> bool {
        let (Some(share), Some(other), Some(slow)) = (agreement, other, self.slow) else {
            return false;
        };
        share < other - way * (1.0 - config.lost_fraction) * slow
    }

    /// Whether a share confirms a pose that was uncertain: it is as large as usual here, or nearly all beams agree and it is
    /// nearer to the usual one than to a loss. A wrong pose beyond a tunnel, in which all beams agreed, does not reach that.
    pub fn is_usual(&self, agreement: Option<f64>, config: &TrackingLossConfig) -> bool {
        agreement.is_some_and(|share| {
            let is_sure = share >= config.sure_agreement;
            let is_near = !self.is_below_usual(agreement, HALFWAY, config);
            (self.slow).is_none_or(|slow| share >= slow || is_sure && is_near)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_of_a_result_is_that_of_its_state() {
        for state in [State::Searching, State::Tracking, State::Lost] {
            assert_eq!(State::from_number(state as u8), Some(state));
        }
        assert_eq!(State::from_number(3), None);
        let words = [State::Searching, State::Tracking, State::Lost].map(State::word);
        assert_eq!(words, ["searching", "tracking", "lost"]);
    }

    #[test]
    fn a_share_far_below_the_usual_one_is_noticed_and_a_first_one_is_not() {
        let config = TrackingLossConfig::default();
        let mut monitor = AgreementMonitor::default();
        let judge = |monitor: &AgreementMonitor, share| {
            let is_far = monitor.is_far_below_usual(share, &config);
            let is_doubtful = monitor.is_doubtful(share, &config);
            let is_another = monitor.suggests_another_pose(share, &config);
            [is_far, is_doubtful, is_another]
        };
        assert_eq!(judge(&monitor, Some(0.3)), [false; 3]);
        for share in [1.0, 0.9, 0.98, 0.92, 0.95] {
            monitor.observe(Some(share), &config);
        }
        monitor.observe(Some(0.65), &config);
        // The mean of the five, and a fiftieth of the way to the last.
        let usual = 0.944;
        // The averages see no loss yet.
        assert!(!monitor.is_lost(&config));
        let is_known = |number: usize| number >= 10;
        for number in 6..=12 {
            for (below, expected) in [
                (0.26, [true, true, true]),
                (0.24, [false, is_known(number), true]),
                (0.13, [false, is_known(number), true]),
                (0.12, [false, false, true]),
                (0.065, [false, false, true]),
                (0.06, [false, false, false]),
                (-0.1, [false, false, false]),
            ] {
                let share = (1.0 - below) * usual;
                assert_eq!(judge(&monitor, Some(share)), expected, "{number}: {below}");
            }
            assert_eq!(judge(&monitor, None), [false; 3]);
            monitor.observe(Some(usual), &config);
        }
    }

    #[test]
    fn a_share_is_doubtful_after_a_sudden_fall_and_not_where_shares_fall_over_many_frames() {
        let config = TrackingLossConfig::default();
        let doubtful_in = |shares: &[f64]| {
            let mut monitor = AgreementMonitor::default();
            (0..20).for_each(|_| monitor.observe(Some(0.95), &config));
            let is_doubtful = |&share: &f64| {
                let is_doubtful = monitor.is_doubtful(Some(share), &config);
                monitor.observe(Some(share), &config);
                is_doubtful
            };
            shares.iter().map(is_doubtful).collect::<Vec<_>>()
        };
        // A hoarding comes into view and passes.
        let gradual = [0.92, 0.88, 0.84, 0.79, 0.75, 0.73, 0.75, 0.8, 0.86];
        assert_eq!(doubtful_in(&gradual), [false; 9]);
        // The motion into a frame was another one than the odometry found.
        let sudden = [0.94, 0.8, 0.78, 0.76, 0.9, 0.8];
        let expected = [false, true, true, true, false, false];
        assert_eq!(doubtful_in(&sudden), expected);
    }

    #[test]
    fn the_usual_share_is_the_mean_of_the_first_ones_that_are_near_it_and_follows_slowly() {
        let config = TrackingLossConfig::default();
        let mut monitor = AgreementMonitor::default();
        for number in 1..=50 {
            monitor.observe(Some(if number % 2 == 0 { 0.9 } else { 0.94 }), &config);
        }
        assert!((monitor.slow.unwrap() - 0.92).abs() < 1e-9);
        monitor.observe(Some(0.82), &config);
        assert!((monitor.slow.unwrap() - 0.918).abs() < 1e-9);
        // A wrong pose after few scans does not become usual before it is lost.
        let mut wrong = AgreementMonitor::default();
        let shares = [0.95; 3].into_iter().chain([0.65; 7]);
        let is_lost = |share| {
            wrong.observe(Some(share), &config);
            wrong.is_lost(&config)
        };
        assert_eq!(shares.map(is_lost).position(|is_lost| is_lost), Some(6));
    }

    fn after(agreements: &[f64]) -> bool {
        let config = TrackingLossConfig::default();
        let mut monitor = AgreementMonitor::default();
        for &agreement in agreements {
            monitor.observe(Some(agreement), &config);
        }
        monitor.is_lost(&config)
    }

    #[test]
    fn tracking_is_lost_only_where_the_scan_disagrees_with_the_map() {
        assert!(!after(&[0.9; 50]));
        assert!(!after(&[0.65; 50]));
        assert!(after(&[0.3; 1]));
    }

    #[test]
    fn tracking_is_lost_after_five_disagreeing_frames_and_not_after_one() {
        let mut frames = vec![0.95; 30];
        frames.push(0.5);
        assert!(!after(&frames));
        frames.extend([0.5; 4]);
        assert!(after(&frames));
    }

    #[test]
    fn an_uncertain_pose_is_confirmed_by_as_many_beams_as_usual_here() {
        let config = TrackingLossConfig::default();
        let mut monitor = AgreementMonitor::default();
        (0..100).for_each(|_| monitor.observe(Some(0.98), &config));
        // Two metres off beyond a tunnel in which every scan agreed.
        (0..10).for_each(|_| monitor.observe(Some(0.77), &config));
        assert!(!monitor.is_usual(Some(0.77), &config));
        assert!(monitor.is_usual(Some(0.9), &config));
        // A metre off there, between the predicted pose and the right one.
        let mut behind = AgreementMonitor::default();
        (0..100).for_each(|_| behind.observe(Some(0.99), &config));
        let falling = (0..14).map(|number| 0.99 - 0.012 * f64::from(number));
        falling.for_each(|share| behind.observe(Some(share), &config));
        assert!(!behind.is_usual(Some(0.82), &config));
        assert!(behind.is_usual(Some(0.87), &config) && !behind.is_usual(None, &config));
        // Where a street has changed, fewer beams always agree.
        let mut changed = AgreementMonitor::default();
        (0..100).for_each(|_| changed.observe(Some(0.7), &config));
        assert!(changed.is_usual(Some(0.71), &config));
        // Near the usual share, but not of nearly all beams.
        let mut between = AgreementMonitor::default();
        between.observe(Some(0.85), &config);
        assert!(between.is_usual(Some(0.81), &config) && !between.is_usual(Some(0.79), &config));
    }

    #[test]
    fn one_scan_confirms_a_place_only_if_nearly_all_beams_agree() {
        let config = TrackingLossConfig::default();
        let confirmed_after = |agreements: &[Option<f64>]| {
            let mut monitor = AgreementMonitor::default();
            let mut updates = agreements.iter();
            updates.position(|&agreement| monitor.confirm(true, agreement, &config))
        };
        assert_eq!(confirmed_after(&[Some(0.95)]), Some(0));
        assert_eq!(confirmed_after(&[Some(0.78), Some(0.76), Some(0.04)]), None);
        assert_eq!(confirmed_after(&[Some(0.78); 4]), Some(2));
        // The scans of a mirrored drive agree as well as this.
        assert_eq!(confirmed_after(&[Some(0.72); 9]), None);
        assert_eq!(confirmed_after(&[None; 9]), None);
        // An update without convergence restarts the count.
        let mut monitor = AgreementMonitor::default();
        for is_converged in [true, true, false, true, true] {
            assert!(!monitor.confirm(is_converged, Some(0.78), &config));
        }
        assert!(monitor.confirm(true, Some(0.78), &config));
    }

    #[test]
    fn frames_without_agreement_change_nothing() {
        let config = TrackingLossConfig::default();
        let mut monitor = AgreementMonitor::default();
        monitor.observe(None, &config);
        assert_eq!(monitor, AgreementMonitor::default());
        assert!(!monitor.is_lost(&config));
    }
}
