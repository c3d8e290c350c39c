//! Configuration of a map build.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::local_map::LocalMapConfig;
use crate::ground::GroundConfig;
use crate::map::tiles::cache::MapCache;
use crate::map::tiles::grid::TileConfig;
use crate::memory::MemoryBudget;
use crate::rendering::{Backend, RenderingMethod};
use crate::sensor::SensorConfig;
use crate::validation::{InvalidValue, Validate, in_range, nested, not_negative, positive};

/// Where the poses of the scans come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum PoseSource {
    /// Given, where there are any, otherwise as [`PoseSource::Odometry`]; with an older map found in that map.
    #[default]
    Auto,
    /// Given.
    Given,
    /// Given, and adjusted so that the scans show the same surfaces.
    Polished,
    /// From the scans themselves: odometry, loops and adjustment.
    Odometry,
}

/// Everything that can be configured about building a map.
///
/// Defaults: the values of range-mcl where it has them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct MapConfig {
    /// What is known about the sensor; the rest is inferred from the scans.
    pub sensor: SensorConfig,
    /// Where the poses of a recording come from.
    pub poses: PoseSource,
    /// Whether to compare given poses with the motion of some scans before anything is built.
    #[default(true)]
    pub check_poses: bool,
    /// Seed of the search for the start in an older map.
    pub seed: u64,
    /// Distance from the previous key scan after which a scan is a key scan [m].
    #[default(0.2)]
    pub displacement_threshold_m: f64,
    /// Key scans per local map.
    #[default(100)]
    pub local_map_size: usize,
    /// Length of path of the neighbours with which a local map is meshed [m].
    #[default(5.0)]
    pub overlap_m: f64,
    /// Largest distance between successive scans [m]; a larger one is an error of the poses.
    #[default(50.0)]
    pub max_step_m: f64,
    /// Ground segmentation of the scans.
    pub ground: GroundConfig,
    /// From the scans of a local map to its mesh.
    pub local_map: LocalMapConfig,
}

impl Validate for MapConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        not_negative("displacement_threshold_m", self.displacement_threshold_m)?;
        in_range("local_map_size", self.local_map_size, 1..=10_000)?;
        not_negative("overlap_m", self.overlap_m)?;
        positive("max_step_m", self.max_step_m)?;
        nested("sensor", &self.sensor)?;
        nested("ground", &self.ground)?;
        nested("local_map", &self.local_map)
    }
}

/// How a map is prepared for localization.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MapOptions {
    /// Processor that renders the map.
    pub backend: Backend,
    /// Method to render whole range images.
    pub method: RenderingMethod,
    /// Division into tiles.
    pub tiles: TileConfig,
    /// Where the tiles of a map file are kept.
    pub cache: MapCache,
    /// Memory of each stage that prepares the map, renders it, or builds it.
    #[serde(skip)]
    pub memory_budget: MemoryBudget,
}
