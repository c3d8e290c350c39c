//! Bags, the recordings of ROS: `.mcap` and `.db3` of ROS 2, `.bag` of ROS 1, and folders with `metadata.yaml`
//! of several such files.
//!
//! A bag that is opened has its index in memory, 24 bytes per message of the topics that are read.
//! Every message can then be read from every thread; a thread holds one decompressed chunk. The times of
//! lists of messages are those at which they were logged, since the stamps are in the messages; scans and
//! poses that are read have the times of their stamps.

mod bag_file;
mod chunk_file;
mod database;
mod fields;
mod index;
mod mcap_file;
mod message;
mod nav_sat_fix;
mod point_cloud;
#[cfg(feature = "ros2")]
pub(crate) mod received;
mod ros1_file;
mod transforms;

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

pub use bag_file::EXTENSIONS;
pub use index::Topic;
pub use message::FramePose;
#[cfg(feature = "ros2")]
pub use transforms::at_nearest_common;
pub use transforms::transform_between;

use super::error::RecordingError;
use super::found_fixes::FoundFixes;
use crate::geometry::Pose3;
use crate::georeference::GeodeticFixes;
use crate::inertial::ImuSample;
use crate::lidar::Scan;
use crate::memory::MemoryBudget;
use bag_file::BagFile;
use fields::Fields;
use index::{Content, Index, Message};
use message::Header;

/// Whether a path is a bag: a file by its extension, a folder by its `metadata.yaml`.
pub fn is_bag(path: &Path) -> bool {
    let format = bag_file::format_of(path);
    EXTENSIONS.contains(&format.as_str()) || path.join("metadata.yaml").exists()
}

/// What the messages of a topic contain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TopicKind {
    /// Scans: `sensor_msgs/PointCloud2` and `CustomMsg` of Livox.
    Scans,
    /// Poses: `nav_msgs/Odometry`, `geometry_msgs/PoseStamped`, `PoseWithCovarianceStamped` and `TransformStamped`.
    Poses,
    /// Inertial measurements: `sensor_msgs/Imu`.
    Inertial,
    /// Positions of a GNSS receiver: `sensor_msgs/NavSatFix`.
    Fixes,
}

impl TopicKind {
    fn includes(self, topic: &Topic) -> bool {
        let contents: &[Content] = match self {
            Self::Scans => &[Content::PointCloud, Content::LivoxCloud],
            Self::Poses => &[Content::Odometry, Content::Pose, Content::Transform],
            Self::Inertial => &[Content::Imu],
            Self::Fixes => &[Content::Fix],
        };
        topic.count > 0
            && topic
                .content
                .is_some_and(|content| contents.contains(&content))
    }

    fn types(self) -> &'static str {
        match self {
            Self::Scans => "scans (sensor_msgs/PointCloud2, Livox CustomMsg)",
            Self::Poses => {
                "poses (nav_msgs/Odometry, geometry_msgs/PoseStamped, PoseWithCovarianceStamped or TransformStamped)"
            }
            Self::Inertial => "inertial measurements (sensor_msgs/Imu)",
            Self::Fixes => "positions (sensor_msgs/NavSatFix)",
        }
    }
}

/// A bag.
pub struct Bag {
    path: PathBuf,
    files: Vec<BagFile>,
    topics: Vec<Topic>,
}

impl fmt::Debug for Bag {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_tuple("Bag").field(&self.path).finish()
    }
}

/// What to do about an index that is too large.
const REMEDY: &str =
    "keep the topics that are used, in shorter bags, with `ros2 bag convert` or `rosbag filter`";

/// Names and types of topics.
fn listed<'a>(topics: impl Iterator<Item = &'a Topic>) -> String {
    let names = topics.map(|topic| format!("{} ({})", topic.name, topic.message_type));
    names.collect::<Vec<_>>().join(", ")
}

impl Bag {
    /// Opens a bag by its index. An `.mcap` without one is read once, as a whole.
    ///
    /// # Errors
    /// The file cannot be read, or is no bag.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        Self::open_within(path, MemoryBudget::default())
    }

    /// Opens a bag whose index is within a budget.
    ///
    /// # Errors
    /// As [`open`](Self::open); the index needs more memory.
    pub fn open_within(path: &Path, budget: MemoryBudget) -> Result<Self, RecordingError> {
        let bad = |path: &Path, problem| RecordingError::BadBag {
            path: path.to_owned(),
            problem,
        };
        let mut files = Vec::new();
        let mut index = Index::default();
        for file in bag_file::paths(path).map_err(|problem| bad(path, problem))? {
            let most_messages =
                (budget.bytes / Message::BUDGETED_BYTES).saturating_sub(index.read as u64);
            let empty = || Index::of_file(files.len(), most_messages as usize);
            let opened = BagFile::open(&file, empty);
            let (file, added) = opened.map_err(|problem| bad(&file, problem))?;
            index.append(added);
            files.push(file);
        }
        let bytes = Message::BUDGETED_BYTES as f64 * index.read as f64;
        budget
            .require("the index of a bag", bytes, REMEDY)
            .map_err(|error| RecordingError::read(path)(io::Error::other(error)))?;
        for topic in &mut index.topics {
            topic.messages.sort_by_key(|message| message.time_ns);
        }
        index.topics.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(Self {
            path: path.to_owned(),
            files,
            topics: index.topics,
        })
    }

    /// All topics, by name.
    pub fn topics(&self) -> &[Topic] {
        &self.topics
    }

    /// The topics of a kind.
    pub fn topics_of(&self, kind: TopicKind) -> impl Iterator<Item = &Topic> {
        (self.topics.iter()).filter(move |topic| kind.includes(topic))
    }

    /// The topic of a kind that is named, or the only one.
    ///
    /// # Errors
    /// There is no such topic, or there are several and none is named.
    pub fn topic(&self, kind: TopicKind, name: Option<&str>) -> Result<&Topic, RecordingError> {
        let mut found = self.topics_of(kind);
        let (path, types) = (self.path.clone(), kind.types());
        let known = listed(self.topics_of(kind));
        if known.is_empty() {
            let found = listed(self.topics.iter());
            return Err(RecordingError::NoTopic { path, types, found });
        }
        match name {
            Some(name) => {
                let topic = found.find(|topic| topic.name == name);
                topic.ok_or_else(|| RecordingError::UnknownTopic {
                    path,
                    topic: name.to_owned(),
                    types,
                    known,
                })
            }
            None => match (found.next(), found.next()) {
                (Some(only), None) => Ok(only),
                _ => Err(RecordingError::SeveralTopics { path, types, known }),
            },
        }
    }

    /// The error where poses are needed and no topic is named.
    pub(super) fn topics_of_poses_not_named(&self) -> RecordingError {
        match self.topic(TopicKind::Poses, None) {
            Err(error @ RecordingError::NoTopic { .. }) => error,
            _ => RecordingError::TopicNotNamed {
                path: self.path.clone(),
                known: listed(self.topics_of(TopicKind::Poses)),
            },
        }
    }

    /// When the scans of a topic were logged [s], ascending. What [`read_scan`](Self::read_scan) returns
    /// has the time of its stamp and its points.
    ///
    /// # Errors
    /// There is no such topic.
    pub fn scan_times(&self, topic: &str) -> Result<Vec<f64>, RecordingError> {
        let messages = &self.topic(TopicKind::Scans, Some(topic))?.messages;
        Ok(messages.iter().map(Message::time_s).collect())
    }

    /// Reads a scan of a topic, without the points whose coordinates are not finite.
    ///
    /// If the points have times, the moment of the scan is the middle of its sweep, else its stamp.
    /// Intensities are as in the message, 0 where it has none.
    ///
    /// # Errors
    /// There is no such topic or scan, or its message cannot be decoded.
    pub fn read_scan(&self, topic: &str, scan: usize) -> Result<Scan, RecordingError> {
        let topic = self.topic(TopicKind::Scans, Some(topic))?;
        let read = self.parse(topic, scan, |message, log_s| {
            let mut fields = Fields::new(message, topic.serialization)?;
            let content = topic.content.unwrap_or(Content::PointCloud);
            point_cloud::read_scan(&mut fields, content, log_s)
        })?;
        if read.has_unknown_times && !topic.has_warned.swap(true, Ordering::Relaxed) {
            tracing::warn!(
                "{}: the times of the points of {} are ignored: in no unit do they last 10 ms to 1 s and agree with the stamp",
                self.path.display(),
                topic.name
            );
        }
        Ok(read.scan)
    }

    /// Name of the frame of the scans of a topic, from the first of them.
    ///
    /// # Errors
    /// There is no such topic, or its first message cannot be decoded.
    pub fn scan_frame(&self, topic: &str) -> Result<String, RecordingError> {
        let topic = self.topic(TopicKind::Scans, Some(topic))?;
        self.parse(topic, 0, |message, _log_s| {
            let header = Header::read(&mut Fields::new(message, topic.serialization)?)?;
            Ok(header.frame)
        })
    }

    /// Reads the poses of a topic, by time.
    ///
    /// # Errors
    /// There is no such topic, or a message cannot be decoded.
    pub fn poses(&self, topic: &str) -> Result<Vec<FramePose>, RecordingError> {
        let mut poses = self.poses_of(self.topic(TopicKind::Poses, Some(topic))?)?;
        poses.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        Ok(poses)
    }

    /// Reads the inertial measurements of a topic by time, and the name of their frame. Forces are as in the messages.
    ///
    /// # Errors
    /// There is no such topic, or a message cannot be decoded.
    pub fn imu(&self, topic: &str) -> Result<(Vec<ImuSample>, String), RecordingError> {
        let topic = self.topic(TopicKind::Inertial, Some(topic))?;
        let mut frame = String::new();
        let read = |number| {
            let (sample, name) = self.parse(topic, number, |message, log_s| {
                message::read_imu(message, topic.serialization, log_s)
            })?;
            frame = name;
            Ok(sample)
        };
        let samples: Result<Vec<_>, _> = (0..topic.messages.len()).map(read).collect();
        let mut samples = samples?;
        samples.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        Ok((samples, frame))
    }

    /// Reads the positions of a GNSS receiver from a topic. The antenna is where the static transforms have the frame of the
    /// messages; positions without a height are left out.
    ///
    /// # Errors
    /// There is no such topic, a message cannot be decoded, or none has a position.
    pub fn fixes(&self, topic: &str, scan_topic: &str) -> Result<GeodeticFixes, RecordingError> {
        let topic = self.topic(TopicKind::Fixes, Some(topic))?;
        let mut found = FoundFixes::default();
        let mut frame = String::new();
        for number in 0..topic.messages.len() {
            let read = self.parse(topic, number, |message, log_s| {
                nav_sat_fix::read(&mut Fields::new(message, topic.serialization)?, log_s)
            })?;
            frame = read.frame;
            match read.fix {
                Some(fix) => found.fixes.push(fix),
                None => found.without_position += 1,
            }
        }
        let lidar_from_antenna = self.body_from_lidar(&frame, scan_topic)?;
        found.antenna_m = lidar_from_antenna.map(|it| it.inverse().translation.vector.into());
        found.checked(Path::new(&topic.name))
    }

    /// Reads the transforms that do not change: those of topics `tf_static`, and of latched ones in ROS 1.
    ///
    /// # Errors
    /// A message cannot be decoded.
    pub fn static_transforms(&self) -> Result<Vec<FramePose>, RecordingError> {
        let is_static =
            |topic: &&Topic| topic.is_latched && topic.content == Some(Content::TransformTree);
        let transforms = self.topics.iter().filter(is_static);
        let transforms = transforms.map(|topic| self.poses_of(topic));
        Ok(transforms.collect::<Result<Vec<_>, _>>()?.concat())
    }

    /// `p_body = body_from_lidar * p_lidar`, from the name of the body's frame and that of the scans of
    /// a topic, through the static transforms. `None` if they do not join the frames.
    ///
    /// # Errors
    /// A message of a transform or of the scans cannot be decoded.
    pub fn body_from_lidar(
        &self,
        body: &str,
        scan_topic: &str,
    ) -> Result<Option<Pose3>, RecordingError> {
        let lidar = self.scan_frame(scan_topic)?;
        Ok(transform_between(&self.static_transforms()?, body, &lidar))
    }

    fn poses_of(&self, topic: &Topic) -> Result<Vec<FramePose>, RecordingError> {
        let content = topic.content.unwrap_or(Content::Pose);
        let read = |number| {
            self.parse(topic, number, |message, log_s| {
                message::read_poses(message, topic.serialization, content, log_s)
            })
        };
        let poses: Result<Vec<_>, _> = (0..topic.messages.len()).map(read).collect();
        Ok(poses?.concat())
    }

    /// Reads a message of a topic, and parses it together with the time at which it was logged [s].
    fn parse<T>(
        &self,
        topic: &Topic,
        number: usize,
        parse: impl FnOnce(&[u8], f64) -> Result<T, String>,
    ) -> Result<T, RecordingError> {
        let read = || {
            let count = topic.messages.len();
            let message = topic.messages.get(number);
            let message = message.ok_or_else(|| format!("does not exist, there are {count}"))?;
            let bytes = self.files[message.file()].read(message)?;
            parse(&bytes, message.time_s())
        };
        read().map_err(|problem| RecordingError::BadMessage {
            path: (topic.messages.get(number))
                .map_or(&self.path, |message| &self.files[message.file()].path)
                .clone(),
            topic: topic.name.clone(),
            number,
            problem,
        })
    }
}
