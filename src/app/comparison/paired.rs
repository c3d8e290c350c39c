//! Whether two configurations differ, from runs with the same sequence and the same seed.
//!
//! Per sequence s the differences of its nₛ pairs have mean d̄ₛ and variance vₛ:
//!
//! ```text
//! d̄ = mean of d̄ₛ over S sequences      se² = Σ vₛ / nₛ / S²
//! interval = d̄ ± t₀.₉₇₅(ν) se          ν = se⁴ / Σ (vₛ / nₛ / S²)² / (nₛ − 1)
//! ```
//!
//! Student's paired interval with the degrees of freedom of Welch (1947) and Satterthwaite (1946),
//! each sequence a stratum. It speaks of other seeds on these sequences, not of other sequences,
//! and it is not corrected for looking at many differences at once.

use statrs::distribution::{ContinuousCDF as _, StudentsT};

use super::spread::variance;
use crate::app::reporting::PairedDifference;
use crate::evaluation::statistics::mean;

/// Probability that the interval holds the mean difference.
pub const CONFIDENCE: f64 = 0.95;

/// From the differences of each sequence, one per seed; `None` without differences.
///
/// A sequence with a single pair adds to the mean, and takes the interval away: its scatter is
/// not known.
pub fn paired_difference(sequences: &[Vec<f64>]) -> Option<PairedDifference> {
    let sequences: Vec<&Vec<f64>> = sequences.iter().filter(|pairs| !pairs.is_empty()).collect();
    let means: Vec<f64> = sequences.iter().filter_map(|pairs| mean(pairs)).collect();
    let mean = mean(&means)?;
    let strata = sequences.len() as f64;
    let share = |pairs: &&Vec<f64>| {
        let degrees = pairs.len() as f64 - 1.0;
        Some((
            variance(pairs)? / pairs.len() as f64 / strata.powi(2),
            degrees,
        ))
    };
    let shares: Option<Vec<(f64, f64)>> = sequences.iter().map(share).collect();
    Some(PairedDifference {
        mean,
        interval: shares.and_then(|shares| interval(mean, &shares)),
        pairs: sequences.iter().map(|pairs| pairs.len()).sum(),
    })
}

/// From the squared standard error of each sequence, and its degrees of freedom.
fn interval(mean: f64, shares: &[(f64, f64)]) -> Option<(f64, f64)> {
    let squared: f64 = shares.iter().map(|(share, _)| share).sum();
    if squared == 0.0 {
        return Some((mean, mean));
    }
    let scatter: f64 = shares.iter().map(|(s, degrees)| s * s / degrees).sum();
    let student = StudentsT::new(0.0, 1.0, squared * squared / scatter).ok()?;
    let reach = student.inverse_cdf(0.5 + 0.5 * CONFIDENCE) * squared.sqrt();
    Some((mean - reach, mean + reach))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn of_one_sequence_it_is_the_paired_t_interval_of_scipy() {
        // d = [0.1, 0.3, 0.2, 0.5, -0.1]
        // scipy.stats.t.interval(0.95, 4, loc=np.mean(d), scale=scipy.stats.sem(d))
        //   = (-0.07764451, 0.47764451)
        let found = paired_difference(&[vec![0.1, 0.3, 0.2, 0.5, -0.1]]).unwrap();
        let (low, high) = found.interval.unwrap();
        assert_relative_eq!(found.mean, 0.2, epsilon = 1e-12);
        assert_relative_eq!(low, -0.077_644_51, epsilon = 1e-7);
        assert_relative_eq!(high, 0.477_644_51, epsilon = 1e-7);
        assert_eq!(found.is_significant(), Some(false));
    }

    #[test]
    fn of_two_like_sequences_it_has_their_degrees_of_freedom_together() {
        let pairs = vec![1.0, 2.0, 3.0];
        let found = paired_difference(&[pairs.clone(), pairs]).unwrap();
        // t(0.975, 4) = 2.776445, standard error √(2 · 1 / 3 / 4)
        let reach = 2.776_445_1 * (2.0_f64 / 12.0).sqrt();
        assert_relative_eq!(found.interval.unwrap().1, 2.0 + reach, epsilon = 1e-6);
        assert_eq!((found.is_significant(), found.pairs), (Some(true), 6));
    }

    #[test]
    fn exchanging_the_two_turns_the_interval_around() {
        let differences = vec![vec![0.1, 0.4, 0.3], vec![-0.2, 0.1, 0.2, 0.6]];
        let turned: Vec<Vec<f64>> = differences
            .iter()
            .map(|pairs| pairs.iter().map(|d| -d).collect())
            .collect();
        let (low, high) = paired_difference(&differences).unwrap().interval.unwrap();
        let back = paired_difference(&turned).unwrap().interval.unwrap();
        assert_relative_eq!(back.0, -high, epsilon = 1e-12);
        assert_relative_eq!(back.1, -low, epsilon = 1e-12);
    }

    #[test]
    fn one_pair_says_nothing_and_the_same_numbers_do_not_differ() {
        assert_eq!(
            paired_difference(&[vec![0.7]]).unwrap().is_significant(),
            None
        );
        let same = paired_difference(&[vec![0.0; 5]]).unwrap();
        assert_eq!(same.is_significant(), Some(false));
        assert_eq!(paired_difference(&[vec![], vec![]]), None);
    }
}
