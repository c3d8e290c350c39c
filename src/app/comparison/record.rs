//! Record of one run, `run.json`.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::Path;
use std::str::FromStr;

use anyhow::{Context as _, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::app::report::TrajectoryReport;
use crate::evaluation::TrajectoryMetrics;
use crate::evaluation::trust::Trust;

/// Name of the record in the folder of its run; written last.
pub const RECORD_FILE: &str = "run.json";

/// Identity of a run: sequence, configuration and seed.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
pub struct RunId {
    /// Name of the sequence.
    pub sequence: String,
    /// Name of the configuration.
    pub configuration: String,
    /// Seed of the random numbers.
    pub seed: u64,
}

impl fmt::Display for RunId {
    /// `sequence/configuration/seed`, also the folder of the run.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/{}", self.sequence, self.configuration, self.seed)
    }
}

impl FromStr for RunId {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        const FORM: &str = "write it as SEQUENCE/CONFIGURATION/SEED, such as town/PCA-MCL/1";
        let parts: Vec<&str> = text.split('/').collect();
        let [sequence, configuration, seed] = parts[..] else {
            return Err(FORM);
        };
        Ok(Self {
            sequence: sequence.to_owned(),
            configuration: configuration.to_owned(),
            seed: seed.parse().map_err(|_not_a_number| FORM)?,
        })
    }
}

/// Outcome of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// Errors of the final trajectory: the refined one if the configuration refines, else the
    /// filter's. The runtime per frame includes all stages.
    Finished(Box<TrajectoryReport>),
    /// Error message.
    Failed(String),
}

/// Record of one run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunRecord {
    /// Identity of the run.
    pub id: RunId,
    /// Hash of configuration, contents of the inputs and executable.
    pub key: String,
    /// Hash of configuration, names of the inputs and version of the program.
    pub settings: String,
    /// Program, version and executable.
    pub program: String,
    /// Processor, threads and renderer.
    pub machine: BTreeMap<String, String>,
    /// Wall time per stage, shared stages included [s].
    pub stage_seconds: BTreeMap<String, f64>,
    /// Trust in the states and covariances of the filter; absent if the run failed.
    #[serde(default)]
    pub trust: Option<Trust>,
    /// Outcome of the run.
    pub outcome: Outcome,
}

impl RunRecord {
    /// Reads the record in the folder of a run; `None` if there is none or if it is not readable
    /// by this version of the program.
    pub fn read(folder: &Path) -> Result<Option<Self>> {
        let path = folder.join(RECORD_FILE);
        if !path.exists() {
            return Ok(None);
        }
        let text =
            fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let record = serde_json::from_str(&text);
        if let Err(error) = &record {
            tracing::warn!("{} is ignored: {error}", path.display());
        }
        Ok(record.ok())
    }

    /// Metrics of the final trajectory; `None` if the run failed.
    pub fn metrics(&self) -> Option<&TrajectoryMetrics> {
        match &self.outcome {
            Outcome::Finished(report) => Some(&report.metrics),
            Outcome::Failed(_) => None,
        }
    }

    /// Whether the filter converged and never diverged again (strict rule).
    pub fn is_success(&self) -> bool {
        self.metrics()
            .and_then(|metrics| metrics.convergence.as_ref())
            .is_some_and(|convergence| convergence.kept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_id_is_parsed_from_its_text() {
        let id = RunId {
            sequence: "town".to_owned(),
            configuration: "Fuzzy-PSO-MCL".to_owned(),
            seed: 12,
        };
        assert_eq!(id.to_string().parse(), Ok(id));
        for wrong in ["town", "town/PCA-MCL", "town/PCA-MCL/x", "a/b/c/1"] {
            assert!(wrong.parse::<RunId>().is_err(), "{wrong}");
        }
    }
}
