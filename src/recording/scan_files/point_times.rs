//! Times of the points of a sweep from numbers whose unit and origin are not stored with them.
//!
//! A sweep lasts 10 ms to 1 s: of seconds, milliseconds, microseconds and nanoseconds, at most one turns the
//! span of the numbers into such a duration. Numbers that are within a second of 0 are then relative to the
//! stamp of the scan, those within a second of the stamp are absolute, and others are of another clock.

use glam::Vec3;

use crate::lidar::Scan;

/// Shortest and longest sweep [s].
const SWEEP_S: std::ops::RangeInclusive<f64> = 0.01..=1.0;

/// Largest time between a point and the stamp of its scan [s].
const FARTHEST_S: f64 = 1.0;

/// Seconds of a unit.
const UNITS: [f64; 4] = [1.0, 1e-3, 1e-6, 1e-9];

/// Times of points about the middle of their sweep, half way between the first and the last.
#[derive(Debug, PartialEq)]
struct SweepTimes {
    /// The middle of the sweep [s], in the clock of the stamp; `None` without a stamp.
    middle_s: Option<f64>,
    /// Time of each point after the middle [s], 0 for one without a number.
    times_s: Vec<f32>,
}

/// Sets the times of a scan with a stamp [s] from a number per point, and its moment to the middle of the sweep.
/// Returns `false` if the numbers make no sense.
pub fn set_times(scan: &mut Scan, numbers: &[f64], stamp_s: Option<f64>) -> bool {
    scan.time_s = stamp_s;
    let is_measured = |point: &Vec3| point.is_finite() && *point != Vec3::ZERO;
    let is_measured: Vec<bool> = scan.points.iter().map(is_measured).collect();
    match sweep_times(numbers, &is_measured, stamp_s) {
        Some(sweep) => {
            scan.times_s = sweep.times_s;
            scan.time_s = sweep.middle_s;
            true
        }
        None => numbers.is_empty(),
    }
}

/// Interprets the numbers of the points of a scan with a stamp [s]; `None` if they make no sense. Without a stamp,
/// numbers of any clock do. `is_measured` is whether a point is a return: the numbers of others do not count.
fn sweep_times(numbers: &[f64], is_measured: &[bool], stamp_s: Option<f64>) -> Option<SweepTimes> {
    let (mut first, mut last) = (f64::INFINITY, f64::NEG_INFINITY);
    for (&number, _) in numbers.iter().zip(is_measured).filter(|(_, is)| **is) {
        first = first.min(number);
        last = last.max(number);
    }
    let unit = UNITS
        .into_iter()
        .find(|unit| SWEEP_S.contains(&(unit * (last - first))))?;
    let middle = 0.5 * (first + last);
    let is_near = |origin_s: f64| (unit * middle - origin_s).abs() <= FARTHEST_S;
    let middle_s = match stamp_s {
        Some(stamp_s) if is_near(0.0) => Some(stamp_s + unit * middle),
        Some(stamp_s) if is_near(stamp_s) => Some(unit * middle),
        Some(_) => return None,
        None => None,
    };
    let after_middle = |&number: &f64| {
        let number = if number.is_nan() { middle } else { number };
        (unit * (number.clamp(first, last) - middle)) as f32
    };
    Some(SweepTimes {
        middle_s,
        times_s: numbers.iter().map(after_middle).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const STAMP_S: f64 = 1_700_000_000.25;

    /// A sweep of 0.1 s after a moment in a unit.
    fn interpret(first: f64, unit: f64) -> Option<SweepTimes> {
        let numbers: Vec<f64> = (0..=100)
            .map(|i| first + 1e-3 * f64::from(i) / unit)
            .collect();
        sweep_times(&numbers, &[true; 101], Some(STAMP_S))
    }

    #[test]
    fn relative_and_absolute_times_in_every_unit_are_the_same_sweep() {
        for unit in UNITS {
            for (first_s, middle_s) in [
                (0.0, STAMP_S + 0.05),
                (-0.1, STAMP_S - 0.05),
                (STAMP_S, STAMP_S + 0.05),
                (STAMP_S - 0.1, STAMP_S - 0.05),
            ] {
                let sweep = interpret(first_s / unit, unit).unwrap();
                assert!(
                    (sweep.middle_s.unwrap() - middle_s).abs() < 1e-6,
                    "{unit} {first_s}"
                );
                assert!((sweep.times_s[0] + 0.05).abs() < 1e-6);
                assert!((sweep.times_s[75] - 0.025).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn numbers_that_are_no_times_are_dropped() {
        // Of another clock, equal, of an accumulation, without points, and not finite.
        assert_eq!(interpret(1000.0, 1.0), None);
        assert_eq!(interpret(1000e9, 1e-9), None);
        assert_eq!(sweep_times(&[0.0; 5], &[true; 5], Some(STAMP_S)), None);
        assert_eq!(sweep_times(&[0.0, 3.0], &[true; 2], Some(STAMP_S)), None);
        assert_eq!(sweep_times(&[], &[], Some(STAMP_S)), None);
        assert_eq!(
            sweep_times(&[f64::NAN, 0.0], &[true; 2], Some(STAMP_S)),
            None
        );
        assert_eq!(
            sweep_times(&[0.0, f64::INFINITY], &[true; 2], Some(STAMP_S)),
            None
        );
    }

    #[test]
    fn without_a_stamp_times_of_every_clock_are_about_the_middle_of_the_sweep() {
        for unit in UNITS {
            for first_s in [0.0, -0.1, 5000.0] {
                let numbers: Vec<f64> = (0..=100)
                    .map(|i| (first_s + 1e-3 * f64::from(i)) / unit)
                    .collect();
                let sweep = sweep_times(&numbers, &[true; 101], None).unwrap();
                assert_eq!(sweep.middle_s, None);
                assert!((sweep.times_s[75] - 0.025).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn points_without_a_return_do_not_count() {
        let numbers = [STAMP_S, 0.0, STAMP_S + 0.1];
        let sweep = sweep_times(&numbers, &[true, false, true], Some(STAMP_S)).unwrap();
        assert!((sweep.middle_s.unwrap() - STAMP_S - 0.05).abs() < 1e-6);
        assert!(sweep.times_s[1].abs() <= 0.0500001);
        let sweep = sweep_times(&[0.0, f64::NAN, 0.1], &[true; 3], Some(STAMP_S)).unwrap();
        assert_eq!(sweep.times_s, [-0.05, 0.0, 0.05]);
    }
}
