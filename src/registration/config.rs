//! Settings of the registration.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::RobustKernel;
use crate::validation::{InvalidValue, Validate, in_range, not_negative, positive};

/// Settings of the registration.
///
/// Defaults: our own values. `docs/method.md`, Thresholds, has what half and
/// twice of the kernel, the sectors and the error of the map change on four sensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RegistrationConfig {
    /// Maximum number of Gauss-Newton iterations.
    #[default(12)]
    pub iterations: usize,
    /// Scale c of the robust kernel: a residual of c has a weight of one quarter [m]. The default is five standard deviations of
    /// the ranges of an HDL-64E, 2 cm, so that 98 % of the information of normal residuals is used; with 3 cm it is 93 %.
    #[default(0.1)]
    pub kernel_m: f64,
    /// Step length below which the iteration has converged [m]; rotations count with a lever of ten
    /// meters.
    #[default(1e-3)]
    pub tolerance_m: f64,
    /// Number of azimuth sectors, the clusters of correlated residuals in the covariance.
    #[default(24)]
    pub sectors: usize,
    /// Standard deviation per axis of the error that the visible surfaces of a map from estimated poses have in common [m];
    /// residuals cannot show it. The default is that of maps of three sensors; a map from exact poses has less than a millimetre.
    #[default(0.004)]
    pub map_error_m: f64,
    /// Standard deviation of the normals of the map, whose noise is no information on the position [rad]. The default is 3 mm
    /// over the 0.1 m of a cell. It is no key of a configuration.
    #[default(0.03)]
    #[serde(skip)]
    pub normal_rad: f64,
}

impl RegistrationConfig {
    /// Covariance of (x, y, heading) of the error that all poses in a part of the map have in common, in its axes [m², rad²]:
    /// neither more beams nor more frames reduce it. Surfaces that are off turn a pose, too.
    pub(crate) fn of_map(&self) -> Matrix3<f64> {
        /// Distance of the surfaces that show the heading [m].
        const LEVER_M: f64 = 30.0;
        let deviations = Vector3::new(1.0, 1.0, 1.0 / LEVER_M) * self.map_error_m;
        Matrix3::from_diagonal(&deviations.component_mul(&deviations))
    }

    /// Kernel of the distances to the surfaces.
    pub(super) fn kernel(&self) -> RobustKernel {
        RobustKernel {
            scale_m: self.kernel_m,
        }
    }

    /// The settings with a tolerance of at least that [m], for a pose that another registration continues.
    pub(crate) fn with_tolerance(&self, tolerance_m: f64) -> Self {
        Self {
            tolerance_m: self.tolerance_m.max(tolerance_m),
            ..self.clone()
        }
    }

    /// The settings with a kernel of at least that scale [m], for returns that are farther off.
    pub(crate) fn with_kernel(&self, kernel_m: f64) -> Self {
        Self {
            kernel_m: self.kernel_m.max(kernel_m),
            ..self.clone()
        }
    }

    /// The settings for a pose that is not certain, with twice the noise of the normals: where they are noisier than usual,
    /// as on parts of a tunnel or of a motorway, they would confirm a wrong place.
    pub(crate) fn cautious(&self) -> Self {
        Self {
            normal_rad: 2.0 * self.normal_rad,
            ..self.clone()
        }
    }
}

impl Validate for RegistrationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("iterations", self.iterations, 1..=1000)?;
        positive("kernel_m", self.kernel_m)?;
        not_negative("tolerance_m", self.tolerance_m)?;
        in_range("sectors", self.sectors, 2..=10_000)?;
        not_negative("map_error_m", self.map_error_m)?;
        not_negative("normal_rad", self.normal_rad)
    }
}
