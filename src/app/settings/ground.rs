//! Configuration of `ground`: ground segmentation of a recording.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::blocks::{OutputConfig, RecordingConfig, require_path};
use crate::file_path::FilePath;
use crate::ground::GroundConfig;
use crate::validation::{InvalidValue, Validate, in_range, nested};

/// Configuration of `ground`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct GroundCommandConfig {
    /// The recording.
    pub recording: RecordingConfig,
    /// Folder of the true classes, `NNNNNN.label`; `None`: `labels` next to the scans, where it
    /// exists.
    pub label_folder: Option<FilePath>,
    /// Folder of the labels, points, pictures and the report.
    #[default("results/ground".into())]
    pub output_folder: FilePath,
    /// Confidence above which a point is ground, unitless.
    #[default(0.5)]
    pub ground_threshold: f32,
    /// Whether to evaluate all methods, where labels exist.
    #[default(true)]
    pub compare: bool,
    /// Whether to write the result as SemanticKITTI labels.
    #[default(true)]
    pub write_labels: bool,
    /// Whether to write the points, coloured by confidence.
    #[default(true)]
    pub write_plys: bool,
    /// Step between the scans that are drawn from above; 0 for none.
    #[default(10)]
    pub plot_step: usize,
    /// The method and its parameters.
    pub ground: GroundConfig,
    /// Output.
    pub output: OutputConfig,
}

impl Validate for GroundCommandConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("recording", &self.recording)?;
        require_path("output_folder", &self.output_folder)?;
        in_range("ground_threshold", self.ground_threshold, 0.0..=1.0)?;
        nested("ground", &self.ground)
    }
}
