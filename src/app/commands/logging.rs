//! What the program says: on standard error above the progress bars, and into the log of a run.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::Context as _;
use tracing::level_filters::LevelFilter;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _, fmt};

use super::progress::Progress;
use crate::app::cli::Verbosity;

/// Starts logging; a second call in a process changes nothing.
pub(super) fn start(verbosity: Verbosity, progress: &Progress, log: &RunLog) {
    let level = match verbosity {
        Verbosity::Quiet => LevelFilter::ERROR,
        Verbosity::Normal => LevelFilter::INFO,
        Verbosity::Verbose => LevelFilter::DEBUG,
        Verbosity::Everything => LevelFilter::TRACE,
    };
    let detailed = level > LevelFilter::INFO;
    let progress = progress.clone();
    let colored = progress.is_terminal();
    let shown = fmt::layer()
        .with_target(detailed)
        .without_time()
        .with_ansi(colored)
        .with_writer(move || AboveBars(progress.clone()))
        .with_filter(filter(level));
    let log = log.clone();
    let written = fmt::layer()
        .with_target(detailed)
        .without_time()
        .with_ansi(false)
        .with_writer(move || log.clone())
        // A log is complete however quiet the terminal is.
        .with_filter(filter(level.max(LevelFilter::INFO)));
    // It fails only where logging was started before.
    let _ = tracing_subscriber::registry()
        .with(shown)
        .with(written)
        .try_init();
}

/// Graphics libraries talk a lot about what is of no interest here.
fn filter(level: LevelFilter) -> EnvFilter {
    EnvFilter::builder()
        .with_default_directive(LevelFilter::ERROR.into())
        .parse_lossy(format!("error,fpmcl={level}"))
}

/// Standard error, with the progress bars out of the way while something is written.
struct AboveBars(Progress);

impl Write for AboveBars {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        self.0.suspend(|| io::stderr().write(text))
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

/// The log of the run that is going on, if it has one.
#[derive(Clone, Debug, Default)]
pub struct RunLog {
    file: Arc<Mutex<Option<File>>>,
}

/// Until it is dropped, what is said is written into a file, too; then into the one before it.
#[derive(Debug)]
pub struct Writing {
    log: RunLog,
    before: Option<File>,
}

impl RunLog {
    /// Writes what is said from now on into a file, from its beginning.
    pub fn write_to(&self, path: &Path) -> anyhow::Result<Writing> {
        let file =
            File::create(path).with_context(|| format!("cannot create {}", path.display()))?;
        let before = self.replace(Some(file));
        let log = self.clone();
        Ok(Writing { log, before })
    }

    /// Writes down what was said elsewhere, as far as that was written down.
    pub fn repeat(&mut self, path: &Path) -> anyhow::Result<()> {
        if path.exists() {
            let said =
                std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
            self.write_all(&said)
                .context("cannot write the log of the run")?;
        }
        Ok(())
    }

    fn replace(&self, file: Option<File>) -> Option<File> {
        let mut own = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *own, file)
    }
}

impl Drop for Writing {
    fn drop(&mut self) {
        self.log.replace(self.before.take());
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
    fn a_run_has_what_was_said_during_it_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.txt");
        let mut log = RunLog::default();
        log.write_all(b"before\n").unwrap();
        let writing = log.write_to(&path).unwrap();
        log.clone().write_all(b"during\n").unwrap();
        let part = folder.path().join("part.txt");
        let writing_part = log.write_to(&part).unwrap();
        log.clone().write_all(b"in a part\n").unwrap();
        drop(writing_part);
        assert_eq!(std::fs::read(&path).unwrap(), b"during\n");
        log.repeat(&part).unwrap();
        log.repeat(&folder.path().join("never written")).unwrap();
        drop(writing);
        log.write_all(b"after\n").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"during\nin a part\n");
    }
}
