//! Linearized residuals, and what they show of the horizontal position.
//!
//! Normals of the map have noise, and along a tunnel it would count as information. Of each horizontal direction, W σₙ² is taken off
//! for a sum W of weights (errors in variables: Fuller, *Measurement Error Models*, 1987), and where that is much of it, the noise may
//! be larger: a guard rail that few scans have mapped has ripples, in the pattern of those scans. What the linearized residuals expect
//! is compared with what is observed: the cost of rays that are cast anew from both sides of the pose. Ripples make it no higher.
//!
//! ```text
//! q = Σ [ρ(rᵢ(±d)) − ρ(rᵢ(0))] / Σ [ρ(rᵢ(0) ± Jᵢ d) − ρ(rᵢ(0))]  in 0..1        kept: q · found − W σₙ²
//! ```
//!
//! with the cost ρ of the kernel and a shift d. Only the covariance is corrected by q, not the step.
//!
//! Efron and Hinkley, *Assessing the Accuracy of the Maximum Likelihood Estimator: Observed Versus Expected Fisher Information* (1978).

use nalgebra::{Matrix2, Matrix6, Matrix6x2, Vector2, Vector6};

use crate::geometry::RobustKernel;

/// The linearized residual of one beam.
#[derive(Clone)]
pub(super) struct Residual {
    /// Number of the beam among those that are registered.
    pub beam: usize,
    /// Distance to the plane of the surface [m].
    pub value_m: f64,
    /// By (x, y, z, roll, pitch, yaw) in the lidar frame.
    pub jacobian: Vector6<f64>,
    /// Sector of the azimuth.
    pub sector: usize,
}

/// What the scan shows of the horizontal position, without what the noise of the normals seems to show.
pub(super) struct Horizontal {
    /// Directions in the lidar frame.
    directions: Matrix2<f64>,
    /// Information on each direction while all other components are estimated, too.
    found: Vector2<f64>,
    /// The part of it that is not noise, positive.
    kept: Vector2<f64>,
    /// The part of each that is not information.
    noise: f64,
    /// Covariance of all components with the horizontal ones, noise included.
    covariance: Matrix6x2<f64>,
}

impl Horizontal {
    /// Splits the information of residuals; `noise` is the part of each direction that is not information. `None` if it is
    /// singular.
    pub fn new(information: &Matrix6<f64>, noise: f64) -> Option<Self> {
        let covariance = information.try_inverse()?;
        let horizontal = covariance.fixed_view::<2, 2>(0, 0).into_owned();
        let eigen = horizontal.try_inverse()?.symmetric_eigen();
        Some(Self {
            directions: eigen.eigenvectors,
            found: eigen.eigenvalues,
            kept: eigen.eigenvalues.map(|found| kept(found, 1.0, noise)),
            noise,
            covariance: covariance.fixed_columns::<2>(0).into_owned(),
        })
    }

    /// The information without that of the noise.
    pub fn corrected(&self, information: &Matrix6<f64>) -> Matrix6<f64> {
        let noise = Matrix2::from_diagonal(&(self.found - self.kept));
        let mut corrected = *information;
        let mut part = corrected.fixed_view_mut::<2, 2>(0, 0);
        part -= self.directions * noise * self.directions.transpose();
        corrected
    }

    /// A step without the directions of which only noise is known (Zhang, Kaess and Singh, *On Degeneracy of
    /// Optimization-based State Estimation Problems*, 2016).
    pub fn determined(&self, mut step: Vector6<f64>) -> Vector6<f64> {
        let shares = Matrix2::from_diagonal(&self.kept.component_div(&self.found));
        let mut part = step.fixed_rows_mut::<2>(0);
        let moved = self.directions * shares * self.directions.transpose() * &part;
        part.copy_from(&moved);
        step
    }

    /// Numbers of the directions of which a tenth or more may be noise, but not all.
    pub fn doubtful(&self) -> impl Iterator<Item = usize> + use<> {
        /// Least share of the noise: `docs/method.md`, Thresholds.
        const NOISE_SHARE: f64 = 0.1;
        let (found, noise) = (self.found, self.noise);
        (0..2).filter(move |&axis| (NOISE_SHARE..1.0).contains(&(noise / found[axis])))
    }

    /// A unit shift in a direction, in which all other components follow as the residuals want it.
    pub fn unit_shift(&self, axis: usize) -> Vector6<f64> {
        self.covariance * (self.directions.column(axis) * self.found[axis])
    }

    /// Keeps a share of the information that was found on a direction, less the noise.
    pub fn observe(&mut self, axis: usize, share: f64) {
        self.kept[axis] = kept(self.found[axis], share, self.noise);
    }
}

/// The part of what was found that is kept; a thousandth at least, so that the matrix stays positive definite.
fn kept(found: f64, share: f64, noise: f64) -> f64 {
    const LEAST: f64 = 1e-3;
    (share * found - noise).max(LEAST * found)
}

/// How much the cost of residuals rises, of what the linearized ones expect, 0 to 1: `shifted` are pairs of a shift and the residuals
/// there. Beams that have none there count as expected.
pub(super) fn observed_share(
    residuals: &[Residual],
    shifted: &[(Vector6<f64>, Vec<Residual>)],
    kernel: RobustKernel,
) -> f64 {
    let (mut observed, mut expected) = (0.0, 0.0);
    for (shift, there) in shifted {
        let mut there = there.iter().peekable();
        for residual in residuals {
            let here = kernel.cost(residual.value_m);
            let rise = kernel.cost(residual.value_m + residual.jacobian.dot(shift)) - here;
            while there.next_if(|it| it.beam < residual.beam).is_some() {}
            let found = there.next_if(|it| it.beam == residual.beam);
            expected += rise;
            observed += found.map_or(rise, |it| kernel.cost(it.value_m) - here);
        }
    }
    if expected > 0.0 {
        (observed / expected).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Residuals of a wall along x with ripples, of a sensor that is shifted along it; returns follow a share of the ripples.
    fn wall(shift_m: f64, followed: f64) -> Vec<Residual> {
        const AMPLITUDE_M: f64 = 0.01;
        const WAVE_PER_M: f64 = 8.0;
        let ripple = |beam: usize| {
            let phase = 2.4 * beam as f64;
            let here = (phase + WAVE_PER_M * shift_m).sin() - followed * phase.sin();
            let slope = AMPLITUDE_M * WAVE_PER_M * (phase + WAVE_PER_M * shift_m).cos();
            Residual {
                beam,
                value_m: AMPLITUDE_M * here,
                jacobian: Vector6::new(slope, 1.0, 0.0, 0.0, 0.0, 0.0),
                sector: 0,
            }
        };
        (0..1000).map(ripple).collect()
    }

    #[test]
    fn ripples_raise_the_cost_as_far_as_returns_follow_them() {
        const KERNEL: RobustKernel = RobustKernel { scale_m: 0.1 };
        for (followed, least, most) in [(0.0, 0.0, 0.05), (0.5, 0.4, 0.6), (1.0, 0.9, 1.0)] {
            let side = |shift_m| (shift_m * Vector6::x(), wall(shift_m, followed));
            let share = observed_share(&wall(0.0, followed), &[-0.05, 0.05].map(side), KERNEL);
            assert!((least..=most).contains(&share), "{followed} {share}");
        }
    }

    #[test]
    fn beams_without_residuals_on_a_side_are_as_expected_and_nothing_expected_is_nothing_observed()
    {
        const KERNEL: RobustKernel = RobustKernel { scale_m: 0.1 };
        let sides = |kept: usize| {
            [-0.05, 0.05].map(|shift_m| {
                let mut there = wall(shift_m, 0.0);
                there.retain(|residual| residual.beam % 4 < kept);
                (shift_m * Vector6::x(), there)
            })
        };
        let share = |kept| observed_share(&wall(0.0, 0.0), &sides(kept), KERNEL);
        assert_eq!(share(0), 1.0);
        assert!((0.4..0.6).contains(&share(2)), "{}", share(2));
        assert_eq!(observed_share(&wall(0.0, 0.0), &[], KERNEL), 0.0);
    }

    /// Independent information along x, and 1000 on all else.
    fn information(along: f64) -> Matrix6<f64> {
        let mut information = Matrix6::identity() * 1000.0;
        information[(0, 0)] = along;
        information
    }

    #[test]
    fn directions_are_doubtful_where_a_tenth_to_all_of_what_is_found_may_be_noise() {
        for (along, noise, expected) in [
            (9.0, 1.0, 1),
            (11.0, 1.0, 0),
            (1000.0, 1.0, 0),
            (9.0, 10.0, 0),
        ] {
            let horizontal = Horizontal::new(&information(along), noise).unwrap();
            assert_eq!(horizontal.doubtful().count(), expected, "{along} {noise}");
        }
    }

    #[test]
    fn of_what_was_found_the_observed_share_is_kept_less_the_noise() {
        let information = information(9.0);
        let mut horizontal = Horizontal::new(&information, 1.0).unwrap();
        let axis = horizontal.doubtful().next().unwrap();
        horizontal.observe(axis, 0.5);
        let corrected = horizontal.corrected(&information);
        assert!((corrected[(0, 0)] - 3.5).abs() < 1e-9, "{corrected}");
        horizontal.observe(axis, 0.0);
        assert!(horizontal.corrected(&information).cholesky().is_some());
    }

    #[test]
    fn in_a_unit_shift_the_other_components_follow_to_where_nothing_pulls_them() {
        let mut information = information(9.0);
        for (row, column) in [(0, 4), (4, 0)] {
            information[(row, column)] = 20.0;
        }
        let horizontal = Horizontal::new(&information, 1.0).unwrap();
        let axis = horizontal.doubtful().next().unwrap();
        let shift = horizontal.unit_shift(axis);
        assert!((shift.xy().norm() - 1.0).abs() < 1e-9, "{shift}");
        assert!(shift[4].abs() > 0.01, "{shift}");
        let pull = information * shift;
        assert!(pull.fixed_rows::<4>(2).norm() < 1e-9, "{pull}");
        assert!((shift.dot(&pull) - horizontal.found[axis]).abs() < 1e-9);
    }
}
