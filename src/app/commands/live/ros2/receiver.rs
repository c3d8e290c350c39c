//! The thread that receives: clouds into the inbox, all else to where it is known.

use std::collections::BTreeSet;
use std::iter;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Result;

use super::arguments::Ros2Args;
use super::node::{Node, Quality, Reader, waker};
use super::shared::Shared;
use crate::app::commands::live::driving::now_ns;
use crate::app::commands::live::robot::ArrivedFrame;
use crate::app::run::Interrupt;
use crate::live::Inbox;
use crate::recording::bags::received::{
    ReceivedCloud, read_odometry, read_pose_with_deviations, read_transforms,
};
use crate::recording::{Frame, ScanSource};

/// Longest time between two looks at the topics and at whether it is requested to stop.
const POLL: Duration = Duration::from_millis(20);

/// Time without a cloud after which the existing topics are reported.
const PATIENCE: Duration = Duration::from_secs(5);

/// Number of messages of a topic that are read in a row.
const MOST_AT_ONCE: usize = 1000;

/// Type of clouds.
const CLOUD: &str = "sensor_msgs/msg/PointCloud2";

/// The topics that are read.
pub struct Receiver {
    /// Name of the topic of the clouds.
    topic: String,
    clouds: Reader,
    odometry: Option<Reader>,
    transforms: Reader,
    static_transforms: Reader,
    proposals: Reader,
    elevation_bias_rad: f64,
    warned: Warned,
}

/// Warnings that were printed.
#[derive(Default)]
struct Warned {
    /// Topics with damaged messages.
    of_messages: BTreeSet<String>,
    of_times: bool,
    of_silence: bool,
}

impl Warned {
    /// Reads the messages of a topic and has them taken; those that are damaged are left out.
    fn receive<T>(
        &mut self,
        topic: &str,
        reader: &Reader,
        read: impl Fn(&[u8]) -> Result<T, String>,
        take: impl Fn(T),
    ) {
        for message in iter::from_fn(|| reader.take()).take(MOST_AT_ONCE) {
            match message.and_then(|message| read(&message)) {
                Ok(read) => take(read),
                Err(problem) => self.warn_of_message(topic, &problem),
            }
        }
    }

    /// Warns of the first damaged message of a topic.
    fn warn_of_message(&mut self, topic: &str, problem: &str) {
        if self.of_messages.insert(topic.to_owned()) {
            tracing::warn!(
                "a message of {topic} is left out: it {problem}; check that its publisher has the same version of the type (later ones are not reported)"
            );
        }
    }
}

impl Receiver {
    /// Subscribes to the topics.
    pub fn new(
        node: &mut Node,
        args: &Ros2Args,
        clouds: &str,
        odometry: Option<&str>,
        elevation_bias_deg: f64,
    ) -> Result<Self> {
        let mut reader = |topic: &str, message_type: &str, quality, depth| {
            node.reader(args.remapped(topic), message_type, quality, depth)
        };
        const TRANSFORMS: &str = "tf2_msgs/msg/TFMessage";
        let odometry = odometry
            .map(|topic| reader(topic, "nav_msgs/msg/Odometry", Quality::BestEffort, 100))
            .transpose()?;
        Ok(Self {
            topic: args.remapped(clouds).to_owned(),
            clouds: reader(clouds, CLOUD, Quality::BestEffort, 5)?,
            odometry,
            transforms: reader("/tf", TRANSFORMS, Quality::BestEffort, 100)?,
            static_transforms: reader("/tf_static", TRANSFORMS, Quality::Latched, 100)?,
            proposals: reader(
                "/initialpose",
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                Quality::Reliable,
                1,
            )?,
            elevation_bias_rad: elevation_bias_deg.to_radians(),
            warned: Warned::default(),
        })
    }

    /// Receives until it is requested to stop. Counts clouds that cannot be read.
    pub fn run(
        mut self,
        node: &Node,
        shared: &Shared,
        inbox: &Inbox<ArrivedFrame>,
        unreadable: &AtomicU64,
        interrupt: &Interrupt,
    ) {
        let waker = waker();
        let mut number = 0;
        let mut last_cloud = Instant::now();
        while !interrupt.requested() && !inbox.is_closed() {
            let readers = [
                &self.clouds,
                &self.transforms,
                &self.static_transforms,
                &self.proposals,
            ];
            for reader in readers.into_iter().chain(&self.odometry) {
                reader.wakes(&waker);
            }
            self.receive_all_but_clouds(shared);
            let mut has_received = false;
            for _ in 0..MOST_AT_ONCE {
                if interrupt.requested() || inbox.is_closed() {
                    break;
                }
                let Some(message) = self.clouds.take() else {
                    break;
                };
                has_received = true;
                // What was sent before the cloud is known before it is localized.
                self.receive_all_but_clouds(shared);
                let message = message.and_then(|message| ReceivedCloud::read(&message, now_ns()));
                match message {
                    Ok(cloud) => {
                        shared.cloud(number, &cloud.frame, cloud.moment_ns);
                        inbox.push(self.arrived(number, cloud));
                    }
                    Err(problem) => {
                        unreadable.fetch_add(1, Ordering::Relaxed);
                        self.warned.warn_of_message(&self.topic, &problem);
                    }
                }
                number += 1;
            }
            if has_received {
                last_cloud = Instant::now();
                self.warned.of_silence = false;
            } else {
                self.warn_of_silence(node, last_cloud.elapsed() > PATIENCE);
                thread::park_timeout(POLL);
            }
        }
        inbox.close();
    }

    fn receive_all_but_clouds(&mut self, shared: &Shared) {
        let warned = &mut self.warned;
        warned.receive(
            "/tf_static",
            &self.static_transforms,
            read_transforms,
            |it| {
                shared.static_transforms(it);
            },
        );
        warned.receive("/tf", &self.transforms, read_transforms, |it| {
            shared.transforms(it);
        });
        if let Some(odometry) = &self.odometry {
            warned.receive("the odometry", odometry, read_odometry, |it| {
                shared.odometry(it);
            });
        }
        let propose = |(pose, deviations)| shared.propose(pose, deviations);
        warned.receive(
            "/initialpose",
            &self.proposals,
            read_pose_with_deviations,
            propose,
        );
    }

    fn arrived(&mut self, number: usize, cloud: ReceivedCloud) -> ArrivedFrame {
        if cloud.has_unknown_times && !std::mem::replace(&mut self.warned.of_times, true) {
            tracing::warn!(
                "the times of the points of {} are ignored: in no unit do they last 10 ms to 1 s and agree with the stamp; correct the driver, or set motion_compensation",
                self.topic
            );
        }
        let mut scan = cloud.scan;
        scan.raise(self.elevation_bias_rad);
        let time_s = scan.time_s.unwrap_or(1e-9 * cloud.moment_ns as f64);
        // A scan of a robot is not kept.
        let source = ScanSource::Memory(Default::default());
        (Frame::new(number, source, time_s), scan)
    }

    /// Warns, once per silence, with the topics that have clouds.
    fn warn_of_silence(&mut self, node: &Node, is_silent: bool) {
        if !is_silent || std::mem::replace(&mut self.warned.of_silence, true) {
            return;
        }
        let mut others = node.topics_of(CLOUD);
        others.retain(|it| *it != self.topic && !it.starts_with("/fpmcl/"));
        let found = if others.is_empty() {
            "no topic with clouds was found: check the domain, the interface, and that the sensor runs".to_owned()
        } else {
            format!("topics with clouds are {}", others.join(", "))
        };
        tracing::warn!(
            "no cloud has arrived on {} for {} s; {found}",
            self.topic,
            PATIENCE.as_secs()
        );
    }
}
