//! `live`: localizes while scans arrive, at their pace.

mod driving;
mod last_pose;
mod replay;
mod robot;
mod ros2;

use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use anyhow::{Result, bail, ensure};
use clap::Args;
use serde::{Serialize, Serializer};
use serde_json::json;

use self::driving::Drive;
use self::replay::replay;
use self::robot::Robot;
use self::ros2::arguments::Ros2Args;
use super::export::MCAP;
use super::localize::opened::{Opened, open, open_driving};
use super::localize::tracking::start;
use super::localize::{DriveArgs, Recorded, run_with, start_pose};
use super::motion_source::MotionSource;
use crate::app::report::Report;
use crate::app::report::export::{McapFile, Sinks, unfinished_log};
#[cfg(feature = "viewer")]
use crate::app::report::export::{Viewer, live_topics};
use crate::app::run::arguments::yaml;
use crate::app::run::{Claims, ConfigArgs, Context, Outputs, RecordingArgs, RunArgs};
use crate::app::settings::LocalizationConfig;
use crate::file_path::{FilePath, text_of};
use crate::files::has_extension;
use crate::localization::Start;

/// Arguments of `live`.
#[derive(Clone, Debug, Args, Serialize)]
#[command(group = clap::ArgGroup::new("source").required(true))]
pub struct LiveArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// The recording.
    #[command(flatten)]
    #[serde(flatten)]
    pub recording: RecordingArgs,

    /// Map of `build-map` or range-mcl, or a mesh (.ply, .obj, .stl); sets the key `map_file`.
    #[arg(long = "map", value_name = "MAP")]
    pub map_file: Option<FilePath>,

    /// Recording whose scans arrive at their own pace; sets the key `scan_folder`.
    #[arg(long, value_name = "RECORDING", group = "source")]
    #[serde(skip)]
    pub replay: Option<FilePath>,

    /// How many times faster than it was recorded.
    #[arg(long, value_name = "R", default_value_t = 1.0, value_parser = rate, conflicts_with = "topic")]
    #[serde(skip)]
    pub rate: f64,

    /// Topics, frames and networks of ROS 2.
    #[command(flatten)]
    #[serde(skip)]
    pub ros2: Ros2Args,

    /// Start in the map [m, deg], or the last pose of a run with this output, which the scans must confirm.
    #[arg(long, value_name = "X,Y,HEADING | last", value_parser = live_start, allow_hyphen_values = true)]
    #[serde(rename = "initial_pose", serialize_with = "pose_of_start")]
    pub start: Option<LiveStart>,

    /// Odometry, true poses and result.
    #[command(flatten)]
    #[serde(flatten)]
    pub files: DriveArgs,

    /// Log to write on the way, for Foxglove and rerun (.mcap): map, scans, poses, particles, and states with their reasons.
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub record: Option<FilePath>,

    /// Serve the same to Foxglove and other viewers; by default at 127.0.0.1:8765, which only this machine reaches.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1", value_parser = address)]
    #[serde(skip)]
    pub foxglove: Option<SocketAddr>,

    /// Scans that may wait while another one is computed; the oldest is dropped for a newer one.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=1000))]
    #[serde(skip)]
    pub queue: u16,
}

/// Where the car starts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LiveStart {
    /// At x, y [m], heading [deg].
    Pose([f64; 3]),
    /// Where the last run ended.
    Last,
}

fn live_start(text: &str) -> Result<LiveStart, &'static str> {
    if text == "last" {
        return Ok(LiveStart::Last);
    }
    start_pose(text).map(LiveStart::Pose)
}

/// The key `initial_pose`; null where the flag is no pose.
fn pose_of_start<S: Serializer>(
    start: &Option<LiveStart>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    match start {
        Some(LiveStart::Pose(pose)) => pose.serialize(serializer),
        Some(LiveStart::Last) | None => serializer.serialize_none(),
    }
}

/// Port of Foxglove.
const PORT: u16 = 8765;

fn address(text: &str) -> Result<SocketAddr, &'static str> {
    match (text.parse(), text.parse::<IpAddr>()) {
        (Ok(address), _) => Ok(address),
        (_, Ok(ip)) => Ok(SocketAddr::new(ip, PORT)),
        _ => Err("give an address of this machine, with or without a port, such as 127.0.0.1:8765"),
    }
}

fn rate(text: &str) -> Result<f64, &'static str> {
    match text.parse::<f64>() {
        Ok(number) if (0.001..=1000.0).contains(&number) => Ok(number),
        _ => Err("give a number from 0.001 to 1000, such as 2"),
    }
}

impl LiveArgs {
    /// The configuration: a file, in which the recording or the topic is a setting, else that, as the argument of `localize`.
    pub fn source(&self) -> Result<ConfigArgs> {
        if let Some(input) = self.run.source.input() {
            bail!(
                "{} is no configuration (.yml); give a recording by --replay {}",
                input.display(),
                input.display()
            );
        }
        let mut source = self.run.source.clone();
        let topic = self
            .ros2
            .topic
            .as_ref()
            .map(|topic| FilePath::from(topic.as_str()));
        let scans = self.replay.clone().or(topic);
        match (&source.config, &scans) {
            (Some(_), Some(scans)) => {
                let setting = ("scan_folder".to_owned(), yaml(&json!(scans)));
                source.settings.push(setting);
            }
            _ => source.config = scans,
        }
        Ok(source)
    }
}

/// Localizes the scans of a recording or of a robot as they arrive.
pub fn run(args: &LiveArgs, config: &LocalizationConfig, context: &Context) -> Result<Report> {
    if config.refine {
        bail!(
            "refine is True, but a pose that is refined is not known while the car drives; set refine to False, and run fpmcl refine with the result"
        );
    }
    let topic = args.ros2.topic.as_deref();
    if let Some(topic) = topic {
        check_topic(topic, &args.ros2, config)?;
    }
    let last = match args.start {
        Some(LiveStart::Last) => last_pose::read(config)?,
        _ => None,
    };
    let log = args.record.as_deref();
    let claims = log.map(|log| claim_log(log, config, context)).transpose()?;
    let sinks = sinks(args)?;
    let open = if topic.is_some() { open_driving } else { open };
    let opened = open(config, &[last_pose::FILE], context);
    let localize = |opened: &Opened, motion: MotionSource, recorded: Recorded<'_, '_>| {
        let start = last.as_ref().map_or_else(
            || start(config, &opened.map, &opened.recording),
            |last| Start::near(last, config.start.clone()),
        );
        let drive = Drive {
            opened,
            recorded,
            rate: args.rate,
            queue: usize::from(args.queue),
            context,
        };
        #[cfg(feature = "ros2")]
        if let Some(topic) = topic {
            return ros2::drive(&args.ros2, topic, &drive, motion, start, sinks);
        }
        let (frames, interrupt) = (&opened.recording.frames, &context.interrupt);
        drive.run(
            motion,
            start,
            sinks,
            Robot::default(),
            |inbox, unreadable| {
                replay(frames, args.rate, inbox, unreadable, interrupt);
            },
        )
    };
    let report = opened.and_then(|opened| run_with(opened, context, localize));
    if let (Some(mut claims), Some(log)) = (claims, log)
        && log.exists()
    {
        claims.finish(log)?;
    }
    report
}

/// Checks and claims a log and the file in which it is written until the end. Both replace a file with `force` only.
fn claim_log(log: &Path, config: &LocalizationConfig, context: &Context) -> Result<Claims> {
    // No other output of a run has this ending, so that a log never takes the place of one.
    ensure!(
        has_extension(log, "mcap"),
        "--record is {}, but the log is an MCAP file; give it a name that ends in .mcap",
        log.display()
    );
    let unfinished = unfinished_log(log);
    let inputs = [
        ("result_path", config.result_path.as_path()),
        ("map_file", &config.map_input.map_file),
        ("scan_folder", &config.recording.scan_folder),
    ];
    let outputs = Outputs {
        key: "--record",
        main: log,
        magic: Some(MCAP),
        names: vec![text_of(Path::new(unfinished.file_name().unwrap_or_default())).into_owned()],
        inputs: inputs.into_iter().chain(context.input()).collect(),
        force: config.output.force,
    };
    let claims = outputs.prepare()?;
    let is_left = std::fs::metadata(&unfinished).is_ok_and(|found| found.len() > 0);
    ensure!(
        config.output.force || !is_left,
        "{} exists, the log of an interrupted run; move it, or add --force to replace it",
        unfinished.display()
    );
    Ok(claims)
}

/// Requires that the clouds of a topic can be localized.
#[cfg(feature = "ros2")]
fn check_topic(_topic: &str, args: &Ros2Args, config: &LocalizationConfig) -> Result<()> {
    ros2::check(args, config)
}

#[cfg(not(feature = "ros2"))]
fn check_topic(topic: &str, _args: &Ros2Args, _config: &LocalizationConfig) -> Result<()> {
    bail!(
        "--ros2 {topic}: this program was built without ROS 2; build it with --features ros2, or replay a recording with --replay RECORDING"
    );
}

/// Where it is sent what is known while the car drives.
fn sinks(args: &LiveArgs) -> Result<Sinks> {
    let mut sinks = Sinks::default();
    if let Some(path) = &args.record {
        let name = format!("the log {}", path.display());
        sinks.add(name, McapFile::create(path)?);
    }
    if let Some(address) = args.foxglove {
        serve(&mut sinks, address)?;
    }
    Ok(sinks)
}

#[cfg(feature = "viewer")]
fn serve(sinks: &mut Sinks, address: SocketAddr) -> Result<()> {
    let viewer = Viewer::listen(address, &live_topics()?)?;
    let address = viewer.address;
    tracing::info!("Foxglove: open the connection ws://{address}");
    if !address.ip().is_loopback() {
        tracing::warn!("whoever reaches {address} sees the map, the scans and the poses");
    }
    sinks.add(format!("the server at {address}"), viewer);
    Ok(())
}

#[cfg(not(feature = "viewer"))]
fn serve(_sinks: &mut Sinks, address: SocketAddr) -> Result<()> {
    bail!(
        "--foxglove {address}: this program was built without the server; build it with --features viewer, or write a log with --record FILE"
    );
}
