//! Localization of clouds from a topic of ROS 2.

use std::cell::RefCell;
use std::env;
use std::iter;
use std::net::IpAddr;
use std::path::Path;

use anyhow::{Result, bail};

use super::arguments::{Ros2Args, topic};
use super::node::Node;
use super::publisher::Publisher;
use super::receiver::Receiver;
use super::shared::Shared;
use crate::app::commands::live::driving::{Drive, now_ns};
use crate::app::commands::live::robot::Robot;
use crate::app::commands::motion_source::MotionSource;
use crate::app::report::export::Sinks;
use crate::app::report::run_output;
use crate::app::settings::{LocalizationConfig, OdometrySource};
use crate::localization::Start;

/// Requires that the arguments and the variables of ROS 2 fit together and to this machine, and that a configuration asks for
/// nothing that only a recording has.
pub fn check(args: &Ros2Args, config: &LocalizationConfig) -> Result<()> {
    domain_and_networks(args)?;
    args.check_interface()?;
    args.check_remappings(odometry_topic(config).as_deref())?;
    if let Some(poses) = &config.given_poses.pose_file {
        bail!(
            "pose_file is {}, but a robot that drives has no true poses; set pose_file to null, and the start by --start X,Y,HEADING",
            poses.display()
        );
    }
    if let Some(file) = &config.motion.odometry_file
        && odometry_topic(config).is_none()
    {
        bail!(
            "odometry_file is {}, but the odometry of a robot is a topic; give one, such as --odometry /odom",
            file.display()
        );
    }
    let sensors = [
        ("imu_file", &config.inertial.imu_file),
        ("gnss_file", &config.gnss.gnss_file),
    ];
    if let Some((key, Some(file))) = sensors.into_iter().find(|(_, file)| file.is_some()) {
        bail!(
            "{key} is {}, but with --ros2 no inertial sensor or receiver is read; set {key} to null, or leave out its flag",
            file.display()
        );
    }
    Ok(())
}

/// The domain, and the addresses of its networks, `None` for all.
fn domain_and_networks(args: &Ros2Args) -> Result<(u16, Option<Vec<IpAddr>>)> {
    let variable = |name: &str| env::var(name).ok();
    let domain = args.domain(variable("ROS_DOMAIN_ID").as_deref())?;
    let range = variable("ROS_AUTOMATIC_DISCOVERY_RANGE");
    let is_local_only = variable("ROS_LOCALHOST_ONLY");
    let networks = args.networks(range.as_deref(), is_local_only.as_deref())?;
    Ok((domain, networks))
}

/// The topic that is given as the file of odometry; `None` if it is no name of a topic.
fn odometry_topic(config: &LocalizationConfig) -> Option<String> {
    let file = config
        .motion
        .odometry_file
        .as_deref()
        .and_then(Path::to_str);
    file.and_then(|it| topic(it).ok())
}

/// Localizes the clouds of a topic until it is requested to stop.
pub fn drive(
    args: &Ros2Args,
    clouds: &str,
    drive: &Drive,
    motion: MotionSource,
    start: Start,
    sinks: Sinks,
) -> Result<()> {
    let config = &drive.opened.config;
    let (domain, networks) = domain_and_networks(args)?;
    let odometry = match config.motion.odometry {
        OdometrySource::Auto | OdometrySource::File => odometry_topic(config),
        _ => None,
    };
    let odometry = odometry.as_deref();
    let shared = Shared::new(&args.map_frame, &args.base_frame);
    let mut node = Node::open(&args.node_name, domain, networks)?;
    let receiver = Receiver::new(
        &mut node,
        args,
        clouds,
        odometry,
        config.recording.elevation_bias_deg,
    )?;
    let publisher = Publisher::new(&mut node, args, &shared)?;
    if args.node_info {
        node.announce()?;
    }
    tracing::info!(
        "node /{} of ROS 2 in domain {domain} localizes the clouds of {}",
        args.node_name,
        args.remapped(clouds)
    );
    let mesh = run_output::map_around(&drive.opened.map, iter::empty())?;
    publisher.map(&mesh, now_ns());
    drop(mesh);

    let publisher = RefCell::new(publisher);
    let robot = Robot {
        measured: Box::new(|time_s| match (odometry, config.motion.odometry) {
            (Some(_), _) => shared.measured(time_s),
            (None, OdometrySource::Auto) => shared.measured_by_transforms(time_s),
            _ => None,
        }),
        proposed: Box::new(|| shared.proposed()),
        localized: Box::new(|frame| publisher.borrow_mut().localized(frame)),
        waiting: Box::new(|waiting| publisher.borrow_mut().waiting(waiting)),
    };
    let interrupt = &drive.context.interrupt;
    drive.run(motion, start, sinks, robot, |inbox, unreadable| {
        receiver.run(&node, &shared, inbox, unreadable, interrupt);
    })?;
    if (drive.recorded)().results.is_empty() {
        bail!(
            "no scan of {} was localized; check the name of the topic, --domain and --interface",
            args.remapped(clouds)
        );
    }
    interrupt.accept();
    Ok(())
}
