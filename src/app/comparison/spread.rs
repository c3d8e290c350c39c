//! Mean and scatter over seeds and over sequences.
//!
//! ```text
//! mean            = mean of the sequences' means: each sequence counts the same
//! over_seeds      = √ mean of the sequences' variances    (n − 1)
//! over_sequences  = standard deviation of the sequences' means    (n − 1)
//! ```

use serde::{Deserialize, Serialize};

use crate::evaluation::statistics::mean;

/// A mean with its scatter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Mean of the sequences' means.
    pub mean: f64,
    /// Standard deviation over seeds within a sequence; absent where no sequence has two runs.
    pub over_seeds: Option<f64>,
    /// Standard deviation of the sequences' means; absent of one sequence.
    pub over_sequences: Option<f64>,
    /// Runs that it is made of.
    pub runs: usize,
}

impl Estimate {
    /// Of the numbers of each sequence, one per seed; `None` without numbers.
    pub fn of(sequences: &[Vec<f64>]) -> Option<Self> {
        let means: Vec<f64> = sequences.iter().filter_map(|seeds| mean(seeds)).collect();
        let variances: Vec<f64> = sequences.iter().filter_map(|s| variance(s)).collect();
        Some(Self {
            mean: mean(&means)?,
            over_seeds: mean(&variances).map(f64::sqrt),
            over_sequences: variance(&means).map(f64::sqrt),
            runs: sequences.iter().map(Vec::len).sum(),
        })
    }
}

/// Unbiased variance; `None` of fewer than two numbers.
pub fn variance(numbers: &[f64]) -> Option<f64> {
    let mean = mean(numbers)?;
    let squares: f64 = numbers.iter().map(|number| (number - mean).powi(2)).sum();
    (numbers.len() > 1).then(|| squares / (numbers.len() - 1) as f64)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn scatter_of_seeds_and_of_sequences_are_told_apart() {
        let same_seeds = Estimate::of(&[vec![1.0; 3], vec![3.0; 3]]).unwrap();
        assert_relative_eq!(same_seeds.mean, 2.0);
        assert_eq!(same_seeds.over_seeds, Some(0.0));
        assert_relative_eq!(same_seeds.over_sequences.unwrap(), 2_f64.sqrt());
        let same_sequences = Estimate::of(&[vec![1.0, 3.0], vec![3.0, 1.0]]).unwrap();
        assert_relative_eq!(same_sequences.over_seeds.unwrap(), 2_f64.sqrt());
        assert_eq!(same_sequences.over_sequences, Some(0.0));
        assert_eq!(same_sequences.runs, 4);
    }

    #[test]
    fn a_sequence_with_more_seeds_counts_no_more() {
        let estimate = Estimate::of(&[vec![1.0; 9], vec![3.0], vec![]]).unwrap();
        assert_relative_eq!(estimate.mean, 2.0);
    }

    #[test]
    fn one_run_has_no_scatter_and_none_has_no_mean() {
        let one = Estimate::of(&[vec![0.5]]).unwrap();
        assert_eq!((one.over_seeds, one.over_sequences), (None, None));
        assert_eq!(Estimate::of(&[vec![], vec![]]), None);
    }
}
