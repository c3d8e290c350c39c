//! The tables of a comparison, from its runs.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::measures::{CONTRASTED, Measure, TABLE_1, TABLE_2};
use super::paired::paired_difference;
use super::record::RunRecord;
use super::spread::mean_with_spread;
use super::success::success_rate;
use crate::app::reporting::{Cell, Column, SuccessRate, Table};

/// A configuration that takes part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Variant {
    /// Its name.
    pub name: String,
    /// The average positional error that the report claims for it [m].
    pub claimed_m: Option<f64>,
}

/// Two configurations whose difference is asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Contrast {
    /// The configuration.
    pub of: String,
    /// What it is compared with.
    pub against: String,
}

/// All runs of a comparison that are there.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// The sequences, in their order.
    pub sequences: Vec<String>,
    /// The configurations, in their order.
    pub variants: Vec<Variant>,
    /// What is compared with what.
    pub contrasts: Vec<Contrast>,
    /// Seeds per sequence and configuration.
    pub seeds: usize,
    /// The runs that are there, in any order.
    pub records: Vec<RunRecord>,
    /// Runs for each number of particles, ascending; they are in no mean of the others.
    pub sweep: Vec<(usize, Vec<RunRecord>)>,
}

const SPREAD: &str = "Mean over sequences ± standard deviation over seeds ± standard deviation over sequences; the first ten frames (half of a run that is shorter than twenty) do not count.";

impl Comparison {
    /// All tables, most important first.
    pub fn tables(&self) -> Vec<Table> {
        let mut tables = vec![
            self.table_1(),
            self.table_2(),
            self.differences(),
            self.by_sequence(),
            self.timing(),
        ];
        if !self.sweep.is_empty() {
            tables.push(particle_table(&self.sweep));
        }
        tables.push(self.runs());
        tables
    }

    /// All runs that are there, of the sweep too.
    pub fn all_records(&self) -> impl Iterator<Item = &RunRecord> {
        let swept = self.sweep.iter().flat_map(|(_, records)| records);
        self.records.iter().chain(swept)
    }

    fn table_1(&self) -> Table {
        let mut table = self.summary(&TABLE_1);
        table.name = "table_1".to_owned();
        table.title = "Table 1: error, smoothness, drift, runtime".to_owned();
        table.note = format!(
            "{SPREAD} The last column repeats what the report says of its own, unpublished runs; nothing of it was measured here."
        );
        table.columns.push(Column {
            name: "claimed by the report".to_owned(),
            unit: "m".to_owned(),
            definition: "average positional error, unverified; on which sequence and from how many runs is not said"
                .to_owned(),
        });
        for (row, variant) in table.rows.iter_mut().zip(&self.variants) {
            row.push(variant.claimed_m.into());
        }
        table
    }

    fn table_2(&self) -> Table {
        Table {
            name: "table_2".to_owned(),
            title: "Table 2: x, y and heading apart, mean pose change".to_owned(),
            note: SPREAD.to_owned(),
            ..self.summary(&TABLE_2)
        }
    }

    /// A row per configuration.
    fn summary(&self, measures: &[Measure]) -> Table {
        let head = [Column::named("configuration"), runs_column(), success()];
        let row = |variant: &Variant| {
            let name = variant.name.as_str();
            let found: Vec<&RunRecord> = self.of(None, name).collect();
            let planned = self.seeds * self.sequences.len();
            let begin = [
                name.into(),
                Cell::Text(format!("{} of {planned}", found.len())),
                rate(found.iter().copied()).into(),
            ];
            let numbers = measures
                .iter()
                .map(|measure| mean_with_spread(&self.numbers(name, measure)).into());
            begin.into_iter().chain(numbers).collect()
        };
        Table {
            columns: head
                .into_iter()
                .chain(measures.iter().map(column))
                .collect(),
            rows: self.variants.iter().map(row).collect(),
            ..Table::default()
        }
    }

    /// A row per contrast, a column per measure.
    fn differences(&self) -> Table {
        let head = [Column::named("configuration"), Column::named("against")];
        let row = |contrast: &Contrast| {
            let begin = [contrast.of.as_str(), contrast.against.as_str()].map(Cell::from);
            let numbers = CONTRASTED
                .iter()
                .map(|measure| paired_difference(&self.pairs(contrast, measure)).into());
            begin.into_iter().chain(numbers).collect()
        };
        Table {
            name: "differences".to_owned(),
            title: "Differences of runs with the same sequence and seed".to_owned(),
            note: "Mean difference, and the interval of 95 % of Student's paired test with each sequence a stratum. `yes`: the interval leaves zero out, the difference is one for other seeds on these sequences; `no`: it may be chance. Not corrected for the number of differences looked at. Negative is less error, less jitter, less time.".to_owned(),
            columns: head.into_iter().chain(CONTRASTED.iter().map(column)).collect(),
            rows: self.contrasts.iter().map(row).collect(),
        }
    }

    /// A row per sequence and configuration.
    fn by_sequence(&self) -> Table {
        let measures = [
            TABLE_1[0], TABLE_2[0], TABLE_2[1], TABLE_2[2], TABLE_1[2], TABLE_1[5],
        ];
        let head = ["sequence", "configuration"].map(Column::named);
        let mut rows = Vec::new();
        for sequence in &self.sequences {
            for variant in &self.variants {
                let name = variant.name.as_str();
                let found: Vec<&RunRecord> = self.of(Some(sequence), name).collect();
                let begin = [
                    sequence.as_str().into(),
                    name.into(),
                    rate(found.iter().copied()).into(),
                ];
                let numbers = measures.iter().map(|measure| {
                    let numbers = found.iter().filter_map(|run| number(run, measure));
                    mean_with_spread(&[numbers.collect()]).into()
                });
                rows.push(begin.into_iter().chain(numbers).collect());
            }
        }
        Table {
            name: "by_sequence".to_owned(),
            title: "The sequences one by one".to_owned(),
            note: "Mean ± standard deviation over seeds.".to_owned(),
            columns: head
                .into_iter()
                .chain([success()])
                .chain(measures.iter().map(column))
                .collect(),
            rows,
        }
    }

    /// A row per sequence and configuration, a column per stage.
    fn timing(&self) -> Table {
        let stages: BTreeSet<&String> = self
            .records
            .iter()
            .flat_map(|record| record.stage_seconds.keys())
            .collect();
        let seconds = |stage: &&String| Column {
            name: (*stage).clone(),
            unit: "s".to_owned(),
            definition: "wall time of the whole drive, reading and drawing included".to_owned(),
        };
        let per_frame = TABLE_1[5];
        let head = ["sequence", "configuration"].map(Column::named);
        let mut rows = Vec::new();
        for sequence in &self.sequences {
            for variant in &self.variants {
                let found: Vec<&RunRecord> = self.of(Some(sequence), &variant.name).collect();
                let begin = [sequence.as_str().into(), variant.name.as_str().into()];
                let times = stages.iter().map(|stage| {
                    let times = found.iter().filter_map(|run| run.stage_seconds.get(*stage));
                    mean_with_spread(&[times.copied().collect()]).into()
                });
                let of_frames = found.iter().filter_map(|run| number(run, &per_frame));
                let of_frames = mean_with_spread(&[of_frames.collect()]).into();
                rows.push(begin.into_iter().chain(times).chain([of_frames]).collect());
            }
        }
        Table {
            name: "timing".to_owned(),
            title: "Time per stage".to_owned(),
            note: "Mean ± standard deviation over seeds. What several runs share, such as a map, was made once and is told with the time that it took then.".to_owned(),
            columns: head
                .into_iter()
                .chain(stages.iter().map(seconds))
                .chain([column(&per_frame)])
                .collect(),
            rows,
        }
    }

    /// A row per run.
    fn runs(&self) -> Table {
        let measures: Vec<Measure> = [TABLE_1, TABLE_2].concat();
        let head = ["run", "success"].map(Column::named);
        let mut records: Vec<&RunRecord> = self.records.iter().collect();
        records.sort_by_key(|record| (self.place(record), record.id.seed));
        records.extend(self.sweep.iter().flat_map(|(_, records)| records));
        let row = |record: &&RunRecord| {
            let link = Cell::Link {
                text: record.id.to_string(),
                to: format!("runs/{}/report.html", record.id),
            };
            let success = if record.is_success() { "yes" } else { "no" };
            let numbers = measures.iter().map(|m| Cell::from(number(record, m)));
            [link, success.into()].into_iter().chain(numbers).collect()
        };
        Table {
            name: "runs".to_owned(),
            title: "All runs".to_owned(),
            note: String::new(),
            columns: head
                .into_iter()
                .chain(measures.iter().map(column))
                .collect(),
            rows: records.iter().map(row).collect(),
        }
    }

    /// The order of sequences and configurations.
    fn place(&self, record: &RunRecord) -> (usize, usize) {
        let last = usize::MAX;
        let sequences = &mut self.sequences.iter();
        let sequence = sequences.position(|name| *name == record.id.sequence);
        let variants = &mut self.variants.iter();
        let variant = variants.position(|variant| variant.name == record.id.configuration);
        (sequence.unwrap_or(last), variant.unwrap_or(last))
    }

    /// The runs of a configuration, in one sequence or in all.
    pub fn of<'a>(
        &'a self,
        sequence: Option<&'a str>,
        variant: &'a str,
    ) -> impl Iterator<Item = &'a RunRecord> {
        self.records.iter().filter(move |record| {
            record.id.configuration == variant
                && match sequence {
                    Some(sequence) => record.id.sequence == sequence,
                    None => self.sequences.contains(&record.id.sequence),
                }
        })
    }

    /// The numbers of a configuration, per sequence.
    fn numbers(&self, variant: &str, measure: &Measure) -> Vec<Vec<f64>> {
        let of_sequence = |sequence: &String| {
            self.of(Some(sequence), variant)
                .filter_map(|record| number(record, measure))
                .collect()
        };
        self.sequences.iter().map(of_sequence).collect()
    }

    /// The differences of a contrast, per sequence, over the seeds that both have.
    fn pairs(&self, contrast: &Contrast, measure: &Measure) -> Vec<Vec<f64>> {
        let of_sequence = |sequence: &String| {
            self.of(Some(sequence), &contrast.of)
                .filter_map(|run| {
                    let other = self
                        .of(Some(sequence), &contrast.against)
                        .find(|other| other.id.seed == run.id.seed)?;
                    Some(number(run, measure)? - number(other, measure)?)
                })
                .collect()
        };
        self.sequences.iter().map(of_sequence).collect()
    }
}

/// How often the car was found for so many particles: a row per number.
fn particle_table(rows: &[(usize, Vec<RunRecord>)]) -> Table {
    let measures = [TABLE_1[0], TABLE_2[2], TABLE_1[5]];
    let head = [Column::named("particles"), runs_column(), success()];
    let row = |(count, records): &(usize, Vec<RunRecord>)| {
        let begin = [
            Cell::Number(*count as f64),
            Cell::Text(records.len().to_string()),
            rate(records).into(),
        ];
        let found: Vec<&RunRecord> = records.iter().filter(|run| run.is_success()).collect();
        let numbers = measures.iter().map(|measure| {
            let numbers = found.iter().filter_map(|run| number(run, measure));
            mean_with_spread(&[numbers.collect()]).into()
        });
        begin.into_iter().chain(numbers).collect()
    };
    Table {
        name: "particles".to_owned(),
        title: "Success against the number of particles".to_owned(),
        note: "Numbers other than the success are of the runs that succeeded: mean ± standard deviation.".to_owned(),
        columns: head.into_iter().chain(measures.iter().map(column)).collect(),
        rows: rows.iter().map(row).collect(),
    }
}

/// The share of runs in which the car was found and kept.
pub fn rate<'a>(records: impl IntoIterator<Item = &'a RunRecord>) -> Option<SuccessRate> {
    let outcomes: Vec<bool> = records.into_iter().map(RunRecord::is_success).collect();
    let successes = outcomes.iter().filter(|is_success| **is_success).count();
    success_rate(successes, outcomes.len())
}

fn number(record: &RunRecord, measure: &Measure) -> Option<f64> {
    (measure.of)(record.judgement()?)
}

fn column(measure: &Measure) -> Column {
    Column {
        name: measure.name.to_owned(),
        unit: measure.unit.to_owned(),
        definition: measure.definition.to_owned(),
    }
}

fn runs_column() -> Column {
    Column {
        definition: "finished runs, of those that are planned".to_owned(),
        ..Column::named("runs")
    }
}

fn success() -> Column {
    Column {
        name: "success".to_owned(),
        unit: "%".to_owned(),
        definition: "found within 0.5 m and 2 degrees for ten frames in a row, and kept within them to the end; with Wilson's interval of 95 %".to_owned(),
    }
}

#[cfg(test)]
#[path = "tables_tests.rs"]
mod tests;
