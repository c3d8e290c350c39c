//! The command line as types; nothing else.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::{ArgAction, Args, Parser, Subcommand, ValueEnum};

use crate::app::comparison::RunId;
use crate::rendering::Backend;

/// Finds a car's pose to the centimetre from one spinning LiDAR and a mesh map that it builds itself.
#[derive(Clone, Debug, Parser)]
#[command(name = "fpmcl", version, arg_required_else_help = true, after_help = EXAMPLES)]
pub struct Cli {
    /// Say nothing but errors and results.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub quiet: bool,

    /// Say more; twice for everything.
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub verbose: u8,

    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

const EXAMPLES: &str = "\
Examples:
  fpmcl demo                                  all of it on a street that it makes itself
  fpmcl build-map config/build_map.yml        from a recording to a mesh map
  fpmcl localize --set numParticles=1000      find the car in it, with one key changed
  fpmcl refine && fpmcl evaluate              polish the trajectory and measure it";

/// The subcommands, in the order of their use.
#[derive(Clone, Debug, Subcommand)]
pub enum Command {
    /// Turn recorded scans with poses into a triangle-mesh map.
    #[command(after_help = "\
Examples:
  fpmcl build-map config/build_map.yml
  fpmcl build-map --set mesh_file=results/even.ply --set frame_step=2 --force")]
    BuildMap(RunArgs),

    /// Find the car in a map, scan by scan.
    #[command(after_help = "\
Examples:
  fpmcl localize config/localization.yml
  fpmcl localize --set pose_tracking=False --set range_image.width=1024 --seed 7")]
    Localize(RunArgs),

    /// Polish the trajectory that `localize` found.
    #[command(after_help = "\
Examples:
  fpmcl refine config/refinement.yml
  fpmcl refine --set result_file=results/localization.npz --backend cpu")]
    Refine(RunArgs),

    /// Measure a result against the truth.
    #[command(after_help = "\
Examples:
  fpmcl evaluate config/evaluation.yml
  fpmcl evaluate --set result_file=results/localization.npz")]
    Evaluate(RunArgs),

    /// Measure configurations against each other: sequences x configurations x seeds.
    #[command(after_help = "\
Examples:
  fpmcl compare                               all that config/comparison.yml asks for
  fpmcl compare --list-jobs | parallel -j1 --sshlogin a,b --workdir .
  fpmcl compare --collect                     tables of the runs that are there")]
    Compare(CompareArgs),

    /// Make a street with a known answer and drive through it.
    #[command(after_help = "\
Examples:
  fpmcl simulate config/simulation.yml
  fpmcl simulate --set drive=2 --seed 7")]
    Simulate(RunArgs),

    /// Simulate, build a map, localize, refine, evaluate: all of it in one command.
    #[command(after_help = "\
Examples:
  fpmcl demo
  fpmcl demo --output results/small --frames 40")]
    Demo(DemoArgs),

    /// Tell ground from the rest: scan by scan, and why.
    #[command(after_help = "\
Examples:
  fpmcl ground data/kitti                     a recording, or a folder of scans
  fpmcl ground data/kitti/velodyne/000000.bin --explain 10.2 -1.5 -1.7
  fpmcl ground --simulated                    slopes, crests and kerbs with exact answers")]
    Ground(GroundArgs),

    /// Show what this machine offers: instruction sets, graphics adapters, rays per second.
    Doctor(DoctorArgs),
}

/// What `doctor` is to do.
#[derive(Clone, Debug, Args)]
pub struct DoctorArgs {
    /// How long rays are cast to measure how many there are per second; 0 casts none
    #[arg(long, value_name = "SECONDS", default_value_t = 10)]
    pub measure: u64,
}

/// Where the configuration comes from.
#[derive(Clone, Debug, Args)]
pub struct ConfigArgs {
    /// YAML file; the command's own under config/ if not given.
    pub config: Option<PathBuf>,

    /// Override one key, such as range_image.width=1024; may be given often.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = setting)]
    pub settings: Vec<(String, String)>,

    /// How the work is done.
    #[command(flatten)]
    pub machine: MachineArgs,
}

/// Everything about a run of a stage.
#[derive(Clone, Debug, Args)]
pub struct RunArgs {
    /// Where the configuration comes from.
    #[command(flatten)]
    pub source: ConfigArgs,

    /// Same seed, same result; overrides the key `seed` where there is one.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// Replace existing output; sets the key `force` where there is one.
    #[arg(long)]
    pub force: bool,
}

/// How large the demonstration is and where it goes.
#[derive(Clone, Debug, Args)]
pub struct DemoArgs {
    /// Folder for everything that it makes.
    #[arg(long, value_name = "FOLDER", default_value = "results/demo")]
    pub output: PathBuf,

    /// Scans per drive; all of the simulated path if not given.
    #[arg(long, value_name = "N")]
    pub frames: Option<NonZeroUsize>,

    /// Same seed, same result.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// How the work is done.
    #[command(flatten)]
    pub machine: MachineArgs,
}

/// What is compared, and which part of the work is done now.
#[derive(Clone, Debug, Args)]
pub struct CompareArgs {
    /// Where the configuration comes from.
    #[command(flatten)]
    pub source: ConfigArgs,

    /// Print one independent command per run, and do nothing.
    #[arg(long, group = "part")]
    pub list_jobs: bool,

    /// Make sequences and maps only, before runs are distributed.
    #[arg(long, group = "part")]
    pub prepare: bool,

    /// Do one run only: SEQUENCE/CONFIGURATION/SEED.
    #[arg(long, value_name = "RUN", group = "part")]
    pub job: Option<RunId>,

    /// Make tables and pages of the runs that are there, and run nothing.
    #[arg(long, group = "part")]
    pub collect: bool,
}

/// Which scans, and what is asked about them.
#[derive(Clone, Debug, Args)]
pub struct GroundArgs {
    /// Scan (.bin), folder of scans, recording with velodyne/ and labels/, or configuration (.yml);
    /// the configuration's scan_folder if not given.
    pub input: Option<PathBuf>,

    /// Explain the point nearest to X Y Z in the lidar frame [m]; needs a scan.
    #[arg(
        long,
        value_names = ["X", "Y", "Z"],
        num_args = 3,
        allow_negative_numbers = true,
        requires = "input"
    )]
    pub explain: Option<Vec<f32>>,

    /// Compare the methods on simulated slopes, crests, kerbs and drives, whose truth is exact.
    #[arg(long, conflicts_with = "explain")]
    pub simulated: bool,

    /// YAML file; config/ground.yml if not given, and the defaults where that is not there.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,

    /// Override one key, such as ground_method=pca; may be given often.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = setting)]
    pub settings: Vec<(String, String)>,

    /// Replace existing output; sets the key `force`.
    #[arg(long)]
    pub force: bool,

    /// How the work is done.
    #[command(flatten)]
    pub machine: MachineArgs,
}

/// What does the work; results do not depend on the number of threads.
#[derive(Clone, Copy, Debug, Default, Args)]
pub struct MachineArgs {
    /// What renders the map.
    #[arg(long, value_enum, default_value_t)]
    pub backend: BackendArg,

    /// Threads; as many as there are processors if not given.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,
}

/// What renders the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum BackendArg {
    /// A graphics card if there is one, else the processor.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// A graphics adapter; an error without one.
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

/// How much is said on standard error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verbosity {
    /// Errors only.
    Quiet,
    /// What happens.
    Normal,
    /// Details, for those who look into something.
    Verbose,
    /// Everything.
    Everything,
}

impl Cli {
    /// How much is said on standard error.
    pub fn verbosity(&self) -> Verbosity {
        match (self.quiet, self.verbose) {
            (true, _) => Verbosity::Quiet,
            (false, 0) => Verbosity::Normal,
            (false, 1) => Verbosity::Verbose,
            (false, _) => Verbosity::Everything,
        }
    }
}

impl Command {
    /// What does the work of this command.
    pub fn machine(&self) -> MachineArgs {
        match self {
            Self::BuildMap(args)
            | Self::Localize(args)
            | Self::Refine(args)
            | Self::Evaluate(args)
            | Self::Simulate(args) => args.source.machine,
            Self::Compare(args) => args.source.machine,
            Self::Demo(args) => args.machine,
            Self::Ground(args) => args.machine,
            Self::Doctor(_) => MachineArgs::default(),
        }
    }
}

impl RunArgs {
    /// The keys that have a flag of their own, as far as it is given.
    pub fn flags(&self) -> Vec<(String, String)> {
        let seed = self.seed.map(|seed| ("seed".to_owned(), seed.to_string()));
        let force = self.force.then(|| ("force".to_owned(), "true".to_owned()));
        seed.into_iter().chain(force).collect()
    }
}

/// Splits `key=value` at the first `=`.
fn setting(text: &str) -> Result<(String, String), &'static str> {
    match text.split_once('=') {
        Some((key, value)) if !key.trim().is_empty() => {
            Ok((key.trim().to_owned(), value.to_owned()))
        }
        _ => Err("write it as key=value, such as range_image.width=1024"),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn flags_are_settings_of_their_keys() {
        let arguments = ["fpmcl", "localize", "--seed", "7", "--force"];
        let Command::Localize(args) = Cli::parse_from(arguments).command else {
            unreachable!("it says localize")
        };
        let expected = [("seed", "7"), ("force", "true")];
        assert_eq!(
            args.flags(),
            expected.map(|(key, value)| (key.to_owned(), value.to_owned()))
        );
    }

    #[test]
    fn a_setting_is_split_at_its_first_equals_sign() {
        assert_eq!(setting("a.b=c=d"), Ok(("a.b".into(), "c=d".into())));
        assert_eq!(setting("a="), Ok(("a".into(), String::new())));
        assert!(setting("a").is_err());
        assert!(setting("=a").is_err());
    }
}
