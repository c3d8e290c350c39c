//! `ground`: which points of a recording are ground.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::path;
use crate::ground::{FuzzyConfig, GroundConfig, GroundMethod, PcaGround, RansacGround};
use crate::recording::Selection;
use crate::validation::{InvalidValue, Validate, in_range};

/// What `ground` reads, how it judges and what it writes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GroundCommandConfig {
    /// Folder of the scans, `NNNNNN.bin`.
    pub scan_folder: PathBuf,
    /// Folder of their true classes, `NNNNNN.label`; null: `labels` beside the scans, if it is
    /// there.
    pub label_folder: Option<PathBuf>,
    /// Where labels, points, pictures and the report go.
    pub output_folder: PathBuf,
    /// First frame of the recording.
    pub start_idx: usize,
    /// How many scans of the recording are looked at; -1 for all.
    pub n_scans: i64,
    /// Every how manieth frame is taken.
    pub frame_step: usize,
    /// How ground is told from the rest.
    pub ground_method: GroundMethod,
    /// A point with more confidence than this is called ground, unitless.
    pub ground_threshold: f32,
    /// Whether all methods are judged beside the chosen one, where there are labels.
    pub compare: bool,
    /// Whether the answer is written as SemanticKITTI labels.
    pub write_labels: bool,
    /// Whether the points are written coloured by confidence.
    pub write_plys: bool,
    /// Every how manieth selected scan is drawn from above; 0 for none.
    pub plot_step: usize,
    /// Sets and rules of `ground_method: fuzzy`.
    pub fuzzy: FuzzyConfig,
    /// `ground_method: pca`.
    pub pca: PcaGround,
    /// `ground_method: ransac`.
    pub ransac: RansacGround,
    /// Whether existing output is replaced.
    pub force: bool,
}

impl Default for GroundCommandConfig {
    fn default() -> Self {
        Self {
            scan_folder: "data/kitti/velodyne".into(),
            label_folder: None,
            output_folder: "results/ground".into(),
            start_idx: 0,
            n_scans: -1,
            frame_step: 1,
            ground_method: GroundMethod::default(),
            ground_threshold: 0.5,
            compare: true,
            write_labels: true,
            write_plys: true,
            plot_step: 10,
            fuzzy: FuzzyConfig::default(),
            pca: PcaGround::default(),
            ransac: RansacGround::default(),
            force: false,
        }
    }
}

impl GroundCommandConfig {
    /// The frames that are judged.
    pub fn selection(&self) -> Selection {
        Selection {
            start_idx: self.start_idx,
            n_scans: self.n_scans,
            frame_step: self.frame_step,
        }
    }

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
