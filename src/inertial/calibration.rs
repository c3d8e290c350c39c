//! Axes, clock and bias of an inertial sensor, from rotations that something else has measured.
//!
//! ```text
//! Σ |x̃ₖ − R ỹₖ(δ)|² → min     x: mean rates of measured rotations,   y: those of the sensor at times shifted by δ
//! H = Σ x̃ ỹᵀ = U S Vᵀ         R = U diag(1, 1, det(U Vᵀ)) Vᵀ         ~: without the mean, so that the bias cancels
//! ```
//!
//! for each δ of a range; the best one is refined by a parabola. A mean rate is the logarithm of a rotation by its duration, as
//! rotations about axes that change do not add up. A mirrored sensor is one that R with a determinant of -1
//! fits far better.
//!
//! Umeyama, *Least-Squares Estimation of Transformation Parameters* (1991), for R and the scale, which must be about one;
//! Furgale et al., *Unified Temporal and Spatial Calibration* (IROS 2013), for the problem.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::samples::{Imu, ImuSamples};
use crate::statistics::median;

/// A rotation between two times.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredTurn {
    /// Time of the first pose [s].
    pub from_s: f64,
    /// Time of the last one, which is later [s].
    pub to_s: f64,
    /// `first_from_last`.
    pub turn: UnitQuaternion<f64>,
}

/// How an inertial sensor is mounted and what it adds to what it measures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuCalibration {
    /// Rotation of its axes in the lidar frame.
    pub lidar_from_imu: UnitQuaternion<f64>,
    /// Time of the sensor's clock at the moment 0 of the scans' [s].
    pub offset_s: f64,
    /// Mean bias of the rates, about the axes of the sensor [rad/s].
    pub rate_bias_rad_s: Vector3<f64>,
    /// Root mean square of the remaining differences of an axis [rad/s].
    pub residual_rad_s: f64,
    /// Standard deviation of the rotation about its least certain axis [rad]; 0 where it is given.
    pub axes_sigma_rad: f64,
}

/// Why an inertial sensor is left out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum ImuRejection {
    #[error("the scans have no times")]
    NoTimes,
    #[error(
        "its times, {imu_first_s:.3} to {imu_last_s:.3} s, cover {covered} of {turns} motions between scans, from {first_s:.3} to {last_s:.3} s"
    )]
    NotCovered {
        imu_first_s: f64,
        imu_last_s: f64,
        covered: usize,
        turns: usize,
        first_s: f64,
        last_s: f64,
    },
    #[error("it is saturated: an axis stays at its largest value")]
    Saturated,
    #[error(
        "the sensor turns too little to compare it with the scans: {rate_deg_s:.2} deg/s about the mean"
    )]
    TooStill { rate_deg_s: f64 },
    #[error("its clock differs by more than {most_s} s from that of the scans; correct its times")]
    Offset { most_s: f64 },
    #[error("its axes are mirrored: they are left-handed; change the sign of one")]
    Mirrored,
    #[error(
        "its rates are not those of the scans: {residual_deg_s:.2} deg/s remain of {rate_deg_s:.2}{hint}"
    )]
    Unexplained {
        residual_deg_s: f64,
        rate_deg_s: f64,
        hint: String,
    },
    #[error("its rates are {scale:.2} times those of the scans; correct their unit")]
    Scaled { scale: f64 },
    #[error(
        "the drive does not show how it is mounted, to {sigma_deg:.0} deg; give its rotation with lidar_from_imu"
    )]
    AxesUnknown { sigma_deg: f64 },
    #[error("the drive of {duration_s:.1} s is too short to find the direction of gravity")]
    TooShort { duration_s: f64 },
    #[error(
        "its forces are not gravity and the acceleration of the scans: {residual_m_s2:.2} m/s² remain, with a bias of {bias_m_s2:.2} m/s²"
    )]
    Forces { residual_m_s2: f64, bias_m_s2: f64 },
}

impl ImuRejection {
    /// Whether the measurements contradict the scans; else these are too few, or turn too little.
    pub(crate) fn is_contradiction(&self) -> bool {
        match self {
            Self::NoTimes
            | Self::NotCovered { .. }
            | Self::TooStill { .. }
            | Self::AxesUnknown { .. }
            | Self::TooShort { .. } => false,
            Self::Saturated
            | Self::Offset { .. }
            | Self::Mirrored
            | Self::Unexplained { .. }
            | Self::Scaled { .. }
            | Self::Forces { .. } => true,
        }
    }
}

/// Largest offset between the clocks, and of those that are tried [s].
const MAX_OFFSET_S: f64 = 0.28;
const TRIED_S: f64 = 0.3;

impl ImuCalibration {
    /// Estimates what is unknown about a sensor from rotations of the lidar.
    ///
    /// # Errors
    /// The sensor has not measured these rotations, or they are too small to see it.
    pub fn estimate(imu: &Imu, turns: &[MeasuredTurn]) -> Result<Self, ImuRejection> {
        /// Least number of turns.
        const LEAST: usize = 30;
        /// Differences that are dropped as errors of a single turn, in medians.
        const OUTLIER: f64 = 4.0;
        let samples = &*imu.samples;
        let unbiased = Vector3::zeros();
        let covered = rates(samples, turns, 0.0, &unbiased).len();
        if covered < LEAST {
            let [imu_first_s, imu_last_s] = imu.samples.span_s();
            return Err(ImuRejection::NotCovered {
                imu_first_s,
                imu_last_s,
                covered,
                turns: turns.len(),
                first_s: turns.first().map_or(0.0, |turn| turn.from_s),
                last_s: turns.last().map_or(0.0, |turn| turn.to_s),
            });
        }
        if imu.samples.is_saturated() {
            return Err(ImuRejection::Saturated);
        }
        let given = imu.lidar_from_imu;
        let (offset_s, fit) = best_offset(samples, turns, given, &unbiased);
        let differences = |turn: &MeasuredTurn| {
            let rates = rates(samples, std::slice::from_ref(turn), offset_s, &unbiased);
            rates.first().map(|pair| fit.difference(pair).norm())
        };
        let usual = median(turns.iter().filter_map(differences)).unwrap_or_default();
        let is_kept = |turn: &&MeasuredTurn| {
            differences(turn).is_some_and(|difference| difference <= OUTLIER * usual)
        };
        let kept: Vec<MeasuredTurn> = turns.iter().filter(is_kept).copied().collect();
        // The rotation over a long turn depends on the bias by more than its mean.
        let about_rad_s = fit.bias_rad_s;
        let (offset_s, fit) = best_offset(samples, &kept, given, &about_rad_s);
        if let Some(given) = given
            && !fit.is_still()
            && !fit.is_scaled()
            && !fit.is_explained()
        {
            let (_, free) = best_offset(samples, turns, None, &about_rad_s);
            let turned_rad = free.lidar_from_imu.angle_to(&given);
            let turned_deg = free.is_explained().then_some(turned_rad.to_degrees());
            return Err(fit.unexplained(turned_deg));
        }
        fit.check(given)?;
        if offset_s.abs() > MAX_OFFSET_S {
            return Err(ImuRejection::Offset {
                most_s: MAX_OFFSET_S,
            });
        }
        Ok(Self {
            lidar_from_imu: fit.lidar_from_imu,
            offset_s,
            rate_bias_rad_s: about_rad_s + fit.bias_rad_s,
            residual_rad_s: fit.residual_rad_s,
            axes_sigma_rad: if given.is_some() { 0.0 } else { fit.sigma_rad },
        })
    }
}

/// The fit at the offset of the clocks that fits best, with a bias that is about known.
fn best_offset(
    samples: &ImuSamples,
    turns: &[MeasuredTurn],
    given: Option<UnitQuaternion<f64>>,
    bias_rad_s: &Vector3<f64>,
) -> (f64, Fit) {
    const COARSE_S: f64 = 0.02;
    const FINE_S: f64 = 0.002;
    let fit = |offset_s: f64| Fit::new(&rates(samples, turns, offset_s, bias_rad_s), given);
    let error = |offset_s: f64| fit(offset_s).residual_rad_s;
    let around = |middle_s: f64, step_s: f64, steps: i32| {
        let offsets = (-steps..=steps).map(|step| middle_s + f64::from(step) * step_s);
        let errors: Vec<(f64, f64)> = offsets
            .map(|offset_s| (error(offset_s), offset_s))
            .collect();
        let best = errors.iter().min_by(|a, b| a.0.total_cmp(&b.0));
        best.map_or(middle_s, |best| best.1)
    };
    let coarse_s = around(0.0, COARSE_S, (TRIED_S / COARSE_S).round() as i32);
    let fine_s = around(coarse_s, FINE_S, (COARSE_S / FINE_S) as i32);
    // The vertex of the parabola through the best offset and its neighbours.
    let [before, middle, after] =
        [-FINE_S, 0.0, FINE_S].map(|step_s| error(fine_s + step_s).powi(2));
    let curvature = before + after - 2.0 * middle;
    let vertex = 0.5 * (before - after) / curvature;
    let offset_s = if vertex.abs() <= 1.0 {
        fine_s + vertex * FINE_S
    } else {
        fine_s
    };
    (offset_s, fit(offset_s))
}

/// Mean rates of the lidar and of the sensor over the same time [rad/s].
type RatePair = [Vector3<f64>; 2];

/// Pairs of rates over the turns that are covered at an offset between the clocks; those of the sensor are without a bias.
fn rates(
    samples: &ImuSamples,
    turns: &[MeasuredTurn],
    offset_s: f64,
    bias_rad_s: &Vector3<f64>,
) -> Vec<RatePair> {
    (turns.iter())
        .filter_map(|turn| {
            let [from_s, to_s] = [turn.from_s, turn.to_s].map(|time_s| time_s + offset_s);
            let measured = samples.turn(from_s, to_s, bias_rad_s)?;
            let duration_s = turn.to_s - turn.from_s;
            let rate = |turn: UnitQuaternion<f64>| turn.scaled_axis() / duration_s;
            (duration_s > 0.0).then(|| [rate(turn.turn), rate(measured)])
        })
        .collect()
}

/// Largest share of the squares of rates that may remain.
const MAX_REMAINING: f64 = 0.4;

/// Axes and bias that fit pairs of rates best.
struct Fit {
    lidar_from_imu: UnitQuaternion<f64>,
    bias_rad_s: Vector3<f64>,
    residual_rad_s: f64,
    /// Root mean square of the rates of an axis about their means, of the lidar and of the sensor [rad/s].
    signals_rad_s: [f64; 2],
    sigma_rad: f64,
    /// Decrease of the squares by a reflection, in variances.
    mirror_gain: f64,
    /// Ratio of the rates of the sensor to those of the lidar, about any axes (unitless).
    scale: f64,
    /// Bounds of the ratio: the lower one if all noise is that of the sensor, the upper one if all is that of the lidar.
    scale_bounds: [f64; 2],
    /// Relative standard deviation of the ratio.
    scale_sigma: f64,
    /// Share of the squares that remains if the ratio is taken into account.
    remaining_of_scaled: f64,
}

impl Fit {
    fn new(rates: &[RatePair], given: Option<UnitQuaternion<f64>>) -> Self {
        let count = rates.len().max(1) as f64;
        let [mean_x, mean_y] =
            [0, 1].map(|of| rates.iter().map(|pair| pair[of]).sum::<Vector3<f64>>() / count);
        let (mut common, mut spread) = (Matrix3::zeros(), Matrix3::zeros());
        let mut squares_x = 0.0;
        for [x, y] in rates {
            let (x, y) = (x - mean_x, y - mean_y);
            common += x * y.transpose();
            spread += y * y.transpose();
            squares_x += x.norm_squared();
        }
        let squares_y = spread.trace();
        let remaining = |rotation: &Matrix3<f64>| {
            (squares_x + squares_y - 2.0 * (rotation.transpose() * common).trace()).max(0.0)
        };
        let root = |squares: f64| (squares / (3.0 * count)).sqrt();
        let (free, mirrored) = nearest_rotations(&common);
        let axes = given.map_or(free, |given| *given.to_rotation_matrix().matrix());
        let squares = remaining(&axes);
        let variance = (squares / (3.0 * count)).max(1e-18);
        let lidar_from_imu = given.unwrap_or_else(|| {
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(free))
        });
        // Information of a small rotation: Σ |y|² − y yᵀ. Neighbouring errors are correlated: four count as one.
        let information = (Matrix3::identity() * squares_y - spread) / (4.0 * variance);
        let least = information.symmetric_eigenvalues().min().max(1e-12);
        // Umeyama's c is aligned / squares_y.
        let aligned = (free.transpose() * common).trace().max(1e-18);
        let [squares_x, squares_y] = [squares_x, squares_y].map(|squares| squares.max(1e-18));
        let remaining_of_scaled = (1.0 - aligned / squares_x * (aligned / squares_y)).max(0.0);
        Self {
            lidar_from_imu,
            bias_rad_s: mean_y - lidar_from_imu.inverse() * mean_x,
            residual_rad_s: root(squares),
            signals_rad_s: [squares_x, squares_y].map(root),
            sigma_rad: least.sqrt().recip(),
            mirror_gain: (remaining(&free) - remaining(&mirrored)) / variance,
            scale: (squares_y / squares_x).sqrt(),
            scale_bounds: [aligned / squares_x, squares_y / aligned],
            scale_sigma: (4.0 * remaining_of_scaled / (3.0 * count)).sqrt(),
            remaining_of_scaled,
        }
    }

    fn difference(&self, [x, y]: &RatePair) -> Vector3<f64> {
        x - self.lidar_from_imu * (y - self.bias_rad_s)
    }

    /// Whether nothing turns that could be compared: the lidar no more than its errors, the sensor less.
    fn is_still(&self) -> bool {
        /// Rates of an axis about its mean [rad/s].
        const LIDAR_RAD_S: f64 = 0.05;
        const SENSOR_RAD_S: f64 = 0.01;
        self.signals_rad_s[0] < LIDAR_RAD_S && self.signals_rad_s[1] < SENSOR_RAD_S
    }

    /// Whether the rates of the sensor are those of the lidar.
    fn is_explained(&self) -> bool {
        self.residual_rad_s.powi(2) <= MAX_REMAINING * self.signals_rad_s[0].powi(2)
    }

    /// Whether they are those of the lidar but for their scale.
    fn is_scaled(&self) -> bool {
        /// Largest error of the scale: three times that of an MPU-6050 by its data sheet, 3 % (unitless).
        const MAX_ERROR: f64 = 0.1;
        const SIGMAS: f64 = 3.0;
        let [least, most] = self.scale_bounds;
        let margin = MAX_ERROR + SIGMAS * self.scale_sigma;
        self.remaining_of_scaled <= MAX_REMAINING
            && (least > 1.0 + margin || most * (1.0 + margin) < 1.0)
    }

    /// The rejection of a sensor whose rates are others, unless its axes are turned.
    fn unexplained(&self, turned_deg: Option<f64>) -> ImuRejection {
        let hint = |deg| format!("; they are, with axes turned by {deg:.0} deg");
        ImuRejection::Unexplained {
            residual_deg_s: self.residual_rad_s.to_degrees(),
            rate_deg_s: self.signals_rad_s[0].to_degrees(),
            hint: turned_deg.map_or(String::new(), hint),
        }
    }

    /// Refuses a sensor that does not fit.
    fn check(&self, given: Option<UnitQuaternion<f64>>) -> Result<(), ImuRejection> {
        /// Decrease of the squares by a reflection that is no chance, in variances.
        const MIRRORED: f64 = 100.0;
        /// Largest standard deviation of the axes [deg].
        const MAX_SIGMA_DEG: f64 = 5.0;
        if self.is_still() {
            let rate_deg_s = self.signals_rad_s[0].to_degrees();
            return Err(ImuRejection::TooStill { rate_deg_s });
        }
        if self.mirror_gain > MIRRORED {
            return Err(ImuRejection::Mirrored);
        }
        if self.is_scaled() {
            return Err(ImuRejection::Scaled { scale: self.scale });
        }
        if !self.is_explained() {
            return Err(self.unexplained(None));
        }
        let sigma_deg = self.sigma_rad.to_degrees();
        if given.is_none() && sigma_deg > MAX_SIGMA_DEG {
            return Err(ImuRejection::AxesUnknown { sigma_deg });
        }
        Ok(())
    }
}

/// The rotation that maximizes the trace of its transpose and a matrix, and the best of both signs of the determinant.
fn nearest_rotations(matrix: &Matrix3<f64>) -> (Matrix3<f64>, Matrix3<f64>) {
    let svd = matrix.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return (Matrix3::identity(), Matrix3::identity());
    };
    let best = u * v_t;
    let signs = Vector3::new(1.0, 1.0, best.determinant().signum());
    // The singular values descend: the sign of the smallest costs least.
    (u * Matrix3::from_diagonal(&signs) * v_t, best)
}

#[cfg(test)]
#[path = "calibration_tests.rs"]
mod tests;
