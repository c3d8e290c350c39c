//! Settings of the registration.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::validation::{InvalidValue, Validate, in_range, not_negative, positive};

/// Settings of the registration.
///
/// Defaults: our own values; from 1.5 degrees away it takes up to ten iterations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RegistrationConfig {
    /// Maximum number of Gauss-Newton iterations.
    #[default(12)]
    pub iterations: usize,
    /// Scale c of the robust kernel: a residual of c has a weight of one quarter [m].
    #[default(0.1)]
    pub kernel_m: f64,
    /// Step length below which the iteration has converged [m]; rotations count with a lever of ten
    /// meters.
    #[default(1e-3)]
    pub tolerance_m: f64,
    /// Number of azimuth sectors, the clusters of correlated residuals in the covariance.
    #[default(24)]
    pub sectors: usize,
    /// Standard deviation per axis of an offset common to all visible surfaces [m]; residuals cannot
    /// show it. The default is a thirtieth of the 9 cm cells of a map: simulated maps are off by 3
    /// to 4 mm over tens of meters.
    #[default(0.003)]
    pub map_error_m: f64,
    /// Standard deviation of the normals of the map, whose noise is no information on the position [rad]. The default is 3 mm
    /// over the 9 cm of a cell. It is no key of a configuration.
    #[default(0.03)]
    #[serde(skip)]
    pub normal_rad: f64,
}

impl RegistrationConfig {
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
        in_range("sectors", self.sectors, 1..=10_000)?;
        not_negative("map_error_m", self.map_error_m)?;
        not_negative("normal_rad", self.normal_rad)
    }
}
