//! What every command gets in addition to its configuration.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Args, ValueEnum};
use tracing::level_filters::LevelFilter;

use crate::app::run::artefact::CONFIGURATION_FILE;
use crate::app::run::interrupt::Interrupt;
use crate::app::run::logging::{self, RunLog};
use crate::app::run::memory;
use crate::app::run::progress::Progress;
use crate::memory::MemoryBudget;
use crate::rendering::Backend;

const GIB: f64 = (1_u64 << 30) as f64;

/// Renderer and threads; results do not depend on the number of threads.
#[derive(Clone, Copy, Debug, Default, Args)]
pub struct MachineArgs {
    /// Renderer of the map.
    #[arg(long, value_enum, default_value_t)]
    pub backend: BackendArg,

    /// Number of threads; by default one per processor.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,

    /// Largest memory that a stage may plan for; by default half of the machine's.
    #[arg(long, value_name = "GIB", value_parser = gibibytes)]
    pub memory: Option<f64>,
}

/// Renderer of the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum BackendArg {
    /// The graphics adapter if available, else the processor.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// The graphics adapter; an error without one.
    Gpu,
}

impl From<BackendArg> for Backend {
    fn from(argument: BackendArg) -> Self {
        match argument {
            BackendArg::Auto => Self::Auto,
            BackendArg::Cpu => Self::Cpu,
            BackendArg::Gpu => Self::Gpu,
        }
    }
}

/// Parses a positive number of gibibytes.
pub fn gibibytes(text: &str) -> Result<f64, &'static str> {
    match text.parse::<f64>() {
        Ok(number) if (0.01..=1e6).contains(&number) => Ok(number),
        _ => Err("give a number from 0.01 to 1000000, such as 8"),
    }
}

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
    /// The configuration file, which no output may replace.
    pub config_file: Option<PathBuf>,
}

impl Context {
    /// Starts logging, the thread pool and the handling of signals, once per process.
    pub fn new(level: LevelFilter, machine: MachineArgs) -> anyhow::Result<Self> {
        let progress = Progress::new(level);
        let log = RunLog::default();
        logging::start(level, &progress, &log);
        let half_gib = 0.5 * machine_bytes() / GIB;
        memory::set(MemoryBudget {
            bytes: (machine.memory.unwrap_or(half_gib) * GIB) as u64,
        });
        let threads = machine.threads.map_or(0, usize::from);
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build_global()
            .context("starting the threads; choose fewer with --threads")?;
        Ok(Self {
            threads: rayon::current_num_threads(),
            backend: machine.backend.into(),
            interrupt: Interrupt::install().context("listening for signals")?,
            progress,
            log,
            config_file: None,
        })
    }

    /// The context of a command with a configuration file: the given one, else the default.
    pub fn with_config_file(&self, given: Option<&Path>, default: &str) -> Self {
        Self {
            config_file: Some(given.unwrap_or(Path::new(default)).to_owned()),
            ..self.clone()
        }
    }

    /// The configuration file as an input.
    pub fn input(&self) -> Option<(&'static str, &Path)> {
        Some((CONFIGURATION_FILE, self.config_file.as_deref()?))
    }
}

/// The memory that this process can have: that of the machine or, if less, of its container or the limit
/// of its address space; 8 GiB where the system does not report them [bytes].
fn machine_bytes() -> f64 {
    let number_in = |path: &str, name: &str, unit: f64| -> Option<f64> {
        let text = std::fs::read_to_string(path).ok()?;
        let line = text.lines().find(|line| line.starts_with(name))?;
        let number = line[name.len()..].split_whitespace().next()?;
        Some(unit * number.parse::<f64>().ok()?)
    };
    [
        number_in("/proc/meminfo", "MemTotal:", 1024.0),
        number_in("/sys/fs/cgroup/memory.max", "", 1.0),
        number_in("/proc/self/limits", "Max address space", 1.0),
    ]
    .into_iter()
    .flatten()
    .reduce(f64::min)
    .unwrap_or(8.0 * GIB)
}
