//! Alignment of a path with the fixes of a receiver: rotation and origin of the map on the Earth.
//!
//! ```text
//! rᵢ = qᵢ − (t + R pᵢ)        pᵢ: antenna in the map when fix i was measured, qᵢ: the fix, east north up
//! Σ ρ(|rᵢ| / σᵢ) / nᵢ + (tilt of R / 1°)² → min        nᵢ = max(1, 2 τ / Δtᵢ)
//! ```
//!
//! The errors of a receiver are correlated in time. With an exponential correlation of time constant τ, the mean over a long
//! time T has the variance 2 τ σ² / T, so that fixes at intervals Δt count as one in n: the more often a receiver
//! measures, the less each fix counts. ρ is Geman-McClure's kernel of three standard deviations, or of the residuals where
//! these are larger, which narrows from the largest residual (graduated non-convexity), so that reflected signals lose
//! their weight.
//!
//! Brown and Hwang, *Introduction to Random Signals and Applied Kalman Filtering* (2012), section 2.6, for the process;
//! Yang et al., *Graduated Non-Convexity for Robust Spatial Perception* (RA-L 2020).

use nalgebra::{Matrix3, Matrix6, Rotation3, UnitQuaternion, Vector2, Vector3, Vector6};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::Georeference;
use super::earth::{ProjectionError, UtmZone, Wgs84};
use super::fix::GeodeticFixes;
use crate::geometry::Pose3;
use crate::geometry::robust_kernel::RobustKernel;
use crate::statistics::median;
use crate::validation::{InvalidValue, Validate, in_range, require};

/// Errors of a receiver and place of its antenna.
///
/// Defaults: a receiver without corrections, between houses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct GnssConfig {
    /// Standard deviation of a fix along each horizontal axis, where the receiver gives none [m].
    #[default(1.5)]
    pub horizontal_m: f64,
    /// The same of the height [m].
    #[default(3.0)]
    pub vertical_m: f64,
    /// Time constant of the correlation of the errors [s].
    #[default(30.0)]
    pub correlation_s: f64,
    /// Position x, y, z of the antenna in the lidar frame [m]; `None`: that of the recording, else that of the lidar.
    pub antenna_m: Option<[f64; 3]>,
    /// Time to add to those of the fixes, so that they are of the clock of the scans [s].
    pub clock_offset_s: f64,
}

impl Validate for GnssConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("horizontal_m", self.horizontal_m, 0.001..=1000.0)?;
        in_range("vertical_m", self.vertical_m, 0.001..=1000.0)?;
        in_range("correlation_s", self.correlation_s, 0.0..=10_000.0)?;
        in_range("clock_offset_s", self.clock_offset_s, -1e10..=1e10)?;
        let antenna_m = self.antenna_m.unwrap_or_default();
        require(
            antenna_m.iter().all(|m| m.abs() <= 1000.0),
            "antenna_m",
            format!("{antenna_m:?}"),
            "x, y, z must be within 1000 m",
        )
    }
}

/// Poses in a map with their times, which ascend.
#[derive(Clone, Copy, Debug)]
pub struct PathOverTime<'a> {
    /// Times of the poses, by the clock of the scans [s].
    pub times_s: &'a [f64],
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: &'a [Pose3],
}

/// Why a path cannot be aligned with fixes.
#[derive(Debug, thiserror::Error)]
pub enum AlignmentError {
    /// Too few fixes were measured along the path.
    #[error(
        "{matched} of {fixes} fixes were measured along the path, at least {least} are needed: the fixes are from {first_fix_s:.3} to {last_fix_s:.3} s and the scans from {first_pose_s:.3} to {last_pose_s:.3} s; give fixes of this recording, or set clock_offset_s to the difference of the clocks"
    )]
    TooFew {
        /// Fixes along the path.
        matched: usize,
        /// All fixes.
        fixes: usize,
        /// Number that is needed.
        least: usize,
        /// Time of the first fix [s].
        first_fix_s: f64,
        /// Time of the last fix [s].
        last_fix_s: f64,
        /// Time of the first pose [s].
        first_pose_s: f64,
        /// Time of the last pose [s].
        last_pose_s: f64,
    },
    /// The path is too short for the errors of the fixes.
    #[error(
        "the heading of the map on the Earth is known to {heading_deg:.0} degrees only: the path is too short, or the fixes are too inaccurate for it; drive farther, or lower horizontal_m if the receiver is better"
    )]
    NoHeading {
        /// Standard deviation of the heading [deg].
        heading_deg: f64,
    },
    /// A fix is not on the Earth.
    #[error(transparent)]
    Projection(#[from] ProjectionError),
}

/// What an alignment has found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct AlignmentSummary {
    /// Fixes along the path.
    pub fixes: usize,
    /// Those that contradict the others, such as reflected signals.
    pub outliers: usize,
    /// Root mean square of the horizontal distances of the others from the path [m].
    pub horizontal_rms_m: f64,
    /// The same of the heights [m].
    pub vertical_rms_m: f64,
}

/// A fix in the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FixTarget {
    /// Row of the pose at or before the fix.
    pub row: usize,
    /// Antenna in the map, by the path.
    pub antenna_in_map: Vector3<f64>,
    /// The fix in the map.
    pub fix_in_map: Vector3<f64>,
    /// Standard deviations, horizontal and vertical [m].
    pub sigmas_m: [f64; 2],
    /// Share with which the fix counts for its correlation with the others, 0 to 1.
    pub share: f64,
}

impl FixTarget {
    /// The fix from the antenna, horizontal and vertical, in standard deviations.
    pub fn deviations(&self) -> [f64; 2] {
        let residual = self.fix_in_map - self.antenna_in_map;
        normalized(&residual, self.sigmas_m)
    }
}

/// A path on the Earth.
#[derive(Clone, Debug)]
pub struct AlignedPath {
    /// The place of the map.
    pub georeference: Georeference,
    /// What the fixes show.
    pub summary: AlignmentSummary,
    /// The fixes along the path, in the map.
    pub targets: Vec<FixTarget>,
}

/// Finds the place of a map on the Earth from a path in it.
///
/// # Errors
/// Too few fixes were measured along the path, or it is too short for a heading.
pub fn align(
    path: PathOverTime,
    fixes: &GeodeticFixes,
    config: &GnssConfig,
) -> Result<AlignedPath, AlignmentError> {
    /// Smallest number of fixes.
    const LEAST: usize = 3;
    let wgs84 = Wgs84::new()?;
    let observations = observations(path, fixes, config);
    let ends = |times_s: &[f64]| (times_s.first().copied(), times_s.last().copied());
    let Some(first) = observations.first().filter(|_| observations.len() >= LEAST) else {
        let fix_times_s: Vec<f64> = fixes.fixes.iter().map(|fix| fix.time_s).collect();
        let (first_fix_s, last_fix_s) = ends(&fix_times_s);
        let (first_pose_s, last_pose_s) = ends(path.times_s);
        return Err(AlignmentError::TooFew {
            matched: observations.len(),
            fixes: fixes.fixes.len(),
            least: LEAST,
            first_fix_s: first_fix_s.unwrap_or_default(),
            last_fix_s: last_fix_s.unwrap_or_default(),
            first_pose_s: first_pose_s.unwrap_or_default(),
            last_pose_s: last_pose_s.unwrap_or_default(),
        });
    };
    // A level frame at the first fix; the Earth's curvature is in it, since it is Cartesian.
    let anchor = fixes.fixes[first.fix].position;
    let ecef_from_enu = wgs84.ecef_from_enu(&anchor)?;
    let enu_from_ecef = ecef_from_enu.inverse();
    let fixes_in_enu: Vec<Vector3<f64>> = (observations.iter())
        .map(|it| {
            let ecef = wgs84.ecef(&fixes.fixes[it.fix].position)?;
            Ok(enu_from_ecef.transform_point(&ecef.into()).coords)
        })
        .collect::<Result<_, ProjectionError>>()?;
    let fit = Fit::of(&observations, &fixes_in_enu);
    /// Largest standard deviation of the heading [deg].
    const MOST_HEADING_DEG: f64 = 10.0;
    let heading_deg = fit.heading_rad.to_degrees();
    if heading_deg > MOST_HEADING_DEG {
        return Err(AlignmentError::NoHeading { heading_deg });
    }
    let map_from_enu = fit.enu_from_map.inverse();
    let targets = (observations.iter().zip(&fixes_in_enu))
        .map(|(it, fix)| FixTarget {
            row: it.row,
            antenna_in_map: it.antenna_in_map,
            fix_in_map: map_from_enu.transform_point(&(*fix).into()).coords,
            sigmas_m: it.sigmas_m,
            share: it.share,
        })
        .collect();
    let ecef_from_map = ecef_from_enu * fit.enu_from_map;
    Ok(AlignedPath {
        georeference: fit.georeference(&wgs84, &ecef_from_map, fixes)?,
        summary: fit.summary(&observations, &fixes_in_enu),
        targets,
    })
}

/// A fix along a path.
#[derive(Clone, Copy, Debug)]
struct Observation {
    fix: usize,
    row: usize,
    antenna_in_map: Vector3<f64>,
    sigmas_m: [f64; 2],
    share: f64,
}

/// The fixes that were measured along a path.
fn observations(
    path: PathOverTime,
    fixes: &GeodeticFixes,
    config: &GnssConfig,
) -> Vec<Observation> {
    /// Longest time between poses across which they are interpolated [s].
    const MAX_GAP_S: f64 = 2.0;
    let antenna = config.antenna_m.or(fixes.antenna_m).unwrap_or_default();
    let times_s = path.times_s;
    let mut found: Vec<Observation> = vec![];
    for (number, fix) in fixes.fixes.iter().enumerate() {
        let time_s = fix.time_s + config.clock_offset_s;
        let after = times_s.partition_point(|&it| it <= time_s);
        // A fix at the last pose belongs to the last interval.
        let after = if times_s.last() == Some(&time_s) {
            after - 1
        } else {
            after
        };
        let Some(row) = after.checked_sub(1).filter(|_| after < times_s.len()) else {
            continue;
        };
        let interval_s = times_s[after] - times_s[row];
        if interval_s > MAX_GAP_S {
            continue;
        }
        let share = (time_s - times_s[row]) / interval_s;
        let [before, next] = [row, after].map(|row| &path.map_from_lidar[row]);
        let rotation = before.rotation.nlerp(&next.rotation, share);
        let position = before
            .translation
            .vector
            .lerp(&next.translation.vector, share);
        found.push(Observation {
            fix: number,
            row,
            antenna_in_map: position + rotation * Vector3::from(antenna),
            sigmas_m: [
                fix.horizontal_m.unwrap_or(config.horizontal_m),
                fix.vertical_m.unwrap_or(config.vertical_m),
            ],
            share: 1.0,
        });
    }
    let times_s: Vec<f64> = (found.iter())
        .map(|it| fixes.fixes[it.fix].time_s)
        .collect();
    for (number, it) in found.iter_mut().enumerate() {
        let before_s = times_s[number.saturating_sub(1)];
        let after_s = times_s[(number + 1).min(times_s.len() - 1)];
        let neighbours = if number == 0 || number + 1 == times_s.len() {
            1.0
        } else {
            2.0
        };
        let interval_s = (after_s - before_s) / neighbours;
        it.share = (interval_s / (2.0 * config.correlation_s)).min(1.0);
    }
    found.retain(|it| it.share > 0.0);
    found
}

/// Horizontal and vertical length of a residual in standard deviations.
fn normalized(residual: &Vector3<f64>, [horizontal_m, vertical_m]: [f64; 2]) -> [f64; 2] {
    let horizontal = residual.xy().norm() / horizontal_m;
    [horizontal, residual.z.abs() / vertical_m]
}

/// Weights of residuals, horizontal and vertical, by robust kernels that are at least `widest` wide [standard deviations].
pub fn robust_weights(deviations: &[[f64; 2]], widest: f64) -> Vec<[f64; 2]> {
    let kernels = kernels(deviations).map(|scale_m| RobustKernel {
        scale_m: scale_m.max(widest),
    });
    (deviations.iter())
        .map(|[horizontal, vertical]| {
            let weight = kernels[0].weight(*horizontal);
            // A reflected signal has a wrong height, too.
            [weight, weight * kernels[1].weight(*vertical)]
        })
        .collect()
}

/// Scales of the kernels, horizontal and vertical [standard deviations].
fn kernels(deviations: &[[f64; 2]]) -> [f64; 2] {
    /// Kernel in robust standard deviations.
    const SIGMAS: f64 = 3.0;
    /// Median of the length of a normal vector in the plane, and of a normal number.
    const MEDIANS: [f64; 2] = [1.177, 0.6745];
    [0, 1].map(|axis| {
        let median = median(deviations.iter().map(|it| it[axis])).unwrap_or_default();
        SIGMAS * f64::max(median / MEDIANS[axis], 1.0)
    })
}

/// Rotation and position of a path on the Earth.
struct Fit {
    enu_from_map: Pose3,
    weights: Vec<[f64; 2]>,
    horizontal_m: f64,
    vertical_m: f64,
    heading_rad: f64,
}

impl Fit {
    fn of(observations: &[Observation], fixes_in_enu: &[Vector3<f64>]) -> Self {
        /// The kernel narrows by this factor per iteration.
        const NARROWING: f64 = 1.6;
        const MAX_ITERATIONS: usize = 100;
        /// Largest last step [m, rad].
        const TOLERANCE: f64 = 1e-9;
        let mut state = State::initial(observations, fixes_in_enu);
        let deviations = state.deviations(observations, fixes_in_enu);
        let mut widest = 2.0 * deviations.iter().flatten().copied().fold(0.0, f64::max);
        let mut weights = vec![[1.0; 2]; observations.len()];
        for _ in 0..MAX_ITERATIONS {
            let deviations = state.deviations(observations, fixes_in_enu);
            weights = robust_weights(&deviations, widest);
            let is_narrow = widest <= kernels(&deviations).into_iter().fold(f64::MAX, f64::min);
            let step = state.step(observations, fixes_in_enu, &weights);
            if is_narrow && step < TOLERANCE {
                break;
            }
            widest /= NARROWING;
        }
        // Residuals larger than their standard deviations show that these are too small.
        let scales = kernels(&state.deviations(observations, fixes_in_enu)).map(|it| it / 3.0);
        let (matrix, _) = state.equations(observations, fixes_in_enu, &weights);
        let covariance = matrix.try_inverse().unwrap_or_else(Matrix6::identity);
        let variance = |axis: usize| covariance[(axis, axis)].max(0.0);
        Self {
            enu_from_map: state.enu_from_map(),
            weights,
            horizontal_m: scales[0] * (variance(0) + variance(1)).sqrt(),
            vertical_m: scales[1] * variance(2).sqrt(),
            heading_rad: scales[0] * variance(5).sqrt(),
        }
    }

    fn georeference(
        &self,
        wgs84: &Wgs84,
        ecef_from_map: &Pose3,
        fixes: &GeodeticFixes,
    ) -> Result<Georeference, ProjectionError> {
        let origin = wgs84.geodetic(&ecef_from_map.translation.vector)?;
        let enu_from_map =
            wgs84.ecef_from_enu(&origin)?.rotation.inverse() * ecef_from_map.rotation;
        let (roll, pitch, yaw) = enu_from_map.euler_angles();
        Ok(Georeference {
            latitude_deg: origin.latitude_deg,
            longitude_deg: origin.longitude_deg,
            height_m: origin.height_m,
            height_above: fixes.height_above,
            roll_deg: roll.to_degrees(),
            pitch_deg: pitch.to_degrees(),
            yaw_deg: yaw.to_degrees(),
            utm: UtmZone::of(&origin),
            horizontal_m: self.horizontal_m,
            vertical_m: self.vertical_m,
            heading_deg: self.heading_rad.to_degrees(),
        })
    }

    fn summary(
        &self,
        observations: &[Observation],
        fixes_in_enu: &[Vector3<f64>],
    ) -> AlignmentSummary {
        /// Weight at the scale of the kernel.
        const LEAST_WEIGHT: f64 = 0.25;
        let residuals: Vec<Vector3<f64>> = (observations.iter().zip(fixes_in_enu))
            .zip(&self.weights)
            .filter(|(_, weights)| weights[0] >= LEAST_WEIGHT)
            .map(|((it, fix), _)| {
                let antenna = self.enu_from_map.transform_point(&it.antenna_in_map.into());
                fix - antenna.coords
            })
            .collect();
        let rms = |squares: f64| (squares / residuals.len().max(1) as f64).sqrt();
        AlignmentSummary {
            fixes: observations.len(),
            outliers: observations.len() - residuals.len(),
            horizontal_rms_m: rms(residuals.iter().map(|it| it.xy().norm_squared()).sum()),
            vertical_rms_m: rms(residuals.iter().map(|it| it.z.powi(2)).sum()),
        }
    }
}

/// A rotation about the centre of the path, and where this centre is.
struct State {
    center_in_map: Vector3<f64>,
    center_in_enu: Vector3<f64>,
    rotation: UnitQuaternion<f64>,
}

impl State {
    /// The horizontal rotation and the translation of least squares.
    fn initial(observations: &[Observation], fixes_in_enu: &[Vector3<f64>]) -> Self {
        let weights = || observations.iter().map(|it| it.share);
        let sum: f64 = weights().sum();
        let mean = |points: &mut dyn Iterator<Item = Vector3<f64>>| -> Vector3<f64> {
            points
                .zip(weights())
                .map(|(point, weight)| weight * point)
                .sum::<Vector3<f64>>()
                / sum
        };
        let center_in_map = mean(&mut observations.iter().map(|it| it.antenna_in_map));
        let center_in_enu = mean(&mut fixes_in_enu.iter().copied());
        let mut turn = Vector2::zeros();
        for (it, fix) in observations.iter().zip(fixes_in_enu) {
            let a = (it.antenna_in_map - center_in_map).xy();
            let b = (fix - center_in_enu).xy();
            turn += it.share * Vector2::new(a.dot(&b), a.perp(&b));
        }
        Self {
            center_in_map,
            center_in_enu,
            rotation: UnitQuaternion::from_euler_angles(0.0, 0.0, turn.y.atan2(turn.x)),
        }
    }

    fn enu_from_map(&self) -> Pose3 {
        let translation = self.center_in_enu - self.rotation * self.center_in_map;
        Pose3::from_parts(translation.into(), self.rotation)
    }

    /// The antenna from the centre, and the fix from the antenna, east north up.
    fn residual(&self, it: &Observation, fix: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
        let arm = self.rotation * (it.antenna_in_map - self.center_in_map);
        (arm, fix - self.center_in_enu - arm)
    }

    fn deviations(&self, observations: &[Observation], fixes: &[Vector3<f64>]) -> Vec<[f64; 2]> {
        (observations.iter().zip(fixes))
            .map(|(it, fix)| normalized(&self.residual(it, fix).1, it.sigmas_m))
            .collect()
    }

    /// Matrix and right side of the step: translation and rotation vector, east north up.
    fn equations(
        &self,
        observations: &[Observation],
        fixes: &[Vector3<f64>],
        weights: &[[f64; 2]],
    ) -> (Matrix6<f64>, Vector6<f64>) {
        /// Standard deviation of the tilt of the map, whose z axis is about up [deg].
        const TILT_DEG: f64 = 1.0;
        let mut matrix = Matrix6::zeros();
        let mut right_side = Vector6::zeros();
        for ((it, fix), weights) in observations.iter().zip(fixes).zip(weights) {
            let (arm, residual) = self.residual(it, fix);
            let information = [0, 1].map(|axis| {
                let sigma_m: f64 = it.sigmas_m[axis];
                it.share * weights[axis] / (sigma_m * sigma_m)
            });
            let [horizontal, vertical] = information;
            let information =
                Matrix3::from_diagonal(&Vector3::new(horizontal, horizontal, vertical));
            let mut jacobian = nalgebra::Matrix3x6::zeros();
            jacobian
                .fixed_view_mut::<3, 3>(0, 0)
                .copy_from(&Matrix3::identity());
            jacobian
                .fixed_view_mut::<3, 3>(0, 3)
                .copy_from(&-arm.cross_matrix());
            let weighted = jacobian.transpose() * information;
            matrix += weighted * jacobian;
            right_side += weighted * residual;
        }
        // The z axis of the map, east and north, changes by (ω_y, −ω_x).
        let up = self.rotation * Vector3::z();
        let information = TILT_DEG.to_radians().powi(-2);
        matrix[(3, 3)] += information;
        matrix[(4, 4)] += information;
        right_side[3] += information * up.y;
        right_side[4] -= information * up.x;
        (matrix, right_side)
    }

    /// Moves by a step of Gauss-Newton; returns its largest number [m, rad].
    fn step(
        &mut self,
        observations: &[Observation],
        fixes: &[Vector3<f64>],
        weights: &[[f64; 2]],
    ) -> f64 {
        let (matrix, right_side) = self.equations(observations, fixes, weights);
        let Some(factors) = matrix.cholesky() else {
            return 0.0;
        };
        let step = factors.solve(&right_side);
        self.center_in_enu += step.fixed_rows::<3>(0);
        let turn: Vector3<f64> = step.fixed_rows::<3>(3).into();
        self.rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::new(turn)) * self.rotation;
        step.amax()
    }
}

#[cfg(test)]
#[path = "alignment_tests.rs"]
mod tests;
