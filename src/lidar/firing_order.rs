//! Times of points from the order in which a spinning sensor measured them.
//!
//! Along that order the azimuth α of the points, unwrapped over turns and positive in the sense of rotation, is the angle by
//! which the sensor has turned, up to the angles between lasers that fire together, or between the first and the last
//! firing of a packet whose points are sorted. The angle is taken as the monotone function m of the order with the
//! least squares of differences, and the time from it with the period P,
//!
//! ```text
//! t = (m − (m₀ + m₁) / 2) P / 2π       m = argmin Σ (mᵢ − αᵢ)²,  m₀ ≤ … ≤ mᵢ ≤ mᵢ₊₁ ≤ … ≤ m₁
//! ```
//!
//! so that each scan has its own start and may have more than a turn. In a scan that contains one ring after the
//! other, each ring is in that order.
//!
//! Ayer et al., *An empirical distribution function for sampling with incomplete information* (1955), for m.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::ops::RangeInclusive;

use super::deskewing::{Rotation, RotationDirection};
use super::scan::Scan;
use crate::geometry::{fast_atan2, wrap_angle};

/// Source of the times of points that have none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PointTiming {
    /// Azimuths of the points: all scans start at one.
    Rotation(Rotation),
    /// Order of the points: each scan has its own start.
    Order {
        /// Duration of a turn [s].
        period_s: f64,
    },
}

impl PointTiming {
    /// Time of each point, zero in the middle of the sweep [s]; empty if the points are in no order that has times.
    pub(crate) fn point_times(&self, scan: &Scan) -> Vec<f32> {
        match self {
            Self::Rotation(rotation) => rotation.point_times(&scan.points),
            Self::Order { period_s } => FiringOrder::of(scan).map_or_else(Vec::new, |order| {
                let time = |turned: &f64| ((turned - 0.5 * order.span_rad) / TAU * period_s) as f32;
                order.turned_rad.iter().map(time).collect()
            }),
        }
    }
}

/// Angles by which a spinning sensor had turned when it measured the points of a scan.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FiringOrder {
    /// Sense of rotation along the order.
    pub direction: RotationDirection,
    /// Azimuth at which the scan starts [rad].
    pub start_rad: f64,
    /// Angle from the first to the last return [rad].
    pub span_rad: f64,
    /// Angle from the start to each point [rad].
    turned_rad: Vec<f64>,
}

/// Angles that a scan of a spinning sensor spans: with a sector in which nothing returned, and with more than a turn.
/// One ring after the other is a turn for each [rad].
const SPANS_RAD: RangeInclusive<f64> = 0.8 * TAU..=2.0 * TAU;

impl FiringOrder {
    /// `None` of points in another order.
    pub fn of(scan: &Scan) -> Option<Self> {
        let azimuths = azimuths(scan);
        let order = fired(&azimuths).or_else(|| by_ring(&scan.rings, &azimuths))?;
        let first_rad = order
            .angles_rad
            .iter()
            .copied()
            .fold(f64::INFINITY, f64::min);
        let last_rad = (order.angles_rad.iter().copied()).fold(f64::NEG_INFINITY, f64::max);
        // A point without a direction has the time of the one before.
        let mut turned_rad = vec![f64::NAN; scan.len()];
        for (&(point, _), angle_rad) in azimuths.iter().zip(&order.angles_rad) {
            turned_rad[point] = angle_rad - first_rad;
        }
        let mut before_rad = 0.0;
        for turned_rad in &mut turned_rad {
            if turned_rad.is_nan() {
                *turned_rad = before_rad;
            }
            before_rad = *turned_rad;
        }
        Some(Self {
            direction: if order.sense > 0.0 {
                RotationDirection::CounterClockwise
            } else {
                RotationDirection::Clockwise
            },
            start_rad: wrap_angle(order.sense * first_rad),
            span_rad: last_rad - first_rad,
            turned_rad,
        })
    }

    /// Whether scans of one sensor pass all azimuths: otherwise their points may have been sorted by azimuth, from one
    /// that none of them passes.
    pub fn pass_all_azimuths(orders: &[Self]) -> bool {
        const STEPS: usize = 360;
        /// Starts of scans that start together are as near to each other [rad].
        const MARGIN_RAD: f64 = 2.0 * TAU / STEPS as f64;
        (0..STEPS).all(|step| {
            let azimuth_rad = TAU * step as f64 / STEPS as f64;
            orders.iter().any(|order| {
                let turned_rad =
                    (order.direction.sense() * (azimuth_rad - order.start_rad)).rem_euclid(TAU);
                let inside_rad = MARGIN_RAD..order.span_rad - MARGIN_RAD;
                inside_rad.contains(&turned_rad) || inside_rad.contains(&(turned_rad + TAU))
            })
        })
    }

    /// Angle from the start of this scan to that of another one, some scans later [rad].
    pub fn angle_to(&self, later: &Self, scans: f64) -> f64 {
        let apart_rad = self.direction.sense() * wrap_angle(later.start_rad - self.start_rad);
        apart_rad + TAU * ((scans * self.span_rad - apart_rad) / TAU).round()
    }
}

/// Points with a direction, by number, with their azimuths [rad].
fn azimuths(scan: &Scan) -> Vec<(usize, f64)> {
    /// Nearer points have no direction [m].
    const NEAREST_M: f32 = 0.1;
    let points = scan.points.iter().enumerate();
    points
        .filter(|(_, point)| point.is_finite() && point.length() > NEAREST_M)
        .map(|(number, point)| (number, f64::from(fast_atan2(point.y, point.x))))
        .collect()
}

/// Angles by which a sensor has turned, of the points with a direction.
struct Turned {
    /// Sense of rotation, 1 counter-clockwise.
    sense: f64,
    /// Azimuths, unwrapped in the sense of rotation [rad].
    angles_rad: Vec<f64>,
}

/// Angles of points of all beams in the order in which they were measured.
fn fired(azimuths: &[(usize, f64)]) -> Option<Turned> {
    /// Largest step back: beams of one moment have different azimuths [rad].
    const ASIDE_RAD: f64 = 0.35;
    let mut turned = Turned::along(azimuths.iter().map(|&(_, azimuth_rad)| azimuth_rad))?;
    turned.is_steady(ASIDE_RAD).then_some(())?;
    turned.angles_rad = monotone(&turned.angles_rad);
    Some(turned).filter(|turned| SPANS_RAD.contains(&turned.span_rad()))
}

/// Angles of points of which those of each ring are in the order in which they were measured.
fn by_ring(rings: &[u16], azimuths: &[(usize, f64)]) -> Option<Turned> {
    /// Rounding of azimuths [rad].
    const JITTER_RAD: f64 = 0.02;
    /// Rings whose first return is as far before that of the longest one start before it [rad].
    const EARLIER_RAD: f64 = 0.35;
    let mut of_ring: BTreeMap<u16, Vec<usize>> = BTreeMap::new();
    for (row, &(point, _)) in azimuths.iter().enumerate() {
        of_ring.entry(*rings.get(point)?).or_default().push(row);
    }
    let turned = |rows: &Vec<usize>| Turned::along(rows.iter().map(|&row| azimuths[row].1));
    let runs: Vec<(Turned, &Vec<usize>)> = (of_ring.values())
        .filter_map(|rows| Some((turned(rows)?, rows)))
        .collect();
    let longest = runs
        .iter()
        .max_by(|a, b| a.0.span_rad().total_cmp(&b.0.span_rad()))?;
    let (sense, start_rad) = (longest.0.sense, longest.0.angles_rad[0]);
    let mut angles_rad = vec![start_rad; azimuths.len()];
    for (run, rows) in &runs {
        // Few returns do not show a sense of their own.
        let is_backward = run.sense != sense && run.span_rad() > JITTER_RAD;
        if is_backward || !run.is_steady(JITTER_RAD) {
            return None;
        }
        let first_rad = run.sense * sense * run.angles_rad[0];
        let later_rad = (first_rad - start_rad + EARLIER_RAD).rem_euclid(TAU) - EARLIER_RAD;
        for (row, angle_rad) in rows.iter().zip(&run.angles_rad) {
            angles_rad[*row] = start_rad + later_rad + run.sense * sense * angle_rad - first_rad;
        }
    }
    SPANS_RAD
        .contains(&longest.0.span_rad())
        .then_some(Turned { sense, angles_rad })
}

impl Turned {
    /// The angles along some azimuths [rad]; `None` without azimuths.
    fn along(azimuths_rad: impl Iterator<Item = f64>) -> Option<Self> {
        let mut angles_rad: Vec<f64> = azimuths_rad.collect();
        for point in 1..angles_rad.len() {
            let before_rad = angles_rad[point - 1];
            angles_rad[point] = before_rad + wrap_angle(angles_rad[point] - before_rad);
        }
        let sense = (angles_rad.last()? - angles_rad[0]).signum();
        angles_rad
            .iter_mut()
            .for_each(|angle_rad| *angle_rad *= sense);
        Some(Self { sense, angles_rad })
    }

    fn span_rad(&self) -> f64 {
        self.angles_rad[self.angles_rad.len() - 1] - self.angles_rad[0]
    }

    /// Whether no angle is farther behind the largest one before it [rad].
    fn is_steady(&self, behind_rad: f64) -> bool {
        let mut farthest_rad = f64::NEG_INFINITY;
        self.angles_rad.iter().all(|&angle_rad| {
            farthest_rad = farthest_rad.max(angle_rad);
            angle_rad >= farthest_rad - behind_rad
        })
    }
}

/// The ascending values with the least squares of differences from some values: neighbours that do not ascend have their
/// mean.
fn monotone(values: &[f64]) -> Vec<f64> {
    let mut pools: Vec<(f64, usize)> = vec![];
    for &value in values {
        let mut pool = (value, 1);
        while let Some(&(mean, count)) = pools.last()
            && mean >= pool.0
        {
            pools.pop();
            let total = count + pool.1;
            pool.0 += (mean - pool.0) * count as f64 / total as f64;
            pool.1 = total;
        }
        pools.push(pool);
    }
    let values = pools.into_iter();
    values
        .flat_map(|(mean, count)| std::iter::repeat_n(mean, count))
        .collect()
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Azimuths of the lasers of a firing [rad].
    const ASIDE_RAD: [f64; 4] = [0.0, 0.06, -0.06, 0.03];
    const STEPS_PER_TURN: f64 = 1200.0;

    /// A scan in the order of firing with its true times, of a period of a second.
    fn scan(sense: f64, start_rad: f64, span_rad: f64) -> Scan {
        let mut scan = Scan::default();
        let steps = (span_rad / TAU * STEPS_PER_TURN) as usize;
        for step in 0..steps {
            for (ring, aside_rad) in ASIDE_RAD.into_iter().enumerate() {
                let turns = step as f64 / STEPS_PER_TURN;
                let (sin, cos) = (start_rad + sense * TAU * turns + aside_rad).sin_cos();
                scan.points
                    .push(9.0 * Vec3::new(cos as f32, sin as f32, 0.1));
                scan.times_s.push((turns - 0.5 * span_rad / TAU) as f32);
                scan.rings.push(ring as u16);
            }
        }
        scan
    }

    /// The same points in another order.
    fn sorted(scan: &Scan, key: impl Fn(usize) -> usize) -> Scan {
        let mut order: Vec<usize> = (0..scan.len()).collect();
        order.sort_by_key(|&point| key(point));
        Scan {
            points: order.iter().map(|&point| scan.points[point]).collect(),
            times_s: order.iter().map(|&point| scan.times_s[point]).collect(),
            rings: order.iter().map(|&point| scan.rings[point]).collect(),
            ..Scan::default()
        }
    }

    fn with_a_third_lost(mut scan: Scan, rng: &mut ChaCha8Rng) -> Scan {
        for point in &mut scan.points {
            if rng.random_bool(0.33) {
                *point = Vec3::NAN;
            }
        }
        scan
    }

    /// Largest error of the times [turns].
    fn largest_error(scan: &Scan) -> f64 {
        let times_s = PointTiming::Order { period_s: 1.0 }.point_times(scan);
        assert_eq!(times_s.len(), scan.len());
        let measured = (0..scan.len()).filter(|&point| scan.points[point].is_finite());
        let errors = measured.map(|point| f64::from(times_s[point] - scan.times_s[point]).abs());
        errors.fold(0.0, f64::max)
    }

    #[test]
    fn times_are_those_of_each_scan_wherever_it_starts_and_however_far_it_turns() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        // Angles between lasers, of which a third is lost, and the rest of the last firing.
        let aside_turns = 0.06 / TAU + 3.0 / STEPS_PER_TURN;
        for sense in [1.0, -1.0] {
            for span_deg in [300.0_f64, 360.0, 363.0, 400.0] {
                let start_rad = rng.random_range(-3.0..3.0);
                let fired = scan(sense, start_rad, span_deg.to_radians());
                let by_ring = sorted(&fired, |point| point % 4);
                let packets = sorted(&fired, |point| 4 * (point / 48) + point % 4);
                for (scan, limit_turns) in [
                    (fired, aside_turns),
                    (by_ring, aside_turns),
                    (packets, aside_turns + 12.0 / STEPS_PER_TURN),
                ] {
                    let scan = with_a_third_lost(scan, &mut rng);
                    let order = FiringOrder::of(&scan).unwrap();
                    let direction = if sense > 0.0 {
                        RotationDirection::CounterClockwise
                    } else {
                        RotationDirection::Clockwise
                    };
                    assert_eq!(order.direction, direction);
                    let off_rad = wrap_angle(order.start_rad - start_rad).abs();
                    assert!(off_rad < TAU * limit_turns, "{span_deg}: {off_rad} rad");
                    let error = largest_error(&scan);
                    assert!(error < limit_turns, "{span_deg}: {error} turns");
                }
            }
        }
    }

    #[test]
    fn angles_between_lasers_do_not_move_the_times() {
        let fired = scan(1.0, 0.4, TAU);
        let error = largest_error(&fired);
        // The first and the last lasers have nothing to be averaged with: 0.06 rad are 0.01 turns.
        assert!(error < 0.01, "{error} turns");
        let times_s = PointTiming::Order { period_s: 1.0 }.point_times(&fired);
        let inner = 400..fired.len() - 400;
        let errors = inner.map(|point| f64::from(times_s[point] - fired.times_s[point]).abs());
        let error = errors.fold(0.0, f64::max);
        assert!(error < 0.002, "{error} turns");
    }

    #[test]
    fn points_in_no_order_and_beams_one_after_the_other_without_rings_have_no_times() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let fired = scan(1.0, 0.3, TAU);
        let mut rows = sorted(&fired, |point| point % 4);
        rows.rings.clear();
        assert_eq!(FiringOrder::of(&rows), None);
        let keys: Vec<usize> = (0..fired.len())
            .map(|_| rng.random_range(0..1000))
            .collect();
        let shuffled = sorted(&fired, |point| keys[point]);
        assert_eq!(FiringOrder::of(&shuffled), None);
        assert_eq!(FiringOrder::of(&Scan::default()), None);
        assert!(
            PointTiming::Order { period_s: 1.0 }
                .point_times(&shuffled)
                .is_empty()
        );
    }

    #[test]
    fn an_order_is_the_sensors_own_if_no_azimuth_is_left_out_by_all_scans() {
        let orders = |starts_rad: &[f64], span_rad: f64| -> Vec<FiringOrder> {
            let scans = starts_rad.iter().map(|&start| scan(-1.0, start, span_rad));
            scans.map(|scan| FiringOrder::of(&scan).unwrap()).collect()
        };
        assert!(!FiringOrder::pass_all_azimuths(&orders(
            &[0.3, 0.3, 0.3],
            TAU
        )));
        assert!(!FiringOrder::pass_all_azimuths(&orders(&[0.3, 0.31], TAU)));
        assert!(FiringOrder::pass_all_azimuths(&orders(&[0.3, 0.5], TAU)));
        assert!(FiringOrder::pass_all_azimuths(&orders(
            &[2.0],
            400.0_f64.to_radians()
        )));
        // A sector that no scan sees is left out by all of them.
        assert!(!FiringOrder::pass_all_azimuths(&orders(&[0.3, 0.5], 5.5)));
        assert!(!FiringOrder::pass_all_azimuths(&[]));
    }

    #[test]
    fn the_angle_between_scans_is_that_of_their_starts_and_whole_turns() {
        for sweep_deg in [350.0_f64, 360.0, 363.1, 400.7] {
            for scans in [1.0, 2.0] {
                let later_rad = wrap_angle(2.0 - scans * sweep_deg.to_radians());
                // The last returns are missing.
                let [first, later] = [2.0, later_rad].map(|start_rad| {
                    FiringOrder::of(&scan(-1.0, start_rad, sweep_deg.to_radians() - 0.2)).unwrap()
                });
                let found_deg = first.angle_to(&later, scans).to_degrees();
                assert!((found_deg - scans * sweep_deg).abs() < 0.1, "{found_deg}");
            }
        }
    }
}
