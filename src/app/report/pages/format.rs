//! Text of a cell: its value and its uncertainty.

use super::Cell;
use crate::app::report::results::Value;

/// Formats a cell as its value and its uncertainty, which may be empty.
pub fn value_and_uncertainty(cell: &Cell) -> (String, String) {
    match cell {
        Cell::Text(text) | Cell::Link { text, .. } => (text.clone(), String::new()),
        Cell::Number(value) if value.fract() == 0.0 && value.abs() < 1e9 => {
            (format!("{value:.0}"), String::new())
        }
        Cell::Number(value) => (four_digits(*value), String::new()),
        Cell::Mean(mean) => {
            let deviations = [mean.over_seeds, mean.over_sequences].into_iter().flatten();
            let deviations: Vec<String> =
                deviations.map(|d| format!("±{}", two_digits(d))).collect();
            (four_digits(mean.mean), deviations.join(" "))
        }
        Cell::Difference(difference) => {
            let significance = match difference.is_significant() {
                Some(true) => " yes",
                Some(false) => " no",
                None => "",
            };
            let interval = difference
                .interval
                .map(|(low, high)| format!("{} .. {}", signed(low), signed(high)));
            (
                format!("{}{significance}", signed(difference.mean)),
                interval.unwrap_or_default(),
            )
        }
        Cell::Rate(rate) => (
            format!("{:.0}", 100.0 * rate.rate),
            format!("{:.0} .. {:.0}", 100.0 * rate.low, 100.0 * rate.high),
        ),
        Cell::Absent => ("-".to_owned(), String::new()),
    }
}

fn four_digits(number: f64) -> String {
    Value::Number(number).to_string()
}

fn two_digits(number: f64) -> String {
    let digits = number.abs().max(1e-9).log10().floor() as i32;
    let decimals = (1 - digits).clamp(0, 4) as usize;
    format!("{number:.decimals$}")
}

/// Four digits with a sign, except for zero.
fn signed(value: f64) -> String {
    let text = four_digits(value);
    let is_zero = text.chars().all(|c| !c.is_ascii_digit() || c == '0');
    match (is_zero, value > 0.0) {
        (true, _) => text.trim_start_matches('-').to_owned(),
        (false, true) => format!("+{text}"),
        (false, false) => text,
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::all_successful;
    use super::super::{MeanWithSpread, PairedDifference};
    use super::*;

    #[test]
    fn the_value_comes_first_and_its_spread_second() {
        let mean = MeanWithSpread {
            mean: 0.023_41,
            over_seeds: Some(0.001_24),
            over_sequences: None,
            runs: 5,
        };
        let formatted = |cell: Cell| {
            let (value, uncertainty) = value_and_uncertainty(&cell);
            format!("{value}|{uncertainty}")
        };
        assert_eq!(formatted(mean.into()), "0.0234|±0.0012");
        assert_eq!(formatted(all_successful().into()), "100|57 .. 100");
        assert_eq!(formatted(1000.0.into()), "1000|");
        assert_eq!(formatted(Cell::Absent), "-|");
    }

    #[test]
    fn a_difference_is_marked_as_significant_or_not_and_zero_has_no_sign() {
        let formatted = |mean, interval| {
            value_and_uncertainty(&Cell::Difference(PairedDifference {
                mean,
                interval,
                pairs: 5,
            }))
        };
        let (value, interval) = formatted(-0.01, Some((-0.02, -0.001)));
        assert_eq!(
            (value.as_str(), interval.as_str()),
            ("-0.0100 yes", "-0.0200 .. -0.0010")
        );
        let (value, interval) = formatted(0.5, Some((-0.5, 1.5)));
        assert_eq!(
            (value.as_str(), interval.as_str()),
            ("+0.5000 no", "-0.5000 .. +1.500")
        );
        assert_eq!(formatted(-0.000_01, None).0, "0.0000");
    }
}
