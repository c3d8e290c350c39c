//! The command line as types; nothing else.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use clap::{ArgAction, Args, CommandFactory as _, Parser, Subcommand, ValueEnum};
use tracing::level_filters::LevelFilter;

use crate::app::comparison::RunId;
use crate::app::run::output::Form;
use crate::recording::scan_files;
use crate::rendering::Backend;

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
#[expect(missing_docs, reason = "they are named as the commands")]
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

/// Arguments of `doctor`.
#[derive(Clone, Debug, Args)]
pub struct DoctorArgs {
    /// Duration of the ray-casting measurement; 0 for none
    #[arg(long, value_name = "SECONDS", default_value_t = 10)]
    pub measure: u64,
}

/// Configuration and machine.
#[derive(Clone, Debug, Args)]
pub struct ConfigArgs {
    /// Configuration (.yml), or the input: a recording (odometry, build-map, localize), a point cloud (build-map), a result (refine, evaluate) or a trajectory (evaluate). Without it, the command's file under config/ or, if there is none, built-in values.
    #[arg(value_name = "CONFIG | INPUT")]
    pub config: Option<PathBuf>,

    /// Override a key, such as range_image.width=1024; repeatable.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = setting)]
    pub settings: Vec<(String, String)>,

    /// Renderer and threads.
    #[command(flatten)]
    pub machine: MachineArgs,
}

/// Arguments of a stage.
#[derive(Clone, Debug, Args)]
pub struct RunArgs {
    /// Configuration and machine.
    #[command(flatten)]
    pub source: ConfigArgs,

    /// Seed of all random choices; overrides the key `seed` where it exists.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// Replace existing output; sets the key `force` where it exists.
    #[arg(long)]
    pub force: bool,
}

/// Arguments of `info`.
#[derive(Clone, Debug, Args)]
pub struct InfoArgs {
    /// Recording (its folder, the folder of its scans, or a bag), scan or point cloud (.bin, .pcd, .ply, .npy), map (.ply), or result (.npz).
    pub path: PathBuf,

    /// Set the key topic, the topic of the scans in a bag with several: topic=/NAME.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = setting)]
    pub settings: Vec<(String, String)>,
}

/// Arguments of `odometry`.
#[derive(Clone, Debug, Args)]
pub struct OdometryArgs {
    /// Configuration and machine.
    #[command(flatten)]
    pub run: RunArgs,

    /// Folder to write; sets the key `output_folder`.
    #[arg(long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,

    /// Poses to polish, rows of KITTI or TUM, or a topic of the bag; sets the key `pose_file`.
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,

    /// Calibration of the camera whose poses these are; sets the key `calib_file`.
    #[arg(long, value_name = "FILE")]
    pub calib: Option<PathBuf>,
}

/// Arguments of `build-map`.
#[derive(Clone, Debug, Args)]
pub struct BuildMapArgs {
    /// Configuration and machine.
    #[command(flatten)]
    pub run: RunArgs,

    /// Map to write; sets the key `mesh_file`.
    #[arg(long, value_name = "MAP")]
    pub output: Option<PathBuf>,

    /// Poses of the recording, rows of KITTI or TUM, or a topic of the bag; by default those that it contains, else from the scans. Sets the key `pose_file`.
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,

    /// Calibration of the camera whose poses these are; sets the key `calib_file`.
    #[arg(long, value_name = "FILE")]
    pub calib: Option<PathBuf>,

    /// Map to which the recording is added: it is localized there, and what has changed is replaced. Sets the key `onto`.
    #[arg(long, value_name = "MAP")]
    pub onto: Option<PathBuf>,

    /// Find the poses, print one independent command per local map that is not finished, and exit.
    #[arg(long, group = "part")]
    pub list_jobs: bool,

    /// Build one local map only, by its number.
    #[arg(long, value_name = "NUMBER", group = "part")]
    pub job: Option<usize>,

    /// Join the local maps that jobs have built.
    #[arg(long, group = "part")]
    pub collect: bool,
}

/// A part of the work of `build-map`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BuildPart {
    /// Find the poses, and print a command per local map that is not finished.
    List,
    /// Build a local map by its number.
    LocalMap(usize),
    /// Join the finished local maps.
    Collect,
}

/// Arguments of `localize`.
#[derive(Clone, Debug, Args)]
pub struct LocalizeArgs {
    /// Configuration and machine.
    #[command(flatten)]
    pub run: RunArgs,

    /// Map of `build-map` or range-mcl, or a mesh (.ply, .obj, .stl); sets the key `map_file`.
    #[arg(long, value_name = "MAP")]
    pub map: Option<PathBuf>,

    /// Start in the map [m, deg], if it is known; sets the key `initial_pose`.
    #[arg(long, value_name = "X,Y,HEADING", value_parser = start, allow_hyphen_values = true)]
    pub start: Option<[f64; 3]>,

    /// Odometry, rows of KITTI or TUM, or a topic of the bag; by default the topic of odometry that a bag has, else the scans. Sets the key `odometry_file`.
    #[arg(long, value_name = "FILE")]
    pub odometry: Option<PathBuf>,

    /// True poses of the recording for the report; sets the key `pose_file`.
    #[arg(long, value_name = "FILE")]
    pub truth: Option<PathBuf>,

    /// Calibration of the camera whose poses these are; sets the key `calib_file`.
    #[arg(long, value_name = "FILE")]
    pub calib: Option<PathBuf>,

    /// Result to write (.npz); sets the key `result_path`.
    #[arg(long, value_name = "RESULT")]
    pub output: Option<PathBuf>,

    /// Log to write afterwards, for Foxglove and rerun (.mcap), as `export` does.
    #[arg(long, value_name = "FILE")]
    pub mcap: Option<PathBuf>,
}

/// Arguments of `refine`.
#[derive(Clone, Debug, Args)]
pub struct RefineArgs {
    /// Configuration and machine.
    #[command(flatten)]
    pub run: RunArgs,

    /// Recording; by default that of the localization. Sets the key `scan_folder`.
    #[arg(long, value_name = "RECORDING")]
    pub recording: Option<PathBuf>,

    /// Map; by default that of the localization. Sets the key `map_file`.
    #[arg(long, value_name = "MAP")]
    pub map: Option<PathBuf>,

    /// Standard deviations of the poses of a trajectory [m, deg]; sets the key `uncertainty`.
    #[arg(long, value_name = "POSITION,HEADING")]
    pub uncertainty: Option<String>,

    /// True poses of the recording for the report; sets the key `pose_file`.
    #[arg(long, value_name = "FILE")]
    pub truth: Option<PathBuf>,

    /// Calibration of the camera whose poses these, and those of a trajectory, are; sets the key `calib_file`.
    #[arg(long, value_name = "FILE")]
    pub calib: Option<PathBuf>,

    /// Result to write of a trajectory (.npz); sets the key `output_file`.
    #[arg(long, value_name = "RESULT")]
    pub output: Option<PathBuf>,
}

/// Arguments of `evaluate`.
#[derive(Clone, Debug, Args)]
pub struct EvaluateArgs {
    /// Configuration and machine.
    #[command(flatten)]
    pub run: RunArgs,

    /// True poses: rows of KITTI or TUM, a folder oxts, or a topic of the recording; by default those in the result. Sets the key `pose_file`.
    #[arg(long, value_name = "FILE")]
    pub truth: Option<PathBuf>,

    /// Calibration of the camera whose poses the truth has; sets the key `calib_file`.
    #[arg(long, value_name = "FILE")]
    pub calib: Option<PathBuf>,

    /// Recording whose poses are the truth; sets the key `scan_folder`.
    #[arg(long, value_name = "RECORDING")]
    pub recording: Option<PathBuf>,

    /// Alignment with the truth; by default none for a result in a map, and first for a trajectory. Sets the key `alignment`.
    #[arg(long, value_name = "ALIGNMENT", value_parser = ["none", "first", "rigid"])]
    pub align: Option<String>,

    /// Folder of the report; sets the key `output_folder`.
    #[arg(long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,
}

/// Arguments of `export`.
#[derive(Clone, Debug, Args)]
#[command(group = clap::ArgGroup::new("format").required(true).multiple(true))]
pub struct ExportArgs {
    /// Result of `localize` or `refine` (.npz), or a map (.ply, .obj, .stl).
    pub input: PathBuf,

    /// Log to write: poses with covariances, states, particles, scans in the map frame, the map (.mcap).
    #[arg(long, value_name = "FILE", group = "format")]
    pub mcap: Option<PathBuf>,

    /// Model to write: the map, and the path of a result colored by its error (.glb).
    #[arg(long, value_name = "FILE", group = "format")]
    pub glb: Option<PathBuf>,

    /// Folder to write the map to as point cloud tiles, for Autoware: `pointcloud_map.pcd/` and
    /// `pointcloud_map_metadata.yaml`.
    #[arg(long, value_name = "FOLDER", group = "format")]
    pub pcd: Option<PathBuf>,

    /// Spacing of the points of tiles: one point per square of the surface [m].
    #[arg(long, value_name = "M", requires = "pcd", value_parser = spacing, default_value_t = Self::SPACING_M)]
    pub spacing: f64,

    /// Side of tiles [m].
    #[arg(long, value_name = "M", requires = "pcd", value_parser = clap::value_parser!(u16).range(1..=1000), default_value_t = Self::TILE_SIZE_M)]
    pub tile_size: u16,

    /// Recording of the result; by default that of its localization.
    #[arg(long, value_name = "RECORDING")]
    pub recording: Option<PathBuf>,

    /// Map of the result; by default that of its localization.
    #[arg(long, value_name = "MAP")]
    pub map: Option<PathBuf>,

    /// Largest number of points per scan in a log; 0 for a log without scans.
    #[arg(long, value_name = "N", default_value_t = Self::POINTS)]
    pub points: usize,

    /// Largest memory that a stage may plan for; by default half of the machine's.
    #[arg(long, value_name = "GIB", value_parser = gibibytes)]
    pub memory: Option<f64>,

    /// Replace existing files.
    #[arg(long)]
    pub force: bool,
}

/// Arguments of `demo`.
#[derive(Clone, Debug, Args)]
pub struct DemoArgs {
    /// Output folder.
    #[arg(long, value_name = "FOLDER", default_value = "results/demo")]
    pub output: PathBuf,

    /// Scans per drive; 160 by default.
    #[arg(long, value_name = "N")]
    pub frames: Option<NonZeroUsize>,

    /// Seed of all random choices.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// Renderer and threads.
    #[command(flatten)]
    pub machine: MachineArgs,
}

/// Arguments of `compare`.
#[derive(Clone, Debug, Args)]
pub struct CompareArgs {
    /// Configuration and machine.
    #[command(flatten)]
    pub source: ConfigArgs,

    /// Print one independent command per run and exit.
    #[arg(long, group = "part")]
    pub list_jobs: bool,

    /// Build sequences and maps only, before runs are distributed.
    #[arg(long, group = "part")]
    pub prepare: bool,

    /// Execute one run only: SEQUENCE/CONFIGURATION/SEED.
    #[arg(long, value_name = "RUN", group = "part")]
    pub job: Option<RunId>,

    /// Write tables and pages of the finished runs only.
    #[arg(long, group = "part")]
    pub collect: bool,
}

/// Arguments of `ground`.
#[derive(Clone, Debug, Args)]
pub struct GroundArgs {
    /// Scan (.bin, .pcd, .ply, .npy), recording (its folder, the folder of its scans, or a bag), or configuration
    /// (.yml); by default the configuration's scan_folder.
    pub input: Option<PathBuf>,

    /// Explain the decision at the point nearest to X Y Z in the lidar frame [m]; needs one scan.
    #[arg(
        long,
        value_names = ["X", "Y", "Z"],
        num_args = 3,
        allow_negative_numbers = true,
        requires = "input"
    )]
    pub explain: Option<Vec<f32>>,

    /// Compare the methods on simulated slopes, crests, kerbs and drives with exact labels.
    #[arg(long, conflicts_with = "explain")]
    pub simulated: bool,

    /// YAML file; by default config/ground.yml or, without one, built-in values.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,

    /// Override a key, such as ground_method=pca; repeatable.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = setting)]
    pub settings: Vec<(String, String)>,

    /// Replace existing output; sets the key `force`.
    #[arg(long)]
    pub force: bool,

    /// Renderer and threads.
    #[command(flatten)]
    pub machine: MachineArgs,
}

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

impl Cli {
    /// Form of what is printed on standard output.
    pub fn form(&self) -> Form {
        match (self.json, self.all) {
            (true, _) => Form::Json,
            (false, true) => Form::All,
            (false, false) => Form::Main,
        }
    }

    /// The completions of a shell.
    pub fn completions(shell: clap_complete::Shell) -> Vec<u8> {
        let mut text = Vec::new();
        clap_complete::generate(shell, &mut Self::command(), "fpmcl", &mut text);
        text
    }

    /// The manual page of the program or of one of its commands, in roff; `None` if there is no such command.
    pub fn manual(command: Option<&str>) -> Option<std::io::Result<Vec<u8>>> {
        let mut program = Self::command();
        program.build();
        let page = match command {
            None => program,
            Some(name) => program.find_subcommand(name)?.clone(),
        };
        let mut text = Vec::new();
        let rendered = clap_mangen::Man::new(page).render(&mut text);
        Some(rendered.map(|()| text))
    }

    /// Least important messages on standard error.
    pub fn level(&self) -> LevelFilter {
        match (self.quiet, self.verbose) {
            (true, _) => LevelFilter::WARN,
            (false, 0) => LevelFilter::INFO,
            (false, 1) => LevelFilter::DEBUG,
            (false, _) => LevelFilter::TRACE,
        }
    }
}

impl Command {
    /// Renderer and threads of this command.
    pub fn machine(&self) -> MachineArgs {
        match self {
            Self::Odometry(args) => args.run.source.machine,
            Self::BuildMap(args) => args.run.source.machine,
            Self::Localize(args) => args.run.source.machine,
            Self::Refine(args) => args.run.source.machine,
            Self::Evaluate(args) => args.run.source.machine,
            Self::Simulate(args) => args.source.machine,
            Self::Compare(args) => args.source.machine,
            Self::Demo(args) => args.machine,
            Self::Ground(args) => args.machine,
            Self::Export(args) => MachineArgs {
                memory: args.memory,
                ..MachineArgs::default()
            },
            Self::Completions(_)
            | Self::Config(_)
            | Self::Doctor(_)
            | Self::Info(_)
            | Self::Man(_) => MachineArgs::default(),
        }
    }
}

impl ConfigArgs {
    /// The configuration file.
    pub fn config_file(&self) -> Option<&Path> {
        self.config.as_deref().filter(|path| is_config(path))
    }

    /// What the command works on, where the argument is no configuration.
    pub fn input(&self) -> Option<&Path> {
        self.config.as_deref().filter(|path| !is_config(path))
    }
}

/// Whether a path is that of a configuration.
fn is_config(path: &Path) -> bool {
    let extension = path.extension();
    extension.is_some_and(|it| it.eq_ignore_ascii_case("yml") || it.eq_ignore_ascii_case("yaml"))
}

impl RunArgs {
    /// Settings of the flags that stand for a key.
    pub fn flags(&self) -> Vec<(String, String)> {
        let seed = self.seed.map(|seed| ("seed".to_owned(), seed.to_string()));
        let force = self.force.then(|| ("force".to_owned(), "true".to_owned()));
        seed.into_iter().chain(force).collect()
    }
}

impl OdometryArgs {
    /// Settings of the flags that stand for a key.
    pub fn flags(&self) -> Vec<(String, String)> {
        let paths = [
            ("scan_folder", self.run.source.input()),
            ("output_folder", self.output.as_deref()),
            ("pose_file", self.poses.as_deref()),
            ("calib_file", self.calib.as_deref()),
        ];
        [path_settings(&paths), self.run.flags()].concat()
    }
}

impl BuildMapArgs {
    /// The part of the work that is asked for; `None` for all of it.
    pub fn part(&self) -> Option<BuildPart> {
        match self.job {
            Some(number) => Some(BuildPart::LocalMap(number)),
            None if self.list_jobs => Some(BuildPart::List),
            None => self.collect.then_some(BuildPart::Collect),
        }
    }

    /// Settings of the flags that stand for a key.
    pub fn flags(&self) -> Vec<(String, String)> {
        let input = self.run.source.input();
        let is_cloud = input.is_some_and(|path| path.is_file() && scan_files::is_scan(path));
        let input_key = if is_cloud {
            "cloud_file"
        } else {
            "scan_folder"
        };
        let paths = [
            (input_key, input),
            ("mesh_file", self.output.as_deref()),
            ("pose_file", self.poses.as_deref()),
            ("calib_file", self.calib.as_deref()),
            ("onto", self.onto.as_deref()),
        ];
        [path_settings(&paths), self.run.flags()].concat()
    }
}

impl LocalizeArgs {
    /// Settings of the flags that stand for a key.
    pub fn flags(&self) -> Vec<(String, String)> {
        let paths = [
            ("scan_folder", self.run.source.input()),
            ("map_file", self.map.as_deref()),
            ("odometry_file", self.odometry.as_deref()),
            ("pose_file", self.truth.as_deref()),
            ("calib_file", self.calib.as_deref()),
            ("result_path", self.output.as_deref()),
        ];
        let start = (self.start).map(|start| ("initial_pose".to_owned(), format!("{start:?}")));
        let mut settings = path_settings(&paths);
        settings.extend(start);
        [settings, self.run.flags()].concat()
    }
}

impl RefineArgs {
    /// Settings of the flags that stand for a key.
    pub fn flags(&self) -> Vec<(String, String)> {
        let paths = [
            ("result_file", self.run.source.input()),
            ("scan_folder", self.recording.as_deref()),
            ("map_file", self.map.as_deref()),
            ("pose_file", self.truth.as_deref()),
            ("calib_file", self.calib.as_deref()),
            ("output_file", self.output.as_deref()),
        ];
        let mut settings = path_settings(&paths);
        let uncertainty = self.uncertainty.as_ref();
        settings.extend(uncertainty.map(|given| ("uncertainty".to_owned(), format!("[{given}]"))));
        [settings, self.run.flags()].concat()
    }
}

impl ExportArgs {
    /// Default of `points`.
    const POINTS: usize = 30_000;
    /// Default of `spacing` [m].
    const SPACING_M: f64 = 0.2;
    /// Default of `tile_size` [m]: that of Autoware.
    const TILE_SIZE_M: u16 = 20;

    /// A log of a result in a map.
    pub fn log_of(result: &Path, map: &Path, log: &Path, force: bool) -> Self {
        Self {
            input: result.to_owned(),
            mcap: Some(log.to_owned()),
            glb: None,
            pcd: None,
            spacing: Self::SPACING_M,
            tile_size: Self::TILE_SIZE_M,
            recording: None,
            map: Some(map.to_owned()),
            points: Self::POINTS,
            memory: None,
            force,
        }
    }
}

impl EvaluateArgs {
    /// Settings of the flags that stand for a key.
    pub fn flags(&self) -> Vec<(String, String)> {
        let paths = [
            ("result_file", self.run.source.input()),
            ("pose_file", self.truth.as_deref()),
            ("calib_file", self.calib.as_deref()),
            ("scan_folder", self.recording.as_deref()),
            ("output_folder", self.output.as_deref()),
        ];
        let mut settings = path_settings(&paths);
        settings.extend((self.align.clone()).map(|align| ("alignment".to_owned(), align)));
        [settings, self.run.flags()].concat()
    }
}

/// Settings of keys whose values are paths, as YAML strings in single quotes.
fn path_settings(paths: &[(&str, Option<&Path>)]) -> Vec<(String, String)> {
    let quoted = |path: &Path| format!("'{}'", path.display().to_string().replace('\'', "''"));
    let given = paths
        .iter()
        .filter_map(|(key, path)| Some((*key, (*path)?)));
    given
        .map(|(key, path)| (key.to_owned(), quoted(path)))
        .collect()
}

/// Parses a start: x, y [m], heading [deg].
fn start(text: &str) -> Result<[f64; 3], &'static str> {
    let numbers = text.split(',').map(|number| number.trim().parse::<f64>());
    let numbers: Result<Vec<f64>, _> = numbers.collect();
    let finite = numbers
        .ok()
        .filter(|n| n.iter().all(|number| number.is_finite()));
    finite
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or("give x and y in the map in metres and the heading in degrees, such as 12.5,-3,90")
}

/// Parses a positive number of gibibytes.
fn gibibytes(text: &str) -> Result<f64, &'static str> {
    match text.parse::<f64>() {
        Ok(number) if (0.01..=1e6).contains(&number) => Ok(number),
        _ => Err("give a number from 0.01 to 1000000, such as 8"),
    }
}

/// Parses a spacing of points [m].
fn spacing(text: &str) -> Result<f64, &'static str> {
    match text.parse::<f64>() {
        Ok(number) if (0.001..=100.0).contains(&number) => Ok(number),
        _ => Err("give a number from 0.001 to 100, such as 0.2"),
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
    use super::*;

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn flags_are_settings_of_their_keys() {
        let arguments = ["fpmcl", "localize", "--seed", "7", "--force"];
        let Command::Localize(args) = Cli::parse_from(arguments).command else {
            unreachable!("the command is localize")
        };
        let expected = [("seed", "7"), ("force", "true")];
        assert_eq!(
            args.flags(),
            expected.map(|(key, value)| (key.to_owned(), value.to_owned()))
        );
    }

    #[test]
    fn a_recording_and_a_start_are_settings_of_their_keys() {
        let arguments = [
            "fpmcl", "localize", "it's/", "--map", "m.ply", "--start", "-1,2,90",
        ];
        let Command::Localize(args) = Cli::parse_from(arguments).command else {
            unreachable!("the command is localize")
        };
        let expected = [
            ("scan_folder", "'it''s/'"),
            ("map_file", "'m.ply'"),
            ("initial_pose", "[-1.0, 2.0, 90.0]"),
        ];
        assert_eq!(
            args.flags(),
            expected.map(|(key, value)| (key.to_owned(), value.to_owned()))
        );
        assert_eq!(args.run.source.config_file(), None);
        assert!(start("1,2").is_err() && start("1,2,inf").is_err());
    }

    #[test]
    fn a_setting_is_split_at_its_first_equals_sign() {
        assert_eq!(setting("a.b=c=d"), Ok(("a.b".into(), "c=d".into())));
        assert_eq!(setting("a="), Ok(("a".into(), String::new())));
        assert!(setting("a").is_err());
        assert!(setting("=a").is_err());
    }
}
