//! Registration of a scan to the map: Gauss-Newton on the distances between the returns and the
//! surfaces that their beams hit.
//!
//! ```text
//! rᵢ = nᵢ · (map_from_lidar qᵢ − sᵢ)                      return q, surface s with normal n [m]
//! ∂rᵢ / ∂(translation, rotation) = (nᵢ, qᵢ × nᵢ)          n in the lidar frame
//! Σ wᵢ Jᵢᵀ Jᵢ δ = − Σ wᵢ Jᵢᵀ rᵢ        wᵢ: robust kernel
//! ```
//!
//! Each iteration casts one ray per beam; the hit is the correspondence of the return (projective
//! association), and the plane of its triangle gives the point-to-plane residual. Its step minimizes the robust cost of the
//! linearized residuals.
//!
//! Neighboring returns hit the same surface and share its map error, so their residuals are
//! correlated, and only sectors of the azimuth are taken as independent: the covariance is that of the jackknife, by the
//! shifts of the pose where one of K sectors is left out.
//!
//! ```text
//! Σ = σ² H⁻¹ + (K − 1) / K · Σₖ δₖ δₖᵀ        δₖ = (H − Hₖ)⁻¹ gₖ,   Hₖ = Σ wᵢ Jᵢᵀ Jᵢ,   gₖ = Σ wᵢ Jᵢᵀ rᵢ   of sector k
//! ```
//!
//! with the residuals after the step, and 0.95 of Hₖ: without all of it, what a sector alone determines would be unknown.
//!
//! Efron and Stein, *The Jackknife Estimate of Variance* (1981); Bell and McCaffrey, *Bias Reduction in Standard Errors for
//! Linear Regression with Multi-Stage Samples* (2002), for its use with clusters of which few determine a parameter. What the noise
//! of the normals seems to show is no information, see [`information`]. The first term, the covariance of independent returns,
//! keeps the estimate positive definite when few sectors have returns. The error that the map has in all frames is none of it,
//! see [`RegistrationConfig::of_map`]. Chen and Medioni, *Object Modelling by Registration of Multiple Range Images* (1992), for
//! point to plane; Blais and Levine (1995) for projective association.

mod config;
mod equations;
mod information;
mod informative;
mod range_factor;
#[cfg(test)]
mod tests;

use std::borrow::Cow;

use nalgebra::{Matrix3, Matrix6, Vector6};

pub use self::config::RegistrationConfig;
use self::equations::{Equations, length_m};
use self::information::{Residual, observed_share};
use crate::geometry::pose::exponential;
use crate::geometry::{Pose3, Rigid3f, azimuth_sector};
use crate::lidar::Beam;
use crate::rendering::{RangeRenderer, RenderError, SurfaceHit};

/// Tolerance of a registration that another one continues [m].
const COARSE_TOLERANCE_M: f64 = 0.01;

/// Number of beams that [`approach`] registers.
const COARSE_BEAMS: usize = 2400;

/// A registered pose with its covariance.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct RegistrationResult {
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Pose3,
    /// Covariance of (x, y, z, roll, pitch, yaw) in the lidar frame [m, rad].
    pub covariance: Matrix6<f64>,
    /// Number of iterations of the last stage.
    pub iterations: usize,
}

impl RegistrationResult {
    /// Covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    pub(crate) fn planar_covariance(&self) -> Matrix3<f64> {
        let rotation = self.map_from_lidar.rotation.to_rotation_matrix();
        let mut map_from_lidar = Matrix6::zeros();
        for corner in [0, 3] {
            map_from_lidar
                .fixed_view_mut::<3, 3>(corner, corner)
                .copy_from(rotation.matrix());
        }
        let in_map = map_from_lidar * self.covariance * map_from_lidar.transpose();
        let axes = [0, 1, 5];
        Matrix3::from_fn(|row, column| in_map[(axes[row], axes[column])])
    }
}

/// The pose of beams that are registered to the map, starting at `initial`; `None` if they do not determine it.
/// The caller has to check whether it is an improvement.
pub(crate) fn registered_pose(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    initial: &Pose3,
    config: &RegistrationConfig,
) -> Result<Option<Pose3>, RenderError> {
    let found = Linearized::new(renderer, beams, initial, config)?.descend()?;
    Ok(found.map(|found| found.map_from_lidar))
}

/// Registers some of many beams coarsely: a pose from which [`register_informative`] goes on. It is the initial one for few beams,
/// and where they do not determine the pose.
pub(crate) fn approach(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    initial: &Pose3,
    config: &RegistrationConfig,
) -> Result<Pose3, RenderError> {
    if beams.len() <= COARSE_BEAMS {
        return Ok(*initial);
    }
    let step = beams.len().div_ceil(COARSE_BEAMS);
    let some: Vec<Beam> = beams.iter().step_by(step).copied().collect();
    let coarse = config.with_tolerance(COARSE_TOLERANCE_M);
    let near = registered_pose(renderer, &some, initial, &coarse)?;
    Ok(near.unwrap_or(*initial))
}

/// Registers the most informative beams, see [`Linearized::registered`].
pub(crate) fn register_informative(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    near: &Pose3,
    config: &RegistrationConfig,
) -> Result<Option<RegistrationResult>, RenderError> {
    Linearized::new(renderer, beams, near, config)?.registered()
}

/// The factor by which the ranges of beams have to be multiplied to fit the map from near a pose; `None` if they do not determine it.
pub(crate) fn measured_range_factor(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    near: &Pose3,
    config: &RegistrationConfig,
) -> Result<Option<f64>, RenderError> {
    /// Scale of the robust kernel [m]: ranges that are off by a few per cent leave residuals of decimetres.
    const KERNEL_M: f64 = 0.4;
    let wide = config.with_kernel(KERNEL_M);
    let residuals = linearize(renderer, beams, near, &wide)?;
    Ok(range_factor::range_factor(&residuals, beams, wide.kernel()))
}

/// Registers beams, starting at `initial`; `None` if they do not determine the pose.
pub(crate) fn register(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    initial: &Pose3,
    config: &RegistrationConfig,
) -> Result<Option<RegistrationResult>, RenderError> {
    let found = Linearized::new(renderer, beams, initial, config)?.descend()?;
    found.map_or(Ok(None), Descent::result)
}

/// The pose of beams that are registered with a kernel of `kernel_m` from farther away, from which a registration as configured goes
/// on; `initial` if they do not determine it.
pub(crate) fn approach_widely(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    initial: &Pose3,
    kernel_m: f64,
    config: &RegistrationConfig,
) -> Result<Pose3, RenderError> {
    let wide = config
        .with_tolerance(COARSE_TOLERANCE_M)
        .with_kernel(kernel_m);
    let near = registered_pose(renderer, beams, initial, &wide)?;
    Ok(near.unwrap_or(*initial))
}

/// Beams with their residuals at a pose near the right one: it can be improved, or kept.
#[derive(Clone)]
pub(crate) struct Linearized<'a> {
    renderer: &'a dyn RangeRenderer,
    beams: Cow<'a, [Beam]>,
    map_from_lidar: Pose3,
    config: &'a RegistrationConfig,
    /// Of the beams that have one, ascending by their numbers.
    residuals: Vec<Residual>,
}

impl<'a> Linearized<'a> {
    /// Finds what the beams hit from a pose.
    pub fn new(
        renderer: &'a dyn RangeRenderer,
        beams: &'a [Beam],
        map_from_lidar: &Pose3,
        config: &'a RegistrationConfig,
    ) -> Result<Self, RenderError> {
        Ok(Self {
            renderer,
            beams: beams.into(),
            map_from_lidar: *map_from_lidar,
            config,
            residuals: linearize(renderer, beams, map_from_lidar, config)?,
        })
    }

    /// The pose as it is. Its covariance contains the square of the step that it does not take. `None` if the beams do not
    /// determine the pose.
    pub fn kept(&self) -> Result<Option<RegistrationResult>, RenderError> {
        let Some(equations) = Equations::new(&self.residuals, &Vector6::zeros(), self.config)
        else {
            return Ok(None);
        };
        let step = equations.determined_step();
        let covariance = self.covariance(equations)?;
        Ok(covariance.map(|covariance| RegistrationResult {
            map_from_lidar: self.map_from_lidar,
            covariance: covariance + step * step.transpose(),
            iterations: 0,
        }))
    }

    /// The pose registered by the most informative beams, or by all if these are no more than [`approach`] takes. Where the pose
    /// turns out to be farther off, they are chosen after an approach. `None` if they do not determine it.
    pub fn registered(&self) -> Result<Option<RegistrationResult>, RenderError> {
        /// Step up to which the right beams are chosen: half of the default scale of the kernel [m].
        const NEAR_M: f64 = 0.05;
        let is_near = |equations: Equations| length_m(&equations.determined_step()) <= NEAR_M;
        let equations = || Equations::new(&self.residuals, &Vector6::zeros(), self.config);
        let found = if self.beams.len() <= COARSE_BEAMS {
            self.clone().descend()?
        } else if equations().is_some_and(is_near) {
            self.most_informative().descend()?
        } else {
            let (renderer, beams, config) = (self.renderer, &self.beams, self.config);
            let near = approach(renderer, beams, &self.map_from_lidar, config)?;
            let near = Linearized::new(renderer, beams, &near, config)?;
            near.most_informative().descend()?
        };
        found.map_or(Ok(None), Descent::result)
    }

    /// The 4,800 most informative beams, see [`informative::choose`].
    fn most_informative(&self) -> Self {
        const COUNT: usize = 4800;
        let mut residuals = informative::choose(&self.residuals, COUNT, self.config);
        let mut beams = Vec::with_capacity(residuals.len());
        for (number, residual) in residuals.iter_mut().enumerate() {
            beams.push(self.beams[residual.beam]);
            residual.beam = number;
        }
        Self {
            beams: beams.into(),
            residuals,
            ..*self
        }
    }

    /// Registers the beams, starting at the pose; `None` if they do not determine it.
    fn descend(mut self) -> Result<Option<Descent<'a>>, RenderError> {
        let mut iterations = 0;
        loop {
            let Some(equations) = Equations::minimal(&self.residuals, self.config) else {
                return Ok(None);
            };
            let step = equations.determined_step();
            let pose = self.map_from_lidar * exponential(&step);
            iterations += 1;
            if length_m(&step) < self.config.tolerance_m || iterations >= self.config.iterations {
                return Ok(Some(Descent {
                    map_from_lidar: pose,
                    before: self,
                    equations,
                    iterations,
                }));
            }
            self.residuals = self.residuals_at(&pose)?;
            self.map_from_lidar = pose;
        }
    }

    /// Covariance of the pose, or of one a small step from it. In directions of which much may be noise, beams are cast from both
    /// sides. `None` if the information is singular.
    fn covariance(&self, mut equations: Equations) -> Result<Option<Matrix6<f64>>, RenderError> {
        for axis in equations.horizontal.doubtful() {
            // At the scale of the kernel, a residual that is right here has a weight of a quarter there.
            let shift = self.config.kernel_m * equations.horizontal.unit_shift(axis);
            let mut shifted = Vec::with_capacity(2);
            for shift in [-shift, shift] {
                let there = self.map_from_lidar * exponential(&shift);
                shifted.push((shift, self.residuals_at(&there)?));
            }
            let share = observed_share(&self.residuals, &shifted, self.config.kernel());
            equations.horizontal.observe(axis, share);
        }
        Ok(equations.covariance())
    }

    fn residuals_at(&self, map_from_lidar: &Pose3) -> Result<Vec<Residual>, RenderError> {
        linearize(self.renderer, &self.beams, map_from_lidar, self.config)
    }
}

/// The end of a registration.
struct Descent<'a> {
    map_from_lidar: Pose3,
    /// The beams before the last step.
    before: Linearized<'a>,
    /// Of that step.
    equations: Equations,
    iterations: usize,
}

impl Descent<'_> {
    /// The pose with its covariance; `None` if the information is singular.
    fn result(self) -> Result<Option<RegistrationResult>, RenderError> {
        let covariance = self.before.covariance(self.equations)?;
        Ok(covariance.map(|covariance| RegistrationResult {
            map_from_lidar: self.map_from_lidar,
            covariance,
            iterations: self.iterations,
        }))
    }
}

/// Linearized residuals of all beams that pass the gates.
fn linearize(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    pose: &Pose3,
    config: &RegistrationConfig,
) -> Result<Vec<Residual>, RenderError> {
    /// Gate on the distance along the beam, in kernel widths, for grazing incidence.
    const GATE_ALONG: f64 = 20.0;
    let within_m = (GATE_ALONG * config.kernel_m) as f32;
    let hits = renderer.surfaces(pose, beams, within_m)?;
    let lidar_from_map = Rigid3f::from(&pose.inverse());
    let residual = |(number, (beam, hit)): (usize, (&Beam, &Option<SurfaceHit>))| {
        residual((number, beam), hit.as_ref()?, &lidar_from_map, config)
    };
    let pairs = beams.iter().zip(&hits).enumerate();
    Ok(pairs.filter_map(residual).collect())
}

/// The linearized residual of one beam; `None` if its return is too far from the plane of the hit to be a
/// correspondence.
fn residual(
    (number, beam): (usize, &Beam),
    hit: &SurfaceHit,
    lidar_from_map: &Rigid3f,
    config: &RegistrationConfig,
) -> Option<Residual> {
    /// Gate on the distance to the plane, in kernel widths.
    const GATE_ACROSS: f64 = 5.0;
    let normal = lidar_from_map.rotate(hit.normal_in_map);
    let excess_m = f64::from(beam.range_m - hit.range_m);
    let value_m = excess_m * f64::from(normal.dot(beam.direction));
    if value_m.abs() > GATE_ACROSS * config.kernel_m {
        return None;
    }
    let lever = beam.point().cross(normal);
    let jacobian = [normal.x, normal.y, normal.z, lever.x, lever.y, lever.z];
    Some(Residual {
        beam: number,
        value_m,
        jacobian: Vector6::from(jacobian.map(f64::from)),
        sector: azimuth_sector(beam.direction, config.sectors),
    })
}
