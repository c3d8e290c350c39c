//! Mean and scatter over seeds and over sequences.
//!
//! ```text
//! mean            = mean of the sequences' means: each sequence counts the same
//! over_seeds      = √ mean of the sequences' variances    (n − 1)
//! over_sequences  = standard deviation of the sequences' means    (n − 1)
//! ```

use crate::app::reporting::MeanWithSpread;
use crate::evaluation::statistics::mean;

/// Mean and spread of the numbers of each sequence, one per seed; `None` without numbers.
pub fn mean_with_spread(sequences: &[Vec<f64>]) -> Option<MeanWithSpread> {
    let means: Vec<f64> = sequences.iter().filter_map(|seeds| mean(seeds)).collect();
    let variances: Vec<f64> = sequences.iter().filter_map(|s| variance(s)).collect();
    Some(MeanWithSpread {
        mean: mean(&means)?,
        over_seeds: mean(&variances).map(f64::sqrt),
        over_sequences: variance(&means).map(f64::sqrt),
        runs: sequences.iter().map(Vec::len).sum(),
    })
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
        let same_seeds = mean_with_spread(&[vec![1.0; 3], vec![3.0; 3]]).unwrap();
        assert_relative_eq!(same_seeds.mean, 2.0);
        assert_eq!(same_seeds.over_seeds, Some(0.0));
        assert_relative_eq!(same_seeds.over_sequences.unwrap(), 2_f64.sqrt());
        let same_sequences = mean_with_spread(&[vec![1.0, 3.0], vec![3.0, 1.0]]).unwrap();
        assert_relative_eq!(same_sequences.over_seeds.unwrap(), 2_f64.sqrt());
        assert_eq!(same_sequences.over_sequences, Some(0.0));
        assert_eq!(same_sequences.runs, 4);
    }

    #[test]
    fn a_sequence_with_more_seeds_counts_no_more() {
        let estimate = mean_with_spread(&[vec![1.0; 9], vec![3.0], vec![]]).unwrap();
        assert_relative_eq!(estimate.mean, 2.0);
    }

    #[test]
    fn one_run_has_no_scatter_and_none_has_no_mean() {
        let one = mean_with_spread(&[vec![0.5]]).unwrap();
        assert_eq!((one.over_seeds, one.over_sequences), (None, None));
        assert_eq!(mean_with_spread(&[vec![], vec![]]), None);
    }
}
