//! What the program says on standard error, above the progress bars.

use std::io::{self, Write};

use tracing::level_filters::LevelFilter;

use super::progress::Progress;
use crate::cli::Verbosity;

/// Starts logging; a second call in a process changes nothing.
pub(super) fn start(verbosity: Verbosity, progress: &Progress) {
    let level = match verbosity {
        Verbosity::Quiet => LevelFilter::ERROR,
        Verbosity::Normal => LevelFilter::INFO,
        Verbosity::Verbose => LevelFilter::DEBUG,
        Verbosity::Everything => LevelFilter::TRACE,
    };
    let detailed = level > LevelFilter::INFO;
    // Graphics libraries talk a lot about what is of no interest here.
    let filter = tracing_subscriber::EnvFilter::builder()
        .with_default_directive(LevelFilter::ERROR.into())
        .parse_lossy(format!("error,fpmcl={level}"));
    let progress = progress.clone();
    // It fails only where logging was started before.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(detailed)
        .without_time()
        .with_ansi(progress.is_terminal())
        .with_writer(move || AboveBars(progress.clone()))
        .try_init();
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
