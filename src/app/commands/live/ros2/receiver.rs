//! The thread that receives: clouds into the inbox, all else to where it is known.

use std::iter;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Result;

use super::arguments::{PROPOSALS, Reliability, Ros2Args, STATIC_TRANSFORMS, TRANSFORMS};
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

/// Time without a message of a topic after which the existing ones are reported.
const PATIENCE: Duration = Duration::from_secs(5);

/// Number of messages of a topic that are read in a row.
const MOST_AT_ONCE: usize = 1000;

/// Types of the topics that are watched.
const CLOUD_TYPE: &str = "sensor_msgs/msg/PointCloud2";
const ODOMETRY_TYPE: &str = "nav_msgs/msg/Odometry";

/// The topics that are read.
pub struct Receiver {
    clouds: Reader,
    /// Whether only those of reliable senders arrive.
    are_reliable: bool,
    cloud_watch: Watch,
    odometry: Option<(Reader, Watch)>,
    transforms: Reader,
    static_transforms: Reader,
    proposals: Reader,
    elevation_bias_rad: f64,
    has_warned_of_times: bool,
}

/// Watches that messages of a topic arrive.
struct Watch {
    topic: String,
    message_type: &'static str,
    last: Instant,
    has_warned: bool,
}

/// Reads the messages of a topic and has them taken; those that are damaged are left out.
fn receive<T>(
    shared: &Shared,
    reader: &Reader,
    read: impl Fn(&[u8]) -> Result<T, String>,
    mut take: impl FnMut(T),
) {
    for message in iter::from_fn(|| reader.take()).take(MOST_AT_ONCE) {
        match message.and_then(|message| read(&message)) {
            Ok(read) => take(read),
            Err(problem) => leave_out(shared, reader, &problem),
        }
    }
}

/// Counts a damaged message, and warns of the first one of its topic.
fn leave_out(shared: &Shared, reader: &Reader, problem: &str) {
    if shared.count_damaged(&reader.topic) == 1 {
        tracing::warn!(
            "a message of {} is left out: it {problem}; check that its publisher has the same version of the type (later ones are counted in the diagnostics)",
            reader.topic
        );
    }
}

impl Watch {
    fn new(topic: &str, message_type: &'static str) -> Self {
        Self {
            topic: topic.to_owned(),
            message_type,
            last: Instant::now(),
            has_warned: false,
        }
    }

    /// Notes that a message has arrived.
    fn note_arrival(&mut self) {
        (self.last, self.has_warned) = (Instant::now(), false);
    }

    /// Warns, once per silence, of what follows from it, with the topics that exist.
    fn check(&mut self, node: &Node, consequence: &str) {
        if self.last.elapsed() <= PATIENCE || std::mem::replace(&mut self.has_warned, true) {
            return;
        }
        let (topic, message_type) = (&self.topic, self.message_type);
        let of_others = node.other_types_of(topic, message_type);
        let mut others = node.topics_of(message_type);
        others.retain(|it| it != topic && !node.owns(it));
        let found = if let Some(other) = of_others.first() {
            format!("its type is {other} elsewhere")
        } else if others.is_empty() {
            "no other topic of this type was found: check the domain, the interface, and that its sender runs".to_owned()
        } else {
            format!("other topics of this type are {}", others.join(", "))
        };
        tracing::warn!(
            "no {message_type} has arrived on {topic} for {} s{consequence}; {found}",
            PATIENCE.as_secs()
        );
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
        const TF_MESSAGE: &str = "tf2_msgs/msg/TFMessage";
        let of_clouds = match args.reliability {
            Reliability::Reliable => Quality::Reliable,
            Reliability::BestEffort => Quality::BestEffort,
        };
        let odometry = odometry
            .map(|topic| {
                let watch = Watch::new(args.remapped(topic), ODOMETRY_TYPE);
                anyhow::Ok((
                    reader(topic, ODOMETRY_TYPE, Quality::BestEffort, 100)?,
                    watch,
                ))
            })
            .transpose()?;
        Ok(Self {
            cloud_watch: Watch::new(args.remapped(clouds), CLOUD_TYPE),
            clouds: reader(clouds, CLOUD_TYPE, of_clouds, 5)?,
            are_reliable: of_clouds == Quality::Reliable,
            odometry,
            transforms: reader(TRANSFORMS, TF_MESSAGE, Quality::BestEffort, 100)?,
            static_transforms: reader(STATIC_TRANSFORMS, TF_MESSAGE, Quality::Latched, 100)?,
            proposals: reader(
                PROPOSALS,
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                Quality::Reliable,
                1,
            )?,
            elevation_bias_rad: elevation_bias_deg.to_radians(),
            has_warned_of_times: false,
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
        while !interrupt.requested() && !inbox.is_closed() {
            let readers = [
                &self.clouds,
                &self.transforms,
                &self.static_transforms,
                &self.proposals,
            ];
            for reader in readers
                .into_iter()
                .chain(self.odometry.iter().map(|it| &it.0))
            {
                reader.wakes(&waker);
            }
            self.receive_all_but_clouds(shared);
            let mut has_received = false;
            for _ in 0..MOST_AT_ONCE {
                if interrupt.requested() || inbox.is_closed() {
                    break;
                }
                let arrived = Instant::now();
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
                        inbox.push_arrived(self.arrived(number, cloud), arrived);
                    }
                    Err(problem) => {
                        unreadable.fetch_add(1, Ordering::Relaxed);
                        leave_out(shared, &self.clouds, &problem);
                    }
                }
                number += 1;
            }
            if has_received {
                self.cloud_watch.note_arrival();
                if let Some((_, watch)) = &mut self.odometry {
                    watch.check(node, ": the motion is that of the scans");
                }
            } else {
                let consequence = if self.are_reliable {
                    ": only reliable senders are received; --reliability best_effort receives from all"
                } else {
                    ""
                };
                self.cloud_watch.check(node, consequence);
                thread::park_timeout(POLL);
            }
        }
        inbox.close();
    }

    fn receive_all_but_clouds(&mut self, shared: &Shared) {
        receive(shared, &self.static_transforms, read_transforms, |it| {
            shared.static_transforms(it);
        });
        receive(shared, &self.transforms, read_transforms, |it| {
            shared.transforms(it);
        });
        if let Some((odometry, watch)) = &mut self.odometry {
            receive(shared, odometry, read_odometry, |it| {
                shared.odometry(it);
                watch.note_arrival();
            });
        }
        let propose = |(pose, deviations)| shared.propose(pose, deviations);
        receive(shared, &self.proposals, read_pose_with_deviations, propose);
    }

    fn arrived(&mut self, number: usize, cloud: ReceivedCloud) -> ArrivedFrame {
        if cloud.has_unknown_times && !std::mem::replace(&mut self.has_warned_of_times, true) {
            tracing::warn!(
                "the times of the points of {} are ignored: in no unit do they last 10 ms to 1 s and agree with the stamp; correct the driver, or set motion_compensation",
                self.cloud_watch.topic
            );
        }
        let mut scan = cloud.scan;
        scan.raise(self.elevation_bias_rad);
        let time_s = scan.time_s.unwrap_or(1e-9 * cloud.moment_ns as f64);
        // A scan of a robot is not kept.
        let source = ScanSource::Memory(Default::default());
        (Frame::new(number, source, time_s), scan)
    }
}
