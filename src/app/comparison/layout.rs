//! Folders of a comparison.

use std::path::PathBuf;

use super::record::RunId;

/// Output folder of a comparison.
#[derive(Clone, Debug)]
pub struct Layout {
    /// The configuration's `output_folder`.
    pub root: PathBuf,
}

impl Layout {
    /// Folder of a run.
    pub fn run(&self, id: &RunId) -> PathBuf {
        self.root.join("runs").join(id.to_string())
    }

    /// Folder of the results of one stage that runs share: `maps`, `localizations`.
    pub fn shared(&self, stage: &str) -> PathBuf {
        self.root.join("shared").join(stage)
    }
}
