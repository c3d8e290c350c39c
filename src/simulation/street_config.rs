//! Configuration of the street and of its cross-section.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::structure::Structure;
use crate::validation::{InvalidValue, Validate, fraction, in_range, nested};

/// The street and what stands along it.
///
/// Defaults: a residential street.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct StreetConfig {
    /// Width of each of the two lanes [m].
    #[default(3.3)]
    pub lane_width_m: f64,
    /// Mean distance between side streets [m].
    #[default(75.0)]
    pub side_street_spacing_m: f64,
    /// Whether there is an open square next to the road.
    #[default(true)]
    pub has_square: bool,
    /// Share of the frontage that is built on, 0 to 1.
    #[default(0.93)]
    pub built_share: f64,
    /// Share of the parking bays that are occupied, 0 to 1.
    #[default(0.75)]
    pub parked_share: f64,
    /// Mean distance between street lamps on one side [m].
    #[default(32.0)]
    pub lamp_spacing_m: f64,
    /// Trees and bushes per 100 m of each side.
    #[default(16.0)]
    pub plants_per_100_m: f64,
    /// Structures along the path: tunnels, guard rails, embankments, yards, hoardings.
    pub structures: Vec<Structure>,
    /// What is different from the street of the seed.
    pub changes: ChangesConfig,
    /// The cross-section.
    pub ground: CrossSectionConfig,
}

/// What has changed along a street since another drive, a test of localization in an older map.
///
/// Defaults: nothing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ChangesConfig {
    /// Whether other cars are parked in the bays.
    pub parked_cars: bool,
    /// Largest displacement of the surface of crowns, bushes and hedges along each axis [m].
    pub foliage_m: f64,
    /// Share of the houses that were torn down, 0 to 1.
    pub demolished_share: f64,
}

impl Validate for ChangesConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("foliage_m", self.foliage_m, 0.0..=5.0)?;
        fraction("demolished_share", self.demolished_share)
    }
}

#[cfg(test)]
impl StreetConfig {
    /// Road and ground with nothing on them.
    pub fn bare() -> Self {
        Self {
            has_square: false,
            side_street_spacing_m: 1e6,
            built_share: 0.0,
            parked_share: 0.0,
            lamp_spacing_m: 1e6,
            plants_per_100_m: 0.001,
            ..Self::default()
        }
    }
}

/// Largest number of structures.
const MAX_STRUCTURES: usize = 200;

impl Validate for StreetConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("lane_width_m", self.lane_width_m, 1.0..=50.0)?;
        in_range(
            "side_street_spacing_m",
            self.side_street_spacing_m,
            5.0..=1e6,
        )?;
        fraction("built_share", self.built_share)?;
        fraction("parked_share", self.parked_share)?;
        in_range("lamp_spacing_m", self.lamp_spacing_m, 6.0..=1e6)?;
        in_range("plants_per_100_m", self.plants_per_100_m, 0.001..=1000.0)?;
        in_range("structures", self.structures.len(), 0..=MAX_STRUCTURES)?;
        for (index, structure) in self.structures.iter().enumerate() {
            nested(&format!("structures.{}", index + 1), structure)?;
        }
        nested("changes", &self.changes)?;
        nested("ground", &self.ground)
    }
}

/// The cross-section of the street.
///
/// Defaults: a residential street.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct CrossSectionConfig {
    /// Edge of the square grid cells of the ground [m].
    #[default(1.0)]
    pub cell_m: f64,
    /// Distance from the carriageway up to which there is ground [m].
    #[default(45.0)]
    pub reach_m: f64,
    /// Width of the sidewalk [m].
    #[default(2.2)]
    pub sidewalk_width_m: f64,
    /// Height of the kerb, that is of the sidewalk above the carriageway [m].
    #[default(0.12)]
    pub kerb_height_m: f64,
    /// Cross slope of the carriageway, rising from the gutter over at most three metres [m/m].
    #[default(0.025)]
    pub crown_slope: f64,
    /// Amplitude of the undulation of gardens and grass [m].
    #[default(0.15)]
    pub undulation_m: f64,
}

impl Validate for CrossSectionConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("cell_m", self.cell_m, 0.1..=50.0)?;
        in_range("reach_m", self.reach_m, 1.0..=500.0)?;
        in_range("sidewalk_width_m", self.sidewalk_width_m, 0.1..=50.0)?;
        in_range("kerb_height_m", self.kerb_height_m, 0.0..=1.0)?;
        in_range("crown_slope", self.crown_slope, -1.0..=1.0)?;
        in_range("undulation_m", self.undulation_m, 0.0..=10.0)
    }
}
