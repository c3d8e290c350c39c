//! Configuration of `build-map`: from scans with poses to a triangle mesh.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::blocks::{
    GnssInputConfig, InertialConfig, OutputConfig, PoseInputConfig, RecordingConfig, optional_path,
    require_path,
};
use crate::file_path::FilePath;
use crate::map::{MapConfig, PoseSource};
use crate::validation::{InvalidValue, Validate, nested, require};

/// Configuration of `build-map`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct BuildMapConfig {
    /// The recording.
    pub recording: RecordingConfig,
    /// Its poses, where they are given.
    pub given_poses: PoseInputConfig,
    /// Its inertial sensor, where it is used.
    pub inertial: InertialConfig,
    /// Positions of a GNSS receiver, which give the map its place on the Earth; poses from the scans follow them.
    pub gnss: GnssInputConfig,
    /// Output path of the map.
    #[default("results/map.ply".into())]
    pub mesh_file: FilePath,
    /// Map to which the recording is added: it is localized in that map, and what has changed since is replaced.
    pub onto: Option<FilePath>,
    /// Point cloud in the map frame that is meshed instead of scans with poses, `.pcd`, `.ply` or `.npy`.
    pub cloud_file: Option<FilePath>,
    /// Every n-th key scan is held out of the map and used to evaluate it; 0 for none.
    pub holdout_step: usize,
    /// Mesh of the true surface in the map frame, for accuracy and completeness; `street.ply` of a
    /// simulated drive is one.
    pub truth_mesh: Option<FilePath>,
    /// The build.
    pub map: MapConfig,
    /// Output.
    pub output: OutputConfig,
}

impl Validate for BuildMapConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("recording", &self.recording)?;
        nested("given_poses", &self.given_poses)?;
        nested("inertial", &self.inertial)?;
        nested("gnss", &self.gnss)?;
        optional_path("cloud_file", self.cloud_file.as_deref())?;
        optional_path("truth_mesh", self.truth_mesh.as_deref())?;
        optional_path("onto", self.onto.as_deref())?;
        if let Some(map) = &self.onto {
            require(
                self.cloud_file.is_none() && self.map.poses != PoseSource::Polished,
                "onto",
                map.display(),
                "only scans are added to a map; their poses are adjusted to it: set cloud_file to null and poses to auto, or to given for those in the world of the map",
            )?;
        }
        require_path("mesh_file", &self.mesh_file)?;
        require(
            self.holdout_step != 1,
            "holdout_step",
            self.holdout_step,
            "1 would exclude every scan; 0 excludes none, 10 every tenth",
        )?;
        nested("map", &self.map)
    }
}
