//! Progress of long tasks: bars on a terminal, a line every few seconds elsewhere.

use std::fmt::Write;
use std::io::{IsTerminal as _, Write as _};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};
use tracing::level_filters::LevelFilter;

use super::visible::visible_in_line;

/// Time between two lines without a terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// Layout of a bar.
const TEMPLATE: &str = "{prefix:14} {wide_bar} {items} {left} {msg}";

/// Parts into which a step is divided, for work that goes on after all scans are read.
const PARTS: u64 = 1000;

/// Display of the progress of tasks; by default there is none.
#[derive(Clone, Debug, Default)]
pub enum Progress {
    /// No display.
    #[default]
    Silent,
    /// Lines on standard error.
    Lines,
    /// Bars on a terminal.
    Bars(MultiProgress),
}

/// Task with a known number of steps; shared by the threads that work on it.
#[derive(Debug)]
pub struct Task {
    name: String,
    /// Counts the steps; hidden without a terminal.
    bar: ProgressBar,
    /// Time of the last line since the start [ms]; `None` if no lines are written.
    last_line_ms: Option<AtomicU64>,
}

impl Progress {
    /// Bars if standard error is a terminal, otherwise lines; silent if quiet.
    pub fn new(level: LevelFilter) -> Self {
        match level {
            LevelFilter::ERROR | LevelFilter::WARN => Self::Silent,
            _ if std::io::stderr().is_terminal() => Self::Bars(MultiProgress::new()),
            _ => Self::Lines,
        }
    }

    /// Starts a task of `total` steps, which are counted by [`Task::advance`]; it ends when it is
    /// dropped.
    pub fn task(&self, name: &str, total: usize) -> Arc<Task> {
        let (name, total) = (visible_in_line(name), Some(PARTS * total as u64));
        let mut bar = ProgressBar::with_draw_target(total, ProgressDrawTarget::hidden());
        if let Self::Bars(bars) = self {
            bar = bars.add(bar);
            bar.set_style(style());
            bar.set_prefix(name.to_string());
            bar.enable_steady_tick(Duration::from_millis(200));
        }
        Arc::new(Task {
            name: name.into_owned(),
            bar,
            last_line_ms: matches!(self, Self::Lines).then(AtomicU64::default),
        })
    }

    /// Whether bars are drawn on a terminal.
    pub fn is_terminal(&self) -> bool {
        matches!(self, Self::Bars(_))
    }

    /// Runs an action while the bars are hidden.
    pub fn suspend<R>(&self, action: impl FnOnce() -> R) -> R {
        match self {
            Self::Bars(bars) => bars.suspend(action),
            _ => action(),
        }
    }
}

impl Task {
    /// Counts completed steps.
    pub fn advance(&self, steps: usize) {
        self.bar.inc(PARTS * steps as u64);
        self.write_line_if_due();
    }

    /// Sets the completed share of all steps, 0 to 1.
    pub fn set_share(&self, share: f64) {
        self.bar.set_position(self.parts(share));
        self.write_line_if_due();
    }

    /// Counts a share of all steps.
    pub fn advance_share(&self, share: f64) {
        self.bar.inc(self.parts(share));
        self.write_line_if_due();
    }

    fn parts(&self, share: f64) -> u64 {
        (share * self.bar.length().unwrap_or(0) as f64).round() as u64
    }

    /// Shows a short text next to the bar, such as the current error.
    pub fn note(&self, text: &str) {
        self.bar.set_message(visible_in_line(text).into_owned());
    }

    /// Writes a line if enough time has passed since the last one.
    fn write_line_if_due(&self) {
        if self.is_line_due(self.bar.elapsed()) {
            self.write_line();
        }
    }

    /// Whether a line is due some time after the start, to only one of many threads; that of the end follows it.
    fn is_line_due(&self, elapsed: Duration) -> bool {
        let Some(last_line_ms) = self.last_line_ms.as_ref().filter(|_| !self.is_complete()) else {
            return false;
        };
        let (relaxed, now_ms) = (Ordering::Relaxed, elapsed.as_millis() as u64);
        let last_ms = last_line_ms.load(relaxed);
        let is_due = now_ms >= last_ms + LINE_INTERVAL.as_millis() as u64;
        let changed = || last_line_ms.compare_exchange(last_ms, now_ms, relaxed, relaxed);
        is_due && changed().is_ok()
    }

    fn is_complete(&self) -> bool {
        Some(self.bar.position()) >= self.bar.length()
    }

    fn write_line(&self) {
        let [done, total] =
            [self.bar.position(), self.bar.length().unwrap_or(0)].map(|it| it / PARTS);
        let line = line(&self.name, done, total, self.bar.elapsed());
        // A failure to show progress must not stop the task.
        let _ = writeln!(std::io::stderr(), "{line}");
    }
}

impl Drop for Task {
    fn drop(&mut self) {
        if self.last_line_ms.is_some() {
            self.write_line();
        }
        if self.is_complete() {
            self.bar.finish();
        } else {
            self.bar.abandon();
        }
    }
}

fn style() -> ProgressStyle {
    let style = ProgressStyle::with_template(TEMPLATE);
    style
        .unwrap_or_else(|_| ProgressStyle::default_bar())
        .with_key("items", |state: &ProgressState, text: &mut dyn Write| {
            let (done, total) = (state.pos() / PARTS, state.len().unwrap_or(0) / PARTS);
            // There is nowhere to report that the terminal is closed.
            let _ = write!(text, "{done}/{total}, {}", rate(done, state.elapsed()));
        })
        .with_key("left", |state: &ProgressState, text: &mut dyn Write| {
            let is_running = state.len().is_some_and(|length| state.pos() < length);
            if is_running && state.pos() > 0 {
                let _ = write!(text, "{:.0} s left", state.eta().as_secs_f64().ceil());
            }
        })
}

/// Steps per second, or seconds per step where these are less than one.
fn rate(done: u64, elapsed: Duration) -> String {
    let per_second = done as f64 / elapsed.as_secs_f64().max(1e-3);
    match per_second {
        rate if rate >= 100.0 => format!("{rate:.0}/s"),
        rate if rate >= 1.0 || done == 0 => format!("{rate:.1}/s"),
        rate => format!("{:.1} s each", 1.0 / rate),
    }
}

/// Formats a line such as `localize: 40 of 160 (25 %), 8.0/s, 15 s left`.
fn line(name: &str, done: u64, total: u64, elapsed: Duration) -> String {
    let percent = 100 * done / total.max(1);
    let seconds = elapsed.as_secs_f64();
    let rest = match done {
        _ if done >= total => format!("{seconds:.1} s"),
        0 => "time left unknown".to_owned(),
        _ => format!(
            "{:.0} s left",
            (total - done) as f64 * seconds / done as f64
        ),
    };
    let rate = rate(done, elapsed);
    format!("{name}: {done} of {total} ({percent} %), {rate}, {rest}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_share_rate_and_time_left() {
        assert_eq!(
            line("localize", 40, 160, Duration::from_secs(5)),
            "localize: 40 of 160 (25 %), 8.0/s, 15 s left"
        );
        assert_eq!(
            line("localize", 160, 160, Duration::from_secs(20)),
            "localize: 160 of 160 (100 %), 8.0/s, 20.0 s"
        );
        assert_eq!(
            line("localize", 0, 160, Duration::ZERO),
            "localize: 0 of 160 (0 %), 0.0/s, time left unknown"
        );
    }

    #[test]
    fn a_line_is_due_every_few_seconds_until_the_end_which_has_its_own() {
        let task = Progress::Lines.task("count", 2);
        let due = |elapsed_s: u64| task.is_line_due(Duration::from_secs(elapsed_s));
        assert_eq!([4, 5, 9, 10].map(due), [false, true, false, true]);
        task.advance(2);
        assert!(!due(20));
    }

    #[test]
    fn every_step_of_every_thread_is_counted() {
        let task = Progress::default().task("count", 400);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..100).for_each(|_| task.advance(1)));
            }
        });
        assert_eq!(task.bar.position(), 400 * PARTS);
        task.set_share(0.5);
        assert_eq!(task.bar.position(), 200 * PARTS);
    }

    #[test]
    fn a_rate_has_sensible_digits() {
        let rates =
            [(500, 2), (9, 2), (1, 4), (0, 4)].map(|(done, s)| rate(done, Duration::from_secs(s)));
        assert_eq!(rates, ["250/s", "4.5/s", "4.0 s each", "0.0/s"]);
    }

    #[test]
    fn the_layout_of_bars_is_valid() {
        ProgressStyle::with_template(TEMPLATE).unwrap();
    }
}
