//! Statistics over seeds and sequences: means, paired differences, success rates.

use statrs::distribution::{ContinuousCDF as _, StudentsT};

use crate::app::comparison::table::{MeanWithSpread, PairedDifference, SuccessRate};
use crate::evaluation::statistics::mean;

/// Mean with standard deviations, from the values of each sequence, one per seed; `None` without
/// values.
///
/// ```text
/// mean            = mean of the means of the sequences (equal weight per sequence)
/// over_seeds      = √ mean of the variances of the sequences    (n − 1)
/// over_sequences  = standard deviation of the means of the sequences    (n − 1)
/// ```
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

/// Unbiased variance; `None` for fewer than two values.
fn variance(values: &[f64]) -> Option<f64> {
    let mean = mean(values)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| squares / (values.len() - 1) as f64)
}

/// Mean difference of two configurations with its 95 % confidence interval, from the differences
/// of runs with the same seed in each sequence; `None` without differences.
///
/// With the mean d̄ₛ and the variance vₛ of the nₛ differences of each of the S sequences:
///
/// ```text
/// d̄ = mean of d̄ₛ                       se² = Σ vₛ / nₛ / S²
/// interval = d̄ ± t₀.₉₇₅(ν) se          ν = se⁴ / Σ (vₛ / nₛ / S²)² / (nₛ − 1)
/// ```
///
/// Student's paired interval with the degrees of freedom of Welch (1947) and Satterthwaite (1946),
/// stratified by sequence. It generalizes to other seeds on these sequences, not to other
/// sequences, and is not corrected for multiple comparisons. There is no interval if a sequence has
/// a single difference, whose variance is unknown.
pub fn paired_difference(sequences: &[Vec<f64>]) -> Option<PairedDifference> {
    let sequences: Vec<&Vec<f64>> = sequences.iter().filter(|s| !s.is_empty()).collect();
    let means: Vec<f64> = sequences.iter().filter_map(|pairs| mean(pairs)).collect();
    let mean = mean(&means)?;
    let strata = sequences.len() as f64;
    let error = |pairs: &&Vec<f64>| {
        let n = pairs.len() as f64;
        Some((variance(pairs)? / n / strata.powi(2), n - 1.0))
    };
    let errors: Option<Vec<(f64, f64)>> = sequences.iter().map(error).collect();
    Some(PairedDifference {
        mean,
        interval: errors.and_then(|errors| confidence_interval(mean, &errors)),
        pairs: sequences.iter().map(|pairs| pairs.len()).sum(),
    })
}

/// 95 % interval around a mean, from the squared standard error and the degrees of freedom of each
/// stratum.
fn confidence_interval(mean: f64, strata: &[(f64, f64)]) -> Option<(f64, f64)> {
    let squared: f64 = strata.iter().map(|(share, _)| share).sum();
    if squared == 0.0 {
        return Some((mean, mean));
    }
    let scatter: f64 = strata.iter().map(|(s, degrees)| s * s / degrees).sum();
    let student = StudentsT::new(0.0, 1.0, squared * squared / scatter).ok()?;
    let reach = student.inverse_cdf(0.975) * squared.sqrt();
    Some((mean - reach, mean + reach))
}

/// Success rate with its 95 % confidence interval; `None` without runs.
///
/// ```text
/// centre ± reach = (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n)     z = 1.96
/// ```
///
/// Wilson, *Probable inference, the law of succession, and statistical inference*, JASA 1927. The
/// interval stays within 0 and 1, also for five successes in five runs.
pub fn success_rate(successes: usize, runs: usize) -> Option<SuccessRate> {
    const Z: f64 = 1.959_964;
    if runs == 0 {
        return None;
    }
    let n = runs as f64;
    let rate = successes as f64 / n;
    let squared = Z * Z / n;
    let centre = rate + 0.5 * squared;
    let reach = Z * (rate * (1.0 - rate) / n + 0.25 * squared / n).sqrt();
    Some(SuccessRate {
        successes,
        runs,
        rate,
        low: ((centre - reach) / (1.0 + squared)).max(0.0),
        high: ((centre + reach) / (1.0 + squared)).min(1.0),
    })
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn deviations_over_seeds_and_over_sequences_are_separate() {
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
    fn every_sequence_has_the_same_weight() {
        let estimate = mean_with_spread(&[vec![1.0; 9], vec![3.0], vec![]]).unwrap();
        assert_relative_eq!(estimate.mean, 2.0);
    }

    #[test]
    fn one_run_has_no_deviation_and_no_run_has_no_mean() {
        let one = mean_with_spread(&[vec![0.5]]).unwrap();
        assert_eq!((one.over_seeds, one.over_sequences), (None, None));
        assert_eq!(mean_with_spread(&[vec![], vec![]]), None);
    }

    #[test]
    fn for_one_sequence_the_interval_is_the_paired_t_interval_of_scipy() {
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
    fn the_degrees_of_freedom_of_two_equal_sequences_add_up() {
        let pairs = vec![1.0, 2.0, 3.0];
        let found = paired_difference(&[pairs.clone(), pairs]).unwrap();
        // t(0.975, 4) = 2.776445, standard error √(2 · 1 / 3 / 4)
        let reach = 2.776_445_1 * (2.0_f64 / 12.0).sqrt();
        assert_relative_eq!(found.interval.unwrap().1, 2.0 + reach, epsilon = 1e-6);
        assert_eq!((found.is_significant(), found.pairs), (Some(true), 6));
    }

    #[test]
    fn exchanging_the_two_configurations_negates_the_interval() {
        let differences = vec![vec![0.1, 0.4, 0.3], vec![-0.2, 0.1, 0.2, 0.6]];
        let negated: Vec<Vec<f64>> = differences
            .iter()
            .map(|pairs| pairs.iter().map(|d| -d).collect())
            .collect();
        let interval = |d: &[Vec<f64>]| paired_difference(d).unwrap().interval.unwrap();
        let ((low, high), back) = (interval(&differences), interval(&negated));
        assert_relative_eq!(back.0, -high, epsilon = 1e-12);
        assert_relative_eq!(back.1, -low, epsilon = 1e-12);
    }

    #[test]
    fn one_pair_has_no_interval_and_equal_values_are_not_significant() {
        let one = paired_difference(&[vec![0.7]]).unwrap();
        assert_eq!(one.is_significant(), None);
        let same = paired_difference(&[vec![0.0; 5]]).unwrap();
        assert_eq!(same.is_significant(), Some(false));
        assert_eq!(paired_difference(&[vec![], vec![]]), None);
    }

    #[test]
    fn the_success_interval_follows_the_formula() {
        // The formula in NumPy for 8 of 10:
        // (0.4901624691, 0.9433178490)
        let rate = success_rate(8, 10).unwrap();
        assert_relative_eq!(rate.low, 0.490_162_5, epsilon = 1e-6);
        assert_relative_eq!(rate.high, 0.943_317_8, epsilon = 1e-6);
    }

    #[test]
    fn five_of_five_are_not_certain_and_failures_mirror_successes() {
        let all = success_rate(5, 5).unwrap();
        assert_eq!((all.rate, all.high), (1.0, 1.0));
        assert!(all.low > 0.5 && all.low < 0.6);
        let none = success_rate(0, 5).unwrap();
        assert_relative_eq!(none.high, 1.0 - all.low, epsilon = 1e-12);
        assert_eq!(success_rate(0, 0), None);
    }
}
