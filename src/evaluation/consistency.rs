//! Whether errors are as large as their covariances say.
//!
//! ```text
//! squared error   eᵀ Σ⁻¹ e,  e = (x, y, heading)        (aᵀ e)² / σ_a²  along each axis a of the covariance of the position
//! inside          share of the frames with  eᵀ Σ⁻¹ e ≤ 7.815,  95 % of χ² with 3 degrees of freedom
//! ```
//!
//! Where the errors are distributed as the covariances say, the means are 3 and 1, and 95 % are inside. Bar-Shalom, Li and
//! Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), section 5.4: normalized estimation error squared.

use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

use super::planar::PlanarError;

/// 95 % quantile of χ² with three degrees of freedom.
const QUANTILE: f64 = 7.815;

/// Errors of poses against their covariances.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct Consistency {
    /// Number of frames whose covariance can be inverted.
    pub frames: usize,
    /// Mean normalized squared error of x, y and heading; 3 is expected.
    pub squared_error: f64,
    /// That along the long axis of the covariance of the position; 1 is expected.
    pub squared_error_long: f64,
    /// That along the short axis; 1 is expected.
    pub squared_error_short: f64,
    /// Share inside the 95 % region.
    pub inside: f64,
}

impl Consistency {
    /// The consistency of errors with the covariances of (x, y, heading) in the axes of the map; `None` where none of these can
    /// be inverted.
    pub(crate) fn new<'a>(
        frames: impl IntoIterator<Item = (PlanarError, &'a Matrix3<f64>)>,
    ) -> Option<Self> {
        let (mut count, mut inside) = (0_usize, 0_usize);
        let mut sums = [0.0; 3];
        for (error, covariance) in frames {
            let Some(square) = squared_error(&error, covariance) else {
                continue;
            };
            let axes = covariance.fixed_view::<2, 2>(0, 0).symmetric_eigen();
            let long = axes.eigenvalues.imax();
            let along = |axis: usize| {
                let error_m = axes.eigenvectors.column(axis).dot(&error.offset_in_map);
                error_m.powi(2) / axes.eigenvalues[axis]
            };
            for (sum, square) in sums.iter_mut().zip([square, along(long), along(1 - long)]) {
                *sum += square;
            }
            count += 1;
            inside += usize::from(square <= QUANTILE);
        }
        let mean = |sum: f64| sum / count as f64;
        (count > 0).then(|| Self {
            frames: count,
            squared_error: mean(sums[0]),
            squared_error_long: mean(sums[1]),
            squared_error_short: mean(sums[2]),
            inside: mean(inside as f64),
        })
    }
}

/// Whether an error is inside the 95 % region of a covariance, which has to be regular.
pub fn is_inside(error: &PlanarError, covariance: &Matrix3<f64>) -> bool {
    squared_error(error, covariance).is_some_and(|square| square <= QUANTILE)
}

/// Normalized squared error; `None` where the covariance is not positive definite.
fn squared_error(error: &PlanarError, covariance: &Matrix3<f64>) -> Option<f64> {
    let error = error.offset_in_map.push(error.turn_rad);
    Some(error.dot(&covariance.cholesky()?.solve(&error)))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::{Rotation2, Vector2, Vector3};
    use rand::{SeedableRng as _, rngs::StdRng};
    use rand_distr::{Distribution as _, StandardNormal};

    use super::*;
    use crate::geometry::Pose2;

    /// Standard deviations along two axes that are turned in the map, and of the heading.
    const SIGMAS: Vector3<f64> = Vector3::new(0.4, 0.05, 0.01);
    const TURN_RAD: f64 = 0.7;

    fn covariance() -> Matrix3<f64> {
        let turn = Rotation2::new(TURN_RAD).to_homogeneous();
        turn * Matrix3::from_diagonal(&SIGMAS.map(|sigma| sigma * sigma)) * turn.transpose()
    }

    /// The error of some standard deviations.
    fn error(deviates: Vector3<f64>) -> PlanarError {
        let off = deviates.component_mul(&SIGMAS);
        let shift = Rotation2::new(TURN_RAD) * Vector2::new(off.x, off.y);
        PlanarError::between(&Pose2::new(shift, off.z), &Pose2::identity())
    }

    #[test]
    fn the_squared_errors_are_those_of_the_deviations_along_the_axes() {
        let covariance = covariance();
        let found = |deviates: [f64; 3]| Consistency::new([(error(deviates.into()), &covariance)]);
        let found = found([2.0, -1.0, 1.5]).unwrap();
        assert_relative_eq!(found.squared_error, 4.0 + 1.0 + 2.25, epsilon = 1e-9);
        assert_relative_eq!(found.squared_error_long, 4.0, epsilon = 1e-9);
        assert_relative_eq!(found.squared_error_short, 1.0, epsilon = 1e-9);
        assert_eq!((found.frames, found.inside), (1, 1.0));
        assert!(is_inside(&error([2.79, 0.0, 0.0].into()), &covariance));
        assert!(!is_inside(&error([2.80, 0.0, 0.0].into()), &covariance));
    }

    #[test]
    fn errors_that_are_as_their_covariances_say_have_means_of_3_and_1_and_95_percent_inside() {
        const COUNT: usize = 10_000;
        let covariance = covariance();
        let mut rng = StdRng::seed_from_u64(1);
        let errors: Vec<PlanarError> = (0..COUNT)
            .map(|_| error(Vector3::from_fn(|_, _| StandardNormal.sample(&mut rng))))
            .collect();
        let found = Consistency::new(errors.iter().map(|error| (*error, &covariance))).unwrap();
        // Four standard errors: the variance of χ² is twice its degrees of freedom.
        let limit = |variance: f64| 4.0 * (variance / COUNT as f64).sqrt();
        assert_relative_eq!(found.squared_error, 3.0, epsilon = limit(6.0));
        assert_relative_eq!(found.squared_error_long, 1.0, epsilon = limit(2.0));
        assert_relative_eq!(found.squared_error_short, 1.0, epsilon = limit(2.0));
        assert_relative_eq!(found.inside, 0.95, epsilon = limit(0.95 * 0.05));
    }

    #[test]
    fn a_covariance_that_is_not_regular_is_left_out() {
        let none = error(Vector3::zeros());
        let (regular, singular) = (covariance(), Matrix3::zeros());
        assert_eq!(Consistency::new([(none, &singular)]), None);
        let both = Consistency::new([(none, &singular), (none, &regular)]);
        assert_eq!(both.unwrap().frames, 1);
        assert!(!is_inside(&none, &singular));
    }
}
