//! What every command gets beside its configuration.

use anyhow::Context as _;
use tracing::level_filters::LevelFilter;

use super::interrupt::Interrupt;
use super::logging::{self, RunLog};
use super::progress::Progress;
use crate::app::cli::MachineArgs;
use crate::rendering::Backend;

/// Machine and user interface of a command.
#[derive(Clone, Debug)]
pub struct Context {
    /// Number of threads.
    pub threads: usize,
    /// Processor that renders the map.
    pub backend: Backend,
    /// Interruption by the user.
    pub interrupt: Interrupt,
    /// Progress display.
    pub progress: Progress,
    /// Copy of the log for the results of a run.
    pub log: RunLog,
}

impl Context {
    /// Starts logging, the thread pool and the handling of Ctrl-C, once per process.
    pub fn new(level: LevelFilter, machine: MachineArgs) -> anyhow::Result<Self> {
        let progress = Progress::new(level);
        let log = RunLog::default();
        logging::start(level, &progress, &log);
        let threads = machine.threads.map_or(0, usize::from);
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build_global()
            .context("starting the threads; choose fewer with --threads")?;
        Ok(Self {
            threads: rayon::current_num_threads(),
            backend: machine.backend.into(),
            interrupt: Interrupt::install().context("listening for Ctrl-C")?,
            progress,
            log,
        })
    }
}
