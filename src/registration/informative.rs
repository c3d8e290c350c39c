//! Choice of the most informative beams.
//!
//! Most returns are of the road and of the next walls along it; few show the position along the street. Half of the beams are
//! drawn uniformly, half by their leverage on position and heading:
//!
//! ```text
//! pᵢ ∝ 1 / n + lᵢ / Σ lⱼ ≤ 1                 lᵢ = wᵢ aᵢᵀ C⁻¹ aᵢ,   a = P H⁻¹ J      (leverage)
//! ```
//!
//! with the information matrix H = Σ wᵢ Jᵢᵀ Jᵢ of all, P the part of position and heading, and C = P H⁻¹ Pᵀ. The leverages of each
//! parameter add up to one, however few beams show it, but for directions of which only the noise of normals is known, as along a
//! tunnel: there a is reduced as the step of the registration is.
//!
//! Gelfand, Ikemoto, Rusinkiewicz and Levoy, *Geometrically Stable Sampling for the ICP Algorithm* (3DIM 2003), for the aim; Ma, Mahoney
//! and Yu, *A Statistical Perspective on Algorithmic Leveraging* (JMLR 2015), for a mixture of both distributions.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use super::config::RegistrationConfig;
use super::information::{Horizontal, Residual};

/// The residuals of about `count` beams in their order; all of them if these are fewer, or do not determine the pose.
pub(super) fn choose(
    residuals: &[Residual],
    count: usize,
    config: &RegistrationConfig,
) -> Vec<Residual> {
    const GOLDEN_RATIO: f64 = 1.618_033_988_749_895;
    let shares = (residuals.len() > count)
        .then(|| shares(residuals, count, config))
        .flatten();
    let Some(shares) = shares else {
        return residuals.to_vec();
    };
    // Multiples of the golden ratio are spread most evenly, and whether a beam is drawn hardly depends on the others.
    let is_drawn = |(residual, share): &(&Residual, f64)| {
        (residual.beam as f64 * GOLDEN_RATIO).fract() < *share
    };
    let drawn = residuals.iter().zip(shares).filter(is_drawn);
    drawn.map(|(residual, _)| residual.clone()).collect()
}

/// Probabilities of the residuals, whose sum is about `count`; `None` if all of them do not determine the pose.
fn shares(residuals: &[Residual], count: usize, config: &RegistrationConfig) -> Option<Vec<f64>> {
    /// Rounds in which what certain beams leave over is given to the others.
    const ROUNDS: usize = 5;
    let leverages = leverages(residuals, config)?;
    let sum: f64 = leverages.iter().sum();
    let uniform = 1.0 / residuals.len() as f64;
    let count = count as f64;
    let mut shares: Vec<f64> = leverages.iter().map(|it| uniform + it / sum).collect();
    for _ in 0..ROUNDS {
        let factor = count / shares.iter().sum::<f64>();
        (shares.iter_mut()).for_each(|share| *share = (*share * factor).min(1.0));
    }
    Some(shares)
}

/// Leverage of each residual on position and heading; `None` if all of them do not determine the pose.
fn leverages(residuals: &[Residual], config: &RegistrationConfig) -> Option<Vec<f64>> {
    let kernel = config.kernel();
    let mut information = Matrix6::zeros();
    let mut weights = 0.0;
    for residual in residuals {
        let weight = kernel.weight(residual.value_m);
        information += weight * residual.jacobian * residual.jacobian.transpose();
        weights += weight;
    }
    let covariance = information.try_inverse()?;
    let horizontal = Horizontal::new(&information, weights * config.normal_rad.powi(2))?;
    let planar = |row: usize| [0, 1, 5][row];
    let of_plane = Matrix3::from_fn(|row, column| covariance[(planar(row), planar(column))]);
    let of_plane = of_plane.try_inverse()?;
    let leverage = |residual: &Residual| {
        let moved: Vector6<f64> = horizontal.determined(covariance * residual.jacobian);
        let moved = Vector3::from_fn(|row, _| moved[planar(row)]);
        kernel.weight(residual.value_m) * moved.dot(&(of_plane * moved))
    };
    Some(residuals.iter().map(leverage).collect())
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    /// A road, walls on both sides of it, and every hundredth beam a pole that shows the position along them.
    fn street(noise_rad: f64) -> Vec<Residual> {
        (0..6000)
            .map(|beam| {
                let (sine, cosine) = (0.37 * beam as f64).sin_cos();
                let jacobian = match beam {
                    _ if beam % 100 == 7 && noise_rad == 0.0 => {
                        Vector6::new(1.0, 0.0, 0.0, 0.0, sine, 5.0 * cosine)
                    }
                    _ if beam % 2 == 0 => {
                        Vector6::new(noise_rad * sine, 1.0, 0.0, sine, 0.0, 20.0 * cosine)
                    }
                    _ => Vector6::new(0.0, 0.0, 1.0, 8.0 * sine, 8.0 * cosine, 0.0),
                };
                Residual {
                    beam,
                    value_m: 0.0,
                    jacobian,
                    sector: 0,
                }
            })
            .collect()
    }

    fn beams_of(residuals: &[Residual]) -> Vec<usize> {
        residuals.iter().map(|residual| residual.beam).collect()
    }

    fn poles(chosen: &[usize]) -> usize {
        chosen.iter().filter(|beam| *beam % 100 == 7).count()
    }

    fn exact_normals() -> RegistrationConfig {
        RegistrationConfig {
            normal_rad: 0.0,
            ..RegistrationConfig::default()
        }
    }

    #[test]
    fn leverages_add_up_to_the_parameters_of_the_plane_and_poles_have_one_of_them() {
        let leverages = leverages(&street(0.0), &exact_normals()).unwrap();
        assert_relative_eq!(leverages.iter().sum::<f64>(), 3.0, max_relative = 0.01);
        let of_poles: f64 = leverages.iter().skip(7).step_by(100).sum();
        assert!((0.95..1.05).contains(&of_poles), "{of_poles}");
    }

    #[test]
    fn all_that_few_beams_show_is_kept_and_the_rest_is_drawn_uniformly() {
        let chosen = beams_of(&choose(&street(0.0), 3000, &exact_normals()));
        assert!((2900..=3100).contains(&chosen.len()), "{}", chosen.len());
        assert!(chosen.is_sorted());
        // All 60 poles, where every other beam would have had 30.
        assert_eq!(poles(&chosen), 60);
        let of_road = chosen.iter().filter(|beam| *beam % 2 == 1).count();
        assert!(of_road > 600, "{of_road}");
    }

    #[test]
    fn noise_of_normals_along_a_tunnel_has_no_leverage() {
        let sum = |config: &RegistrationConfig| -> f64 {
            leverages(&street(0.02), config).unwrap().iter().sum()
        };
        // Across and heading; along, too, if normals were exact.
        assert_relative_eq!(sum(&RegistrationConfig::default()), 2.0, epsilon = 0.05);
        assert_relative_eq!(sum(&exact_normals()), 3.0, epsilon = 0.05);
    }

    #[test]
    fn few_residuals_are_all_taken() {
        let few: Vec<Residual> = street(0.0).into_iter().step_by(3).collect();
        let chosen = beams_of(&choose(&few, 3000, &RegistrationConfig::default()));
        assert!(chosen.iter().copied().eq((0..6000).step_by(3)));
    }
}
