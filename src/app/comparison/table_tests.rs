//! A table for the tests of every format.

use super::table::{Cell, Column, MeanWithSpread, SuccessRate, Table};

/// Five successes in five runs.
pub fn all_successful() -> SuccessRate {
    SuccessRate {
        successes: 5,
        runs: 5,
        rate: 1.0,
        low: 0.565_518,
        high: 1.0,
    }
}

/// Two rows with text, link, number, mean, rate and an absent cell.
pub fn example() -> Table {
    let column = |name: &str, unit: &str| Column {
        name: name.to_owned(),
        unit: unit.to_owned(),
        definition: "a | b <c>".to_owned(),
    };
    let mean = MeanWithSpread {
        mean: 0.023,
        over_seeds: Some(0.002),
        over_sequences: None,
        runs: 5,
    };
    let link = Cell::Link {
        text: "B|C".to_owned(),
        to: "runs/b.html".to_owned(),
    };
    Table {
        name: "table_1".to_owned(),
        title: "Table 1: errors".to_owned(),
        note: "What <b> means.".to_owned(),
        columns: vec![
            Column::named("configuration"),
            column("average positional error", "m"),
            column("success", "%"),
        ],
        rows: vec![
            vec!["A, \"first\"".into(), mean.into(), all_successful().into()],
            vec![link, 0.5.into(), Cell::Absent],
        ],
    }
}
