//! The command line: its types, and which command does what.

use anyhow::Context as _;
use clap::{ArgAction, Args, CommandFactory as _, Parser, Subcommand, ValueEnum};
use tracing::level_filters::LevelFilter;

use crate::app::commands::benchmark::{self, BenchmarkArgs};
use crate::app::commands::build_map::{self, BuildMapArgs};
use crate::app::commands::demo::{self, DemoArgs};
use crate::app::commands::doctor::{self, DoctorArgs};
use crate::app::commands::evaluate::{self, EvaluateArgs};
use crate::app::commands::export::{self, ExportArgs};
use crate::app::commands::ground::{self, GroundArgs};
use crate::app::commands::info::{self, InfoArgs};
use crate::app::commands::live::{self, LiveArgs};
use crate::app::commands::localize::{self, LocalizeArgs};
use crate::app::commands::odometry::{self, OdometryArgs};
use crate::app::commands::refine::{self, RefineArgs};
use crate::app::commands::simulate;
use crate::app::comparison::ComparisonConfig;
use crate::app::comparison::compare::{self, CompareArgs};
use crate::app::report::Report;
use crate::app::run::arguments::{configured, with_flags};
use crate::app::run::{Context, Form, MachineArgs, Printed, RunArgs, failure};
use crate::app::settings::{
    self, BuildMapConfig, CommandConfig, EvaluationConfig, GroundCommandConfig, LocalizationConfig,
    OdometryCommandConfig, RefinementConfig,
};
use crate::simulation::SimulationConfig;

/// Finds a car's pose to the centimetre from one LiDAR and a mesh map that it builds itself.
#[derive(Clone, Debug, Parser)]
#[command(name = "fpmcl", version, arg_required_else_help = true, after_help = EXAMPLES)]
pub struct Cli {
    /// Print errors, warnings and results only.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub quiet: bool,

    /// Print details; twice for everything.
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub verbose: u8,

    /// Print all rows of tables, not the twelve most important ones only.
    #[arg(long, global = true)]
    pub all: bool,

    /// Print JSON instead of tables.
    #[arg(long, global = true)]
    pub json: bool,

    /// The command.
    #[command(subcommand)]
    pub command: Command,
}

const EXAMPLES: &str = "\
Examples:
  fpmcl demo                                  the whole pipeline on a simulated street
  fpmcl info drive_1/                         describe a recording
  fpmcl build-map drive_1/ --output map.ply   build a mesh map from it
  fpmcl localize drive_2/ --map map.ply       localize another drive in the map
  fpmcl refine results/localization.npz       refine the trajectory
  fpmcl config localize > my.yml              write a configuration file to edit";

/// The subcommands, in the order of their use.
#[derive(Clone, Debug, Subcommand)]
pub enum Command {
    /// Describe a recording, a scan, a map or a result, and what is missing for which command.
    #[command(after_help = "\
Examples:
  fpmcl info drive_1/
  fpmcl info drive_2.mcap
  fpmcl info map.ply")]
    Info(InfoArgs),

    /// Find the poses of a recording from its scans, close loops and adjust all of them, or polish given poses.
    #[command(after_help = "\
Examples:
  fpmcl odometry drive_1/ --output poses/
  fpmcl odometry drive_1.mcap --output poses/
  fpmcl odometry drive_1/ --poses gnss.txt --output polished/")]
    Odometry(OdometryArgs),

    /// Build a triangle-mesh map from scans, or from a point cloud.
    #[command(after_help = "\
Examples:
  fpmcl build-map drive_1/ --output map.ply   poses that the recording contains, else from the scans
  fpmcl build-map drive_2/ --onto map.ply --output map_2.ply   add what is new, replace what has changed
  fpmcl build-map cloud.pcd --output map.ply  a point cloud from elsewhere
  fpmcl build-map config/build_map.yml
  fpmcl build-map --set mesh_file=results/even.ply --set frame_step=2 --force")]
    BuildMap(BuildMapArgs),

    /// Localize a recording in a map, scan by scan.
    #[command(after_help = "\
Examples:
  fpmcl localize drive_2/ --map map.ply       the start may be anywhere
  fpmcl localize drive_2/ --map map.ply --start 12.5,-3,90
  fpmcl localize config/localization.yml
  fpmcl localize drive_2/ --map map.ply --set numParticles=1000 --seed 7")]
    Localize(LocalizeArgs),

    /// Localize scans as they arrive, at their pace.
    #[command(after_help = "\
Examples:
  fpmcl live --map map.ply --replay drive_2/  a recording at its own pace
  fpmcl live --map map.ply --replay drive_2/ --rate 2 --start last --force
  fpmcl live --map map.ply --ros2 /points     a robot with ROS 2")]
    Live(Box<LiveArgs>),

    /// Refine the trajectory that `localize` found, or a rough one from anywhere.
    #[command(after_help = "\
Examples:
  fpmcl refine results/localization.npz       recording and map are those of the localization
  fpmcl refine gps_track.txt --recording drive_2/ --map map.ply --uncertainty 2,15
  fpmcl refine config/refinement.yml
  fpmcl refine --set result_file=results/localization.npz --backend cpu")]
    Refine(RefineArgs),

    /// Compute the errors of a result or a trajectory against the ground truth.
    #[command(after_help = "\
Examples:
  fpmcl evaluate results/localization.npz --truth poses.txt
  fpmcl evaluate trajectory.tum --truth poses.txt --calib calib.txt
  fpmcl evaluate trajectory.tum --truth other.tum --align rigid
  fpmcl evaluate config/evaluation.yml")]
    Evaluate(EvaluateArgs),

    /// Write a result or a map for other programs: MCAP for Foxglove and rerun, glTF for viewers, PCD for Autoware.
    #[command(after_help = "\
Examples:
  fpmcl export results/localization.npz --mcap run.mcap
  fpmcl export results/localization.npz --glb run.glb
  fpmcl export map.ply --glb map.glb --pcd autoware_map/")]
    Export(ExportArgs),

    /// Compare configurations: sequences x configurations x seeds.
    #[command(after_help = "\
Examples:
  fpmcl compare                               every run of config/comparison.yml
  fpmcl compare --list-jobs | parallel -j1 --sshlogin a,b --workdir .
  fpmcl compare --collect                     tables of the finished runs")]
    Compare(CompareArgs),

    /// Measure odometry, a map and a localization on a public sequence, next to published figures.
    #[command(after_help = "\
Examples:
  fpmcl benchmark kitti sequences/07/         every other scan in a map of the others
  fpmcl benchmark helipr Roundabout01/ --second Roundabout03/ --topic Ouster
  fpmcl benchmark auto drive_1/ --second drive_2/ --output results/streets")]
    Benchmark(BenchmarkArgs),

    /// Simulate a drive through a procedural street with ground truth.
    #[command(after_help = "\
Examples:
  fpmcl simulate config/simulation.yml
  fpmcl simulate --set drive=2 --seed 7")]
    Simulate(RunArgs),

    /// Simulate, build a map, localize, refine and evaluate in one command.
    #[command(after_help = "\
Examples:
  fpmcl demo
  fpmcl demo --output results/small --frames 40")]
    Demo(DemoArgs),

    /// Segment the ground of scans and explain decisions.
    #[command(after_help = "\
Examples:
  fpmcl ground data/kitti                     a recording, or a folder of scans
  fpmcl ground data/kitti/velodyne/000000.bin --explain 10.2 -1.5 -1.7
  fpmcl ground --simulated                    slopes, crests and kerbs with exact labels")]
    Ground(GroundArgs),

    /// Print the configuration file of a command.
    #[command(after_help = "\
Examples:
  fpmcl config localize > my.yml              the keys that people change
  fpmcl config localize --full                every key with its default and a comment")]
    Config(ConfigurationArgs),

    /// Show instruction sets, graphics adapters and ray-casting speed of this machine.
    Doctor(DoctorArgs),

    /// Print the completions of a shell.
    #[command(after_help = "\
Examples:
  fpmcl completions bash > ~/.local/share/bash-completion/completions/fpmcl
  fpmcl completions zsh > ~/.zfunc/_fpmcl")]
    Completions(CompletionsArgs),

    /// Print the manual page, of the program or of a command.
    #[command(after_help = "\
Examples:
  fpmcl man | man -l -
  fpmcl man localize > ~/.local/share/man/man1/fpmcl-localize.1")]
    Man(ManArgs),
}

/// Arguments of `completions`.
#[derive(Clone, Debug, Args)]
pub struct CompletionsArgs {
    /// The shell.
    #[arg(value_enum)]
    pub shell: clap_complete::Shell,
}

/// Arguments of `man`.
#[derive(Clone, Debug, Args)]
pub struct ManArgs {
    /// The command; by default the whole program.
    pub command: Option<String>,
}

/// Arguments of `config`.
#[derive(Clone, Debug, Args)]
pub struct ConfigurationArgs {
    /// The command.
    #[arg(value_enum)]
    pub command: ConfiguredCommand,

    /// Print every key with its default and a comment.
    #[arg(long)]
    pub full: bool,
}

/// A command with a configuration file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ConfiguredCommand {
    Odometry,
    BuildMap,
    Localize,
    Refine,
    Evaluate,
    Compare,
    Simulate,
    Ground,
}

impl Cli {
    /// Form of what is printed on standard output.
    pub fn form(&self) -> Form {
        if self.json {
            Form::Json
        } else if self.all {
            Form::All
        } else {
            Form::Main
        }
    }

    /// Least important messages on standard error.
    pub fn level(&self) -> LevelFilter {
        match self.verbose {
            _ if self.quiet => LevelFilter::WARN,
            0 => LevelFilter::INFO,
            1 => LevelFilter::DEBUG,
            _ => LevelFilter::TRACE,
        }
    }
}

impl Command {
    /// Renderer and threads of this command.
    pub fn machine(&self) -> MachineArgs {
        match self {
            Self::Odometry(OdometryArgs { run, .. })
            | Self::BuildMap(BuildMapArgs { run, .. })
            | Self::Localize(LocalizeArgs { run, .. })
            | Self::Refine(RefineArgs { run, .. })
            | Self::Evaluate(EvaluateArgs { run, .. })
            | Self::Simulate(run) => run.source.machine,
            Self::Live(args) => args.run.source.machine,
            Self::Compare(args) => args.source.machine,
            Self::Benchmark(args) => args.machine,
            Self::Demo(args) => args.machine,
            Self::Ground(args) => args.machine,
            Self::Export(args) => args.machine(),
            Self::Info(args) => args.machine(),
            _ => MachineArgs::default(),
        }
    }

    /// The option that names poses, or a topic of them; of `refine` a key.
    pub fn option_of_poses(&self) -> &'static str {
        match self {
            Self::Evaluate(_) => "--truth",
            Self::Localize(_) => "--odometry",
            Self::Refine(_) => "--set odometry_file=",
            _ => failure::POSES,
        }
    }

    /// Runs the command; returns what to print. `form` is that of what is printed in spite of an error.
    pub fn run(&self, form: Form, context: &Context) -> anyhow::Result<Printed> {
        match self {
            Self::Info(args) => info::run(args),
            Self::BuildMap(args) => {
                let (source, base) = (&args.run.source, BuildMapConfig::default);
                let (config, context) = configured(args, source, args.input_key(), base, context)?;
                match args.part() {
                    Some(part) => build_map::run_part(&config, part, &context),
                    None => build_map::run(&config, &context)?.printed(),
                }
            }
            Self::Odometry(args) => {
                let (source, base) = (&args.run.source, OdometryCommandConfig::default);
                let (config, context) = configured(args, source, "scan_folder", base, context)?;
                odometry::run(&config, &context)
            }
            Self::Localize(args) => {
                let (source, base) = (&args.run.source, LocalizationConfig::default);
                let (config, context) = configured(args, source, "scan_folder", base, context)?;
                let (result, map) = (&config.result_path, &config.map_input.map_file);
                let log = args.mcap.as_ref();
                let log =
                    log.map(|path| ExportArgs::log_of(result, map, path, config.output.force));
                if let Some(log) = &log {
                    export::check(log, &context)?;
                }
                let report = localize::run(&config, &context)?;
                if let Some(log) = &log {
                    export::run(log, &context)?;
                }
                run_printed(&report)
            }
            Self::Live(args) => {
                let (source, base) = (&args.source()?, LocalizationConfig::default);
                let (config, context) = configured(args, source, "scan_folder", base, context)?;
                run_printed(&live::run(args, &config, &context)?)
            }
            Self::Refine(args) => {
                let base = || refine::base_config(args.run.source.input());
                let source = &args.run.source;
                let (config, context) = configured(args, source, "result_file", base, context)?;
                run_printed(&refine::run(&config, &context)?)
            }
            Self::Evaluate(args) => {
                let (source, base) = (&args.run.source, EvaluationConfig::default);
                let (config, context) = configured(args, source, "result_file", base, context)?;
                printed(&evaluate::run(&config, &context)?)
            }
            Self::Export(args) => export::run(args, context),
            Self::Simulate(args) => {
                let settings = with_flags::<SimulationConfig>(args, &args.source, "")?;
                let path = args.source.config.as_deref();
                let config: SimulationConfig = settings::load(path, &settings)?;
                let context = context.with_config_file(path, SimulationConfig::PATH);
                let existing = if args.force {
                    simulate::Existing::Replace
                } else {
                    simulate::Existing::Keep
                };
                simulate::run(&config, existing, &context)
            }
            Self::Compare(args) => compare::run(args, form, context),
            Self::Benchmark(args) => benchmark::run(args, context),
            Self::Demo(args) => demo::run(args, context),
            Self::Ground(args) => ground::run(args, context),
            Self::Config(args) => args.run(),
            Self::Doctor(args) => doctor::run(args, context),
            Self::Completions(args) => {
                let mut text = Vec::new();
                clap_complete::generate(args.shell, &mut Cli::command(), "fpmcl", &mut text);
                Ok(Printed::text(String::from_utf8(text)?))
            }
            Self::Man(args) => args.run(),
        }
    }
}

impl ManArgs {
    /// The manual page of the program or of one of its commands, in roff.
    fn run(&self) -> anyhow::Result<Printed> {
        let mut page = Cli::command();
        page.build();
        if let Some(name) = &self.command {
            let command = page.find_subcommand(name).cloned();
            page = command
                .with_context(|| format!("there is no command {name}; fpmcl --help lists all"))?;
        }
        let mut text = Vec::new();
        clap_mangen::Man::new(page).render(&mut text)?;
        Ok(Printed::text(String::from_utf8(text)?))
    }
}

impl ConfigurationArgs {
    /// The configuration file of a command: the keys that people change, or all of them; in JSON, the defaults.
    fn run(&self) -> anyhow::Result<Printed> {
        fn text<T: CommandConfig>(full: bool) -> anyhow::Result<Printed> {
            let text = if full {
                settings::full_text::<T>()?
            } else {
                T::SHORT.to_owned()
            };
            Printed::text(text).with_json(&T::default())
        }
        match self.command {
            ConfiguredCommand::BuildMap => text::<BuildMapConfig>(self.full),
            ConfiguredCommand::Odometry => text::<OdometryCommandConfig>(self.full),
            ConfiguredCommand::Localize => text::<LocalizationConfig>(self.full),
            ConfiguredCommand::Refine => text::<RefinementConfig>(self.full),
            ConfiguredCommand::Evaluate => text::<EvaluationConfig>(self.full),
            ConfiguredCommand::Compare => text::<ComparisonConfig>(self.full),
            ConfiguredCommand::Simulate => text::<SimulationConfig>(self.full),
            ConfiguredCommand::Ground => text::<GroundCommandConfig>(self.full),
        }
    }
}

fn printed(report: &Report) -> anyhow::Result<Printed> {
    Printed::parts(report.to_text(false), report.to_text(true)).with_json(report)
}

/// The report of a run, whose exit code says whether it was localized.
fn run_printed(report: &Report) -> anyhow::Result<Printed> {
    Ok(printed(report)?.of_run(report.localized))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The settings of a command line of `localize`.
    fn settings<T: CommandConfig>(arguments: &[&str]) -> Vec<(String, String)> {
        let Command::Localize(args) =
            Cli::parse_from(["fpmcl", "localize"].iter().chain(arguments)).command
        else {
            unreachable!("the command is localize")
        };
        with_flags::<T>(&args, &args.run.source, "scan_folder").unwrap()
    }

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn a_recording_and_flags_are_settings_of_their_keys() {
        let arguments = [
            "it's/", "--map", "m.ply", "--start", "-1,2,90", "--seed", "7",
        ];
        let expected = [
            ("initial_pose", "[-1.0,2.0,90.0]"),
            ("map_file", "\"m.ply\""),
            ("scan_folder", "\"it's/\""),
            ("seed", "7"),
        ];
        assert_eq!(
            settings::<LocalizationConfig>(&arguments),
            expected.map(|(key, value)| (key.to_owned(), value.to_owned()))
        );
        let wrong = |start: &str| Cli::try_parse_from(["fpmcl", "localize", "--start", start]);
        assert!(wrong("1,2").is_err() && wrong("1,2,inf").is_err());
    }

    #[test]
    fn flags_override_settings_and_are_ignored_by_a_configuration_without_their_keys() {
        let loaded = |arguments: &[&str]| -> LocalizationConfig {
            let settings = settings::<LocalizationConfig>(arguments);
            settings::with_settings(LocalizationConfig::default(), &settings).unwrap()
        };
        let arguments = ["own.yml", "--seed", "7", "--set", "n_scans=5", "--force"];
        let config = loaded(&arguments);
        assert_eq!(
            (
                config.tracker.seed,
                config.recording.frames.n_scans,
                config.output.force
            ),
            (7, 5, true)
        );
        assert_eq!(loaded(&["--seed", "7", "--set", "seed=3"]).tracker.seed, 7);
        let evaluation = settings::<EvaluationConfig>(&arguments);
        assert!(!evaluation.iter().any(|(key, _)| key == "seed"));
    }
}
