//! Configuration of `ground`: ground segmentation of a recording.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::check::path;
use crate::ground::{FuzzyConfig, GroundConfig, GroundMethod, PcaGround, RansacGround};
use crate::validation::{InvalidValue, Validate, in_range};

/// Configuration of `ground`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct GroundCommandConfig {
    /// Recording: its folder, the folder of its scans, or a bag.
    #[default("data/kitti/velodyne".into())]
    pub scan_folder: PathBuf,
    /// Topic of the point clouds, in a bag with several.
    pub topic: Option<String>,
    /// Folder of the true classes, `NNNNNN.label`; `None`: `labels` beside the scans, where it
    /// exists.
    pub label_folder: Option<PathBuf>,
    /// Folder of the labels, points, pictures and the report.
    #[default("results/ground".into())]
    pub output_folder: PathBuf,
    /// First frame of the recording.
    pub start_idx: usize,
    /// Number of scans from `start_idx` on; -1 for all.
    #[default(-1)]
    pub n_scans: i64,
    /// Step between frames: n uses every n-th frame.
    #[default(1)]
    pub frame_step: usize,
    /// Method of ground segmentation.
    pub ground_method: GroundMethod,
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
    /// Linguistic sets and rules of `ground_method: fuzzy`.
    pub fuzzy: FuzzyConfig,
    /// Parameters of `ground_method: pca`.
    pub pca: PcaGround,
    /// Parameters of `ground_method: ransac`.
    pub ransac: RansacGround,
    /// Whether to replace existing output.
    pub force: bool,
}

impl GroundCommandConfig {
    /// The ground classifier and its parameters.
    pub fn ground(&self) -> GroundConfig {
        GroundConfig {
            method: self.ground_method,
            fuzzy: self.fuzzy.clone(),
            pca: self.pca,
            ransac: self.ransac,
        }
    }
}

impl Validate for GroundCommandConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("scan_folder", &self.scan_folder)?;
        path("output_folder", &self.output_folder)?;
        self.selection().validate()?;
        in_range("ground_threshold", self.ground_threshold, 0.0..=1.0)?;
        self.ground().validate()
    }
}
