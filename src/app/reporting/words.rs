//! How a cell is told in words.

use crate::app::comparison::Cell;
use crate::app::results::Value;

/// A number with four digits.
pub fn number(number: f64) -> String {
    Value::Number(number).to_string()
}

/// What stands in a cell: the number, and how sure it is, which may be empty.
pub fn parts(cell: &Cell) -> (String, String) {
    match cell {
        Cell::Text(text) | Cell::Link { text, .. } => (text.clone(), String::new()),
        Cell::Number(value) if value.fract() == 0.0 && value.abs() < 1e9 => {
            (format!("{value:.0}"), String::new())
        }
        Cell::Number(value) => (number(*value), String::new()),
        Cell::Estimate(estimate) => {
            let scatter = [estimate.over_seeds, estimate.over_sequences];
            let scatter: Vec<String> = (scatter.iter().flatten())
                .map(|deviation| format!("±{}", short(*deviation)))
                .collect();
            (number(estimate.mean), scatter.join(" "))
        }
        Cell::Difference(difference) => {
            let told = match difference.is_one() {
                Some(true) => " yes",
                Some(false) => " no",
                None => "",
            };
            let interval = difference
                .interval
                .map(|(low, high)| format!("{} .. {}", signed(low), signed(high)));
            (
                format!("{}{told}", signed(difference.mean)),
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

/// A scatter with two digits.
fn short(number: f64) -> String {
    let digits = number.abs().max(1e-9).log10().floor() as i32;
    let decimals = (1 - digits).clamp(0, 4) as usize;
    format!("{number:.decimals$}")
}

/// A number with its sign, which a zero does not have.
fn signed(value: f64) -> String {
    let text = number(value);
    let is_zero = text.chars().all(|c| !c.is_ascii_digit() || c == '0');
    match (is_zero, value > 0.0) {
        (true, _) => text.trim_start_matches('-').to_owned(),
        (false, true) => format!("+{text}"),
        (false, false) => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::comparison::{Estimate, PairedDifference, success_rate};

    #[test]
    fn numbers_come_first_and_their_scatter_after_them() {
        let estimate = Estimate {
            mean: 0.023_41,
            over_seeds: Some(0.001_24),
            over_sequences: None,
            runs: 5,
        };
        let told = |cell: Cell| {
            let (first, second) = parts(&cell);
            format!("{first}|{second}")
        };
        assert_eq!(told(Cell::Estimate(estimate)), "0.0234|±0.0012");
        assert_eq!(told(success_rate(5, 5).into()), "100|57 .. 100");
        assert_eq!(told(Cell::Number(1000.0)), "1000|");
        assert_eq!(told(Cell::Absent), "-|");
    }

    #[test]
    fn a_difference_says_whether_it_is_one_and_zero_has_no_sign() {
        let told = |mean, interval| {
            parts(&Cell::Difference(PairedDifference {
                mean,
                interval,
                pairs: 5,
            }))
        };
        let (first, second) = told(-0.01, Some((-0.02, -0.001)));
        assert_eq!(
            (first.as_str(), second.as_str()),
            ("-0.0100 yes", "-0.0200 .. -0.0010")
        );
        let (first, second) = told(0.5, Some((-0.5, 1.5)));
        assert_eq!(
            (first.as_str(), second.as_str()),
            ("+0.5000 no", "-0.5000 .. +1.500")
        );
        assert_eq!(told(-0.000_01, None).0, "0.0000");
    }
}
