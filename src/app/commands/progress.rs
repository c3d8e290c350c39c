//! How far the work has come: bars on a terminal, a line now and then elsewhere.

use std::io::{IsTerminal as _, Write as _};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use crate::app::cli::Verbosity;

/// Time between two lines where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// Shows tasks to the user. The default is silent.
#[derive(Clone, Debug, Default)]
pub struct Progress {
    display: Display,
}

#[derive(Clone, Debug, Default)]
enum Display {
    #[default]
    Silent,
    Lines,
    Bars(MultiProgress),
}

/// A piece of work of known size; shared by the threads that work on it.
#[derive(Debug)]
pub struct Task {
    name: String,
    total: u64,
    done: AtomicU64,
    started: Instant,
    /// When the last line was written, since the start [ms].
    last_line_ms: AtomicU64,
    display: Display,
    bar: Option<ProgressBar>,
}

impl Progress {
    /// Bars if standard error is a terminal, lines if not, nothing if quiet.
    pub fn new(verbosity: Verbosity) -> Self {
        let display = match verbosity {
            Verbosity::Quiet => Display::Silent,
            _ if std::io::stderr().is_terminal() => Display::Bars(MultiProgress::new()),
            _ => Display::Lines,
        };
        Self { display }
    }

    /// Begins a task of `total` steps, to be counted by [`Task::advance`] and to be told as
    /// done when it is dropped.
    pub fn task(&self, name: &str, total: usize) -> Arc<Task> {
        let total = total as u64;
        let bar = match &self.display {
            Display::Bars(bars) => Some(bars.add(ProgressBar::new(total))),
            _ => None,
        };
        if let Some(bar) = &bar {
            bar.set_style(style());
            bar.set_prefix(name.to_owned());
            bar.enable_steady_tick(Duration::from_millis(200));
        }
        Arc::new(Task {
            name: name.to_owned(),
            total,
            done: AtomicU64::new(0),
            started: Instant::now(),
            last_line_ms: AtomicU64::new(0),
            display: self.display.clone(),
            bar,
        })
    }

    /// Whether bars are drawn on a terminal.
    pub fn is_terminal(&self) -> bool {
        matches!(self.display, Display::Bars(_))
    }

    /// Does something with the bars out of the way.
    pub fn suspend<R>(&self, action: impl FnOnce() -> R) -> R {
        match &self.display {
            Display::Bars(bars) => bars.suspend(action),
            _ => action(),
        }
    }
}

impl Task {
    /// Counts finished steps.
    pub fn advance(&self, steps: usize) {
        let steps = steps as u64;
        let done = self.done.fetch_add(steps, Ordering::Relaxed) + steps;
        if let Some(bar) = &self.bar {
            bar.inc(steps);
        } else if matches!(self.display, Display::Lines) && self.line_is_due() {
            self.write_line(done);
        }
    }

    /// Says something short beside the bar, such as the current error.
    pub fn note(&self, text: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(text.to_owned());
        }
    }

    /// Steps that are finished.
    pub fn done(&self) -> usize {
        self.done.load(Ordering::Relaxed) as usize
    }

    /// Whether enough time has passed since the last line; one of many threads is told so.
    fn line_is_due(&self) -> bool {
        let now_ms = self.started.elapsed().as_millis() as u64;
        let last_ms = self.last_line_ms.load(Ordering::Relaxed);
        now_ms >= last_ms + LINE_INTERVAL.as_millis() as u64
            && self
                .last_line_ms
                .compare_exchange(last_ms, now_ms, Ordering::Relaxed, Ordering::Relaxed)
                .is_ok()
    }

    fn write_line(&self, done: u64) {
        let line = line(&self.name, done, self.total, self.started.elapsed());
        // Progress that cannot be shown is no reason to stop.
        let _ = writeln!(std::io::stderr(), "{line}");
    }
}

impl Drop for Task {
    fn drop(&mut self) {
        let done = self.done.load(Ordering::Relaxed);
        match (&self.bar, &self.display) {
            (Some(bar), _) if done >= self.total => bar.finish(),
            (Some(bar), _) => bar.abandon(),
            (None, Display::Lines) => self.write_line(done),
            (None, _) => {}
        }
    }
}

fn style() -> ProgressStyle {
    let template = "{prefix:14} {wide_bar} {pos}/{len} {per_sec} {eta} left {msg}";
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// `localize: 40 of 160 (25 %), 8.0 per second, 15 s left`.
fn line(name: &str, done: u64, total: u64, elapsed: Duration) -> String {
    let percent = 100 * done / total.max(1);
    let per_second = done as f64 / elapsed.as_secs_f64().max(1e-3);
    let rest = if done >= total {
        format!("{:.1} s", elapsed.as_secs_f64())
    } else if done == 0 {
        "time left unknown".to_owned()
    } else {
        format!("{:.0} s left", (total - done) as f64 / per_second)
    };
    format!("{name}: {done} of {total} ({percent} %), {per_second:.1} per second, {rest}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_tells_share_rate_and_time_left() {
        assert_eq!(
            line("localize", 40, 160, Duration::from_secs(5)),
            "localize: 40 of 160 (25 %), 8.0 per second, 15 s left"
        );
        assert_eq!(
            line("localize", 160, 160, Duration::from_secs(20)),
            "localize: 160 of 160 (100 %), 8.0 per second, 20.0 s"
        );
        assert_eq!(
            line("localize", 0, 160, Duration::ZERO),
            "localize: 0 of 160 (0 %), 0.0 per second, time left unknown"
        );
    }

    #[test]
    fn every_step_of_every_thread_is_counted() {
        let task = Progress::default().task("count", 400);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..100).for_each(|_| task.advance(1)));
            }
        });
        assert_eq!(task.done(), 400);
    }

    #[test]
    fn bars_have_their_own_style() {
        ProgressStyle::with_template(
            "{prefix:14} {wide_bar} {pos}/{len} {per_sec} {eta} left {msg}",
        )
        .unwrap();
    }
}
