//! What one run leaves for the comparison.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::app::results::TrajectoryReport;

/// Which run: the drive, how it was localized, and the seed.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct RunId {
    /// Name of the sequence.
    pub sequence: String,
    /// Name of the configuration.
    pub configuration: String,
    /// What random choices follow from.
    pub seed: u64,
}

impl fmt::Display for RunId {
    /// `sequence/configuration/seed`, which is also the run's folder.
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

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// With a trajectory: the refined one where the configuration refines, else the filter's. Its
    /// runtime is all that was spent on a frame.
    Finished(Box<TrajectoryReport>),
    /// With this message.
    Failed(String),
}

/// One run: `run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Which run.
    pub id: RunId,
    /// Hash of all that it follows from: configuration, inputs, source of the program.
    pub key: String,
    /// Hash of its effective configuration and the version alone.
    pub settings: String,
    /// Program, version and source.
    pub program: String,
    /// Processor, threads and renderer.
    pub machine: BTreeMap<String, String>,
    /// Wall time per stage, of those that were shared with other runs too [s].
    pub stage_seconds: BTreeMap<String, f64>,
    /// How it ended.
    pub outcome: Outcome,
}

impl RunRecord {
    /// The judgement; `None` where the run failed.
    pub fn judgement(&self) -> Option<&TrajectoryReport> {
        match &self.outcome {
            Outcome::Finished(judgement) => Some(judgement),
            Outcome::Failed(_) => None,
        }
    }

    /// Why the run failed; `None` where it did not.
    pub fn failure(&self) -> Option<&str> {
        match &self.outcome {
            Outcome::Finished(_) => None,
            Outcome::Failed(why) => Some(why),
        }
    }

    /// Whether the car was found and kept to the end, by the strict rule.
    pub fn is_success(&self) -> bool {
        self.judgement().is_some_and(|judgement| {
            (judgement.metrics.convergence).is_some_and(|convergence| convergence.kept)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_run_reads_back() {
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
