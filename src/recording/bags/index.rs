//! The index of a bag: its topics, and where the messages of those that fpmcl reads are.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

/// What the messages of a topic contain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    /// `sensor_msgs/PointCloud2`.
    PointCloud,
    /// `CustomMsg` of Livox.
    LivoxCloud,
    /// `nav_msgs/Odometry`.
    Odometry,
    /// `geometry_msgs/PoseStamped`, and that with a covariance.
    Pose,
    /// `geometry_msgs/TransformStamped`.
    Transform,
    /// `tf2_msgs/TFMessage`.
    TransformTree,
    /// `sensor_msgs/Imu`.
    Imu,
    /// `sensor_msgs/NavSatFix`.
    Fix,
}

impl Content {
    fn of(message_type: &str) -> Option<Self> {
        Some(match message_type.replace("/msg/", "/").as_str() {
            "sensor_msgs/PointCloud2" => Self::PointCloud,
            "livox_ros_driver/CustomMsg" | "livox_ros_driver2/CustomMsg" => Self::LivoxCloud,
            "nav_msgs/Odometry" => Self::Odometry,
            "geometry_msgs/PoseStamped" | "geometry_msgs/PoseWithCovarianceStamped" => Self::Pose,
            "geometry_msgs/TransformStamped" => Self::Transform,
            "tf2_msgs/TFMessage" | "tf/tfMessage" => Self::TransformTree,
            "sensor_msgs/Imu" => Self::Imu,
            "sensor_msgs/NavSatFix" => Self::Fix,
            _ => return None,
        })
    }
}

/// How messages are encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Serialization {
    /// Numbers without padding, little-endian.
    Ros1,
    /// Aligned numbers after a header with their byte order.
    Cdr,
}

/// A topic of a bag.
#[derive(Debug)]
pub struct Topic {
    /// Name, such as `/points`.
    pub name: String,
    /// Type of its messages, such as `sensor_msgs/msg/PointCloud2`.
    pub message_type: String,
    /// Number of messages.
    pub count: usize,
    /// When its first and its last message were logged [s]; `None` without messages.
    pub span_s: Option<(f64, f64)>,
    pub(super) content: Option<Content>,
    pub(super) serialization: Serialization,
    /// Whether its messages hold until the next one, as those of static transforms.
    pub(super) is_latched: bool,
    /// Messages in the order of their times; empty if fpmcl does not read them.
    pub(super) messages: Vec<Message>,
    pub(super) has_warned: AtomicBool,
}

impl Topic {
    /// Whether its messages are read: of trees of transforms, only those that do not change.
    fn is_read(&self) -> bool {
        let is_moving = self.content == Some(Content::TransformTree) && !self.is_latched;
        self.content.is_some() && !is_moving
    }
}

/// A message in a bag, of which there may be millions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message {
    /// When it was logged [ns].
    pub time_ns: u64,
    /// Position of its record, or of that of its chunk.
    position: u64,
    /// Position in the decompressed chunk, or [`NO_CHUNK`](Self::NO_CHUNK).
    offset: u32,
    file: u32,
}

impl Message {
    const NO_CHUNK: u32 = u32::MAX;

    /// Memory that is charged to the budget per message [bytes]: twice its size, because the vector doubles when it grows.
    pub const BUDGETED_BYTES: u64 = 2 * size_of::<Self>() as u64;

    fn new(time_ns: u64, file: usize, place: Place) -> Self {
        let (position, offset) = match place {
            Place::Record(position) => (position, Self::NO_CHUNK),
            // No chunk is so long that the last offset is in it.
            Place::Chunk(position, offset) => {
                (position, offset.min(u64::from(Self::NO_CHUNK - 1)) as u32)
            }
        };
        Self {
            time_ns,
            position,
            offset,
            file: file as u32,
        }
    }

    /// Index of its file.
    pub fn file(&self) -> usize {
        self.file as usize
    }

    /// Where it is in the file.
    pub fn place(&self) -> Place {
        match self.offset {
            Self::NO_CHUNK => Place::Record(self.position),
            offset => Place::Chunk(self.position, offset.into()),
        }
    }

    /// When it was logged [s].
    pub fn time_s(&self) -> f64 {
        1e-9 * self.time_ns as f64
    }
}

/// Where a message is in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Position of its record, or number of its row in a database.
    Record(u64),
    /// Position of the record of its compressed chunk, and that of its record in the decompressed chunk.
    Chunk(u64, u64),
}

/// What is known of a topic before its messages.
pub struct Connection {
    pub topic: String,
    pub message_type: String,
    /// `None` if it is unknown to fpmcl.
    pub serialization: Option<Serialization>,
    pub is_latched: bool,
}

/// The index of the files of a bag.
#[derive(Default)]
pub struct Index {
    pub topics: Vec<Topic>,
    /// Number of messages of topics that are read, in `topics` or not.
    pub read: usize,
    /// Largest number of these in `topics`.
    most_messages: usize,
    file: usize,
    /// Topics of the numbers by which a file names them.
    connections: BTreeMap<u64, usize>,
}

impl Index {
    /// An empty index of one file, which keeps at most a number of messages and counts the others.
    pub fn of_file(file: usize, most_messages: usize) -> Self {
        Self {
            file,
            most_messages,
            ..Self::default()
        }
    }

    /// Adds a topic of the file, under a number.
    pub fn connect(&mut self, number: u64, connection: Connection) {
        let topic = self.topic(&connection);
        self.topics[topic].is_latched |= connection.is_latched;
        self.connections.insert(number, topic);
    }

    fn topic(&mut self, connection: &Connection) -> usize {
        let (name, message_type) = (&connection.topic, &connection.message_type);
        let is_same = |t: &Topic| t.name == *name && t.message_type == *message_type;
        if let Some(known) = self.topics.iter().position(is_same) {
            return known;
        }
        self.topics.push(Topic {
            name: name.clone(),
            message_type: message_type.clone(),
            count: 0,
            span_s: None,
            content: (connection.serialization).and_then(|_known| Content::of(message_type)),
            serialization: connection.serialization.unwrap_or(Serialization::Cdr),
            is_latched: name.ends_with("tf_static"),
            messages: Vec::new(),
            has_warned: AtomicBool::new(false),
        });
        self.topics.len() - 1
    }

    /// Adds a message of the topic with a number.
    pub fn add(&mut self, number: u64, time_ns: u64, place: Place) -> Result<(), String> {
        let topic = self.connections.get(&number);
        let topic = *topic.ok_or("is damaged: a message has no topic; copy it again")?;
        let message = Message::new(time_ns, self.file, place);
        let topic = &mut self.topics[topic];
        let time_s = message.time_s();
        let (first_s, last_s) = topic.span_s.unwrap_or((time_s, time_s));
        topic.span_s = Some((first_s.min(time_s), last_s.max(time_s)));
        topic.count += 1;
        if topic.is_read() {
            self.read += 1;
            if self.read <= self.most_messages {
                topic.messages.push(message);
            }
        }
        Ok(())
    }

    /// Number of messages.
    pub fn count(&self) -> usize {
        self.topics.iter().map(|topic| topic.count).sum()
    }

    /// Adds the topics and messages of another file.
    pub fn append(&mut self, other: Self) {
        self.read += other.read;
        for added in other.topics {
            let topic = self.topic(&Connection {
                topic: added.name,
                message_type: added.message_type,
                serialization: added.content.map(|_known| added.serialization),
                is_latched: false,
            });
            let topic = &mut self.topics[topic];
            topic.is_latched |= added.is_latched;
            topic.count += added.count;
            topic.span_s = match (topic.span_s, added.span_s) {
                (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
                (a, b) => a.or(b),
            };
            if topic.messages.is_empty() {
                topic.messages = added.messages;
            } else {
                topic.messages.extend(added.messages);
            }
        }
    }
}
