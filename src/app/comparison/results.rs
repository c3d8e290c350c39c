//! Records of a comparison, grouped by sequence, configuration and seed.

use std::collections::BTreeMap;

use super::measures::Measure;
use super::record::RunRecord;
use super::statistics;
use crate::app::comparison::config::{ComparisonConfig, Contrast};
use crate::app::comparison::table::SuccessRate;

/// All available records of a comparison.
#[derive(Clone, Debug)]
pub struct ComparisonResults<'a> {
    /// Configuration of the comparison.
    pub config: &'a ComparisonConfig,
    /// Names of the sequences that take part, in order.
    pub sequences: Vec<String>,
    /// Records in the order of the plan, without the particle sweep.
    pub records: Vec<RunRecord>,
    /// Records of the particle sweep by number of particles.
    pub sweep: BTreeMap<usize, Vec<RunRecord>>,
}

impl ComparisonResults<'_> {
    /// All records, those of the particle sweep last.
    pub fn all_records(&self) -> impl Iterator<Item = &RunRecord> {
        self.records.iter().chain(self.sweep.values().flatten())
    }

    /// Records of a configuration in a sequence.
    pub fn runs(&self, sequence: &str, configuration: &str) -> Vec<&RunRecord> {
        let is_one = |record: &&RunRecord| {
            record.id.sequence == sequence && record.id.configuration == configuration
        };
        self.records.iter().filter(is_one).collect()
    }

    /// Records of a configuration, one group per sequence.
    pub fn runs_by_sequence(&self, configuration: &str) -> Vec<Vec<&RunRecord>> {
        let sequences = self.sequences.iter();
        sequences
            .map(|name| self.runs(name, configuration))
            .collect()
    }

    /// Differences of a contrast per sequence, over the seeds that both configurations have.
    pub fn differences(&self, contrast: &Contrast, measure: &Measure) -> Vec<Vec<f64>> {
        let in_sequence = |sequence: &String| {
            let others = self.runs(sequence, &contrast.against);
            let difference = |run: &RunRecord| {
                let other = others.iter().find(|other| other.id.seed == run.id.seed)?;
                Some(value(run, measure)? - value(other, measure)?)
            };
            let runs = self.runs(sequence, &contrast.of);
            runs.into_iter().filter_map(difference).collect()
        };
        self.sequences.iter().map(in_sequence).collect()
    }
}

/// Value of a measure; `None` for a failed run, or where it is undefined.
pub fn value(record: &RunRecord, measure: &Measure) -> Option<f64> {
    (measure.value)(record.metrics()?)
}

/// Share of successful runs; `None` without runs.
pub fn success_rate(records: &[&RunRecord]) -> Option<SuccessRate> {
    let successes = records.iter().filter(|record| record.is_success()).count();
    statistics::success_rate(successes, records.len())
}
