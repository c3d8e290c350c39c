//! Logging to standard error, above the progress bars, and into the log file of a run.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::Context as _;
use tracing::level_filters::LevelFilter;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{Layer as _, fmt};

use crate::app::run::progress::Progress;
use crate::app::run::visible::visible_in_line;
use crate::files::Place;

/// Starts logging; a second call in the same process has no effect.
pub(crate) fn start(level: LevelFilter, progress: &Progress, log: &RunLog) {
    let detailed = level > LevelFilter::INFO;
    let progress = progress.clone();
    let colored = progress.is_terminal();
    let shown = fmt::layer()
        .fmt_fields(fmt::format::debug_fn(write_field))
        .with_target(detailed)
        .without_time()
        .with_ansi(colored)
        .with_writer(move || AboveBars(progress.clone()))
        .with_filter(filter(level));
    let log = log.clone();
    let written = fmt::layer()
        .fmt_fields(fmt::format::debug_fn(write_field))
        .with_target(detailed)
        .without_time()
        .with_ansi(false)
        .with_writer(move || log.clone())
        // The log file is complete even if the terminal is quiet.
        .with_filter(filter(level.max(LevelFilter::INFO)));
    // It fails only if logging was started before.
    let _ = tracing_subscriber::registry()
        .with(shown)
        .with(written)
        .try_init();
}

/// Writes the message of an event, or another of its fields, as a part of one line.
fn write_field(
    writer: &mut fmt::format::Writer<'_>,
    field: &tracing::field::Field,
    value: &dyn std::fmt::Debug,
) -> std::fmt::Result {
    let name = match field.name() {
        "message" => String::new(),
        name => format!(" {name}="),
    };
    write!(writer, "{name}{}", visible_in_line(&format!("{value:?}")))
}

/// Only errors of libraries: graphics libraries log much that is irrelevant here.
fn filter(level: LevelFilter) -> Targets {
    Targets::new()
        .with_default(LevelFilter::ERROR)
        .with_target("fpmcl", level)
}

/// Standard error; progress bars are hidden while it is written to.
struct AboveBars(Progress);

impl Write for AboveBars {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        self.0.suspend(|| io::stderr().write(text))
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

/// Log file of the current run, if it has one.
#[derive(Clone, Debug, Default)]
pub struct RunLog {
    file: Arc<Mutex<Option<File>>>,
}

/// Guard of a log file; when it is dropped, the previous file is restored.
#[derive(Debug)]
pub struct LogGuard {
    log: RunLog,
    previous: Option<File>,
}

impl RunLog {
    /// Writes all messages into a new file until the guard is dropped.
    pub fn write_to(&self, path: &Path) -> anyhow::Result<LogGuard> {
        let file = Place::of(path).and_then(|place| File::create(&place.path));
        let file = file.with_context(|| format!("cannot create {}", path.display()))?;
        let previous = self.replace(Some(file));
        let log = self.clone();
        Ok(LogGuard { log, previous })
    }

    /// Appends another log file, if it exists.
    pub fn append(&mut self, path: &Path) -> anyhow::Result<()> {
        if path.exists() {
            let text =
                std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
            self.write_all(&text)
                .context("cannot write the log of the run")?;
        }
        Ok(())
    }

    fn replace(&self, file: Option<File>) -> Option<File> {
        let mut own = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *own, file)
    }
}

impl Drop for LogGuard {
    fn drop(&mut self) {
        self.log.replace(self.previous.take());
    }
}

impl Write for RunLog {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        match file.as_mut() {
            Some(file) => file.write(text),
            None => Ok(text.len()),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_log_of_a_run_has_the_messages_during_it_and_no_others() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.txt");
        let mut log = RunLog::default();
        log.write_all(b"before\n").unwrap();
        let guard = log.write_to(&path).unwrap();
        log.clone().write_all(b"during\n").unwrap();
        let part = folder.path().join("part.txt");
        let part_guard = log.write_to(&part).unwrap();
        log.clone().write_all(b"in a part\n").unwrap();
        drop(part_guard);
        assert_eq!(std::fs::read(&path).unwrap(), b"during\n");
        log.append(&part).unwrap();
        log.append(&folder.path().join("never written")).unwrap();
        drop(guard);
        log.write_all(b"after\n").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"during\nin a part\n");
    }
}
