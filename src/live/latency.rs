//! Percentiles of latencies over any time, in constant memory.
//!
//! Counts in classes whose bounds are in a constant ratio, so that the relative error of every percentile is bounded:
//!
//! ```text
//! class k: [ 0.1 ms · r^k, 0.1 ms · r^(k+1) )     r = 1.02
//! ```
//!
//! Masson, Rim and Lee, *DDSketch: A Fast and Fully-Mergeable Quantile Sketch with Relative-Error Guarantees*, VLDB 2019.

use std::time::Duration;

/// Ratio of the bounds of a class.
const RATIO: f64 = 1.02;
/// Lower bound of the first class [s].
const LEAST_S: f64 = 1e-4;
/// Number of classes: up to a minute and a half.
const CLASSES: usize = 700;

/// Latencies of all scans.
#[derive(Clone, Debug, PartialEq)]
pub struct Latencies {
    counts: Vec<u64>,
    max: Duration,
}

impl Default for Latencies {
    fn default() -> Self {
        Self {
            counts: vec![0; CLASSES],
            max: Duration::ZERO,
        }
    }
}

impl Latencies {
    /// Counts a latency.
    pub fn add(&mut self, latency: Duration) {
        let class = (latency.as_secs_f64() / LEAST_S).max(1.0).ln() / RATIO.ln();
        self.counts[(class as usize).min(CLASSES - 1)] += 1;
        self.max = self.max.max(latency);
    }

    /// Number of latencies.
    pub fn count(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// The largest one.
    pub fn max(&self) -> Duration {
        self.max
    }

    /// The latency that a share of all does not exceed, too large by at most 2 %; `None` without any.
    pub fn percentile(&self, share: f64) -> Option<Duration> {
        let rank = (share * self.count() as f64).ceil().max(1.0) as u64;
        let mut below = 0;
        let class = self.counts.iter().position(|count| {
            below += count;
            below >= rank
        })?;
        let bound_s = LEAST_S * RATIO.powi(class as i32 + 1);
        Some(Duration::from_secs_f64(bound_s).min(self.max))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_sorted_latencies_within_two_percent() {
        let mut latencies = Latencies::default();
        assert_eq!(latencies.percentile(0.5), None);
        let sorted: Vec<Duration> = (1..=1000).map(|k| Duration::from_micros(137 * k)).collect();
        sorted.iter().rev().for_each(|&it| latencies.add(it));
        for share in [0.001, 0.25, 0.5, 0.99, 0.999] {
            let exact = sorted[(share * 1000.0_f64).round() as usize - 1].as_secs_f64();
            let found = latencies.percentile(share).unwrap().as_secs_f64();
            assert!(
                (exact..=exact * (RATIO + 1e-9)).contains(&found),
                "{share}: {found} {exact}"
            );
        }
        assert_eq!(latencies.percentile(1.0), Some(latencies.max()));
        assert_eq!((latencies.count(), latencies.max()), (1000, sorted[999]));
    }

    #[test]
    fn latencies_beyond_the_last_class_are_counted_and_their_maximum_is_exact() {
        let mut latencies = Latencies::default();
        for latency in [Duration::ZERO, Duration::from_secs(5000)] {
            latencies.add(latency);
        }
        assert_eq!(
            (latencies.count(), latencies.max()),
            (2, Duration::from_secs(5000))
        );
        assert!(latencies.percentile(1.0).unwrap() > Duration::from_secs(90));
    }
}
