//! States that can be trusted, per sequence; and the page of hard cases, `cases.md`.

use std::fmt::Write as _;

use super::formats::markdown;
use super::record::RunRecord;
use super::results::ComparisonResults;
use crate::app::comparison::table::{Cell, Column, Table};
use crate::evaluation::trust::Trust;
use crate::statistics::median;

/// Title of the table of states.
const TITLE: &str = "States that can be trusted";
const NOTE: &str = "Frames of the filter. Times and counts are those of the worst run, errors and axes those of the median run, unless stated otherwise.";

/// One row per sequence and configuration.
pub fn states(results: &ComparisonResults) -> Table {
    let mut rows = Vec::new();
    for sequence in &results.sequences {
        for variant in &results.config.configurations {
            let runs = results.runs(sequence, &variant.name);
            let names = [sequence.as_str().into(), variant.name.as_str().into()];
            rows.push(names.into_iter().chain(cells(&runs)).collect());
        }
    }
    Table {
        name: "states".to_owned(),
        title: TITLE.to_owned(),
        note: NOTE.to_owned(),
        columns: columns(),
        rows,
    }
}

/// The page of the sequences that are described as cases; `None` without any.
pub fn page(results: &ComparisonResults, program: &str) -> Option<String> {
    let described = results.config.sequences.iter();
    let described: Vec<_> = described.filter(|case| !case.about.is_empty()).collect();
    if described.is_empty() {
        return None;
    }
    let mut text = "# Hard cases\n\nWritten by `fpmcl compare` with the configuration of this comparison: of each case drive 1 is mapped and drive 2 localized, with exact truth.\n\n".to_owned();
    let machine = results.records.first().map(|record| {
        let of_machine = record
            .machine
            .iter()
            .map(|(key, value)| format!("{key} {value}"));
        of_machine.collect::<Vec<_>>().join(", ")
    });
    let seeds = results.config.seeds.len();
    let _ = writeln!(
        text,
        "{program}; {}; seeds: {seeds}.\n",
        machine.unwrap_or_default()
    );
    text.push_str(&markdown::table(&states(results)));
    for case in described {
        let _ = write!(text, "\n## {}\n\n{}\n", case.name, case.about);
        let _ = write!(
            text,
            "\n![{0}: errors over time](plots/errors_{0}.png)\n",
            case.name
        );
        for variant in &results.config.configurations {
            let runs = results.runs(&case.name, &variant.name);
            let found = verdict(&runs);
            if found != HOLDS {
                let _ = write!(
                    text,
                    "\n**{}: {found}.**\n\n![{1}: path](plots/paths_{1}.png)\n",
                    variant.name, case.name
                );
            }
        }
        if !case.tried.is_empty() {
            let _ = write!(text, "\nTried: {}\n", case.tried);
        }
    }
    Some(text)
}

const HOLDS: &str = "holds";

/// What holds of the runs of a case.
fn verdict(runs: &[&RunRecord]) -> String {
    let trusts: Vec<&Trust> = runs.iter().filter_map(|run| run.trust.as_ref()).collect();
    let wrong: usize = trusts.iter().map(|trust| trust.wrong).sum();
    let missed = trusts.iter().filter(|trust| trust.tracking == 0).count();
    let failed = runs.iter().filter(|run| run.metrics().is_none()).count();
    let frames: usize = trusts.iter().map(|trust| trust.frames).sum();
    let mut parts = Vec::new();
    if wrong > 0 {
        parts.push(format!(
            "wrong while tracking in {wrong} of {frames} frames"
        ));
    }
    if missed > 0 {
        parts.push(format!("never tracking in {missed} of {} runs", runs.len()));
    }
    if failed > 0 {
        parts.push(format!(
            "{failed} of {} runs ended with an error",
            runs.len()
        ));
    }
    if parts.is_empty() {
        HOLDS.to_owned()
    } else {
        parts.join("; ")
    }
}

fn columns() -> Vec<Column> {
    let column = |(name, unit, definition): (&str, &str, &str)| Column {
        name: name.to_owned(),
        unit: unit.to_owned(),
        definition: definition.to_owned(),
    };
    [
        ("case", "", ""),
        ("configuration", "", ""),
        ("verdict", "", "whether no run has a frame that is wrong while tracking, and every run is tracking at least once"),
        ("frames", "", "per run"),
        ("wrong", "", "frames of all runs that are off by more than 0.5 m while tracking; must be 0"),
        ("right but unsure", "", "frames within 0.5 m that are not tracking"),
        ("found after", "s", "time until the first frame that is tracking"),
        ("to notice", "s", "longest time wrong and tracking"),
        ("to recover", "s", "longest time not tracking after the first frame that is"),
        ("position", "m", "median error while tracking"),
        ("worst", "m", "largest position error while tracking, of all runs"),
        ("heading", "deg", "median error while tracking"),
        ("inside", "%", "tracking frames whose truth is inside the 95 % region of their covariance"),
        ("widest", "m", "largest standard deviation along any axis while tracking"),
        ("across it", "m", "standard deviation across that axis in the same frame"),
        ("direction", "deg", "angle of that axis to the direction of the car"),
        ("places", "", "places where the car may be, before the first frame that is tracking"),
    ]
    .map(column)
    .into()
}

fn cells(runs: &[&RunRecord]) -> Vec<Cell> {
    let trusts: Vec<&Trust> = runs.iter().filter_map(|run| run.trust.as_ref()).collect();
    type Value = fn(&Trust) -> Option<f64>;
    let all = |value: Value| trusts.iter().filter_map(move |trust| value(trust));
    let worst = |value: Value| -> Cell { all(value).reduce(f64::max).into() };
    let median = |value: Value| -> Cell { median(all(value)).into() };
    let wrong: usize = trusts.iter().map(|trust| trust.wrong).sum();
    vec![
        Cell::Text(verdict(runs)),
        median(|trust| Some(trust.frames as f64)),
        Cell::Number(wrong as f64),
        worst(|trust| Some(trust.unsure as f64)),
        worst(|trust| trust.found_after_s),
        worst(|trust| Some(trust.notice_s)),
        worst(|trust| Some(trust.recover_s)),
        median(|trust| trust.median_m),
        worst(|trust| trust.worst_m),
        median(|trust| trust.median_heading_rad.map(f64::to_degrees)),
        median(|trust| trust.inside.map(|share| 100.0 * share)),
        median(|trust| trust.widest_m),
        median(|trust| trust.narrowest_m),
        median(|trust| trust.widest_direction_rad.map(f64::to_degrees)),
        median(|trust| trust.places),
    ]
}
