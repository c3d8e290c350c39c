//! Arguments of the machine: renderer, threads and memory.

use clap::{Args, ValueEnum};

use crate::rendering::Backend;

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
