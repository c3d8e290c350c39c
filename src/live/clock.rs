//! The clock of the stamps of scans, compared with the clock of the machine.

use std::time::{Duration, Instant};

/// How the stamp of a scan follows that of the scan before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tick {
    /// Later, as it should be.
    Later,
    /// Not later, by less than a jump: the scan was received twice or too late, and is of no use.
    Repeated,
    /// Earlier, or later than the time since the last arrival allows: the clock was set, or a simulation restarted.
    Jumped,
}

/// Watches the stamps of scans.
#[derive(Clone, Debug)]
pub struct StampClock {
    /// Seconds of the stamps per second of the machine.
    rate: f64,
    last: Option<(f64, Instant)>,
}

impl StampClock {
    /// Difference of the clocks that is a jump: beyond it no motion is extrapolated, so that the pose is lost anyway.
    const JUMP: Duration = super::monitor::LONGEST_COAST;

    /// A clock whose stamps advance at a rate: 1 of a sensor, that of a recording that is replayed faster or slower. A
    /// simulation may be slower than its rate.
    pub fn new(rate: f64) -> Self {
        Self { rate, last: None }
    }

    /// Compares the next stamp with those before it.
    pub fn tick(&mut self, stamp_s: f64, arrived: Instant) -> Tick {
        let Some((last_s, last_arrived)) = self.last else {
            self.last = Some((stamp_s, arrived));
            return Tick::Later;
        };
        let elapsed_s = arrived
            .saturating_duration_since(last_arrived)
            .as_secs_f64();
        let (step_s, jump_s) = (stamp_s - last_s, Self::JUMP.as_secs_f64());
        let tick = if step_s < -jump_s || step_s > self.rate.max(1.0) * elapsed_s + jump_s {
            Tick::Jumped
        } else if step_s > 0.0 {
            Tick::Later
        } else {
            return Tick::Repeated;
        };
        self.last = Some((stamp_s, arrived));
        tick
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_is_set_is_a_jump_and_a_pause_of_the_sensor_or_of_a_simulation_is_none() {
        let start = Instant::now();
        let ticks = |rate: f64, stamps: &[(f64, f64)]| -> Vec<Tick> {
            let mut clock = StampClock::new(rate);
            let at = |arrived_s: f64| start + Duration::from_secs_f64(arrived_s);
            let tick = |&(stamp_s, arrived_s)| clock.tick(stamp_s, at(arrived_s));
            stamps.iter().map(tick).collect()
        };
        let of_last = |rate: f64, stamps: &[(f64, f64)]| ticks(rate, stamps).pop();
        let regular = [(100.0, 0.0), (100.1, 0.1)];
        assert_eq!(ticks(1.0, &regular), [Tick::Later; 2]);
        let after = |stamp_s: f64, arrived_s: f64| {
            of_last(1.0, &[regular[0], regular[1], (stamp_s, arrived_s)])
        };
        assert_eq!(after(3700.2, 0.2), Some(Tick::Jumped));
        assert_eq!(after(7.0, 0.2), Some(Tick::Jumped));
        // The sensor paused for an hour, then the simulation.
        assert_eq!(after(3700.1, 3600.1), Some(Tick::Later));
        assert_eq!(after(100.2, 3600.1), Some(Tick::Later));
        // The same scan again, and one that was overtaken.
        assert_eq!(after(100.1, 0.2), Some(Tick::Repeated));
        assert_eq!(after(100.05, 0.2), Some(Tick::Repeated));
        // A recording with a pause, replayed a hundred times faster.
        let replayed = [(100.0, 0.0), (100.1, 0.001), (400.1, 3.001)];
        assert_eq!(ticks(100.0, &replayed), [Tick::Later; 3]);
    }

    #[test]
    fn after_a_jump_the_new_clock_counts_and_after_a_repeated_stamp_the_old_one() {
        let start = Instant::now();
        let mut clock = StampClock::new(1.0);
        clock.tick(100.0, start);
        assert_eq!(clock.tick(5.0, start), Tick::Jumped);
        assert_eq!(clock.tick(5.1, start), Tick::Later);
        assert_eq!(clock.tick(5.05, start), Tick::Repeated);
        assert_eq!(clock.tick(5.1, start), Tick::Repeated);
    }
}
