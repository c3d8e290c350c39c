//! A node of ROS 2 on DDS: topics and types have the names that ROS 2 gives them on the wire, and messages are bytes in CDR.

use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::Arc;
use std::task::{Wake, Waker};
use std::thread::{self, Thread};

use anyhow::{Context as _, Result};
use rustdds::bytes::Bytes;
use rustdds::no_key::{
    DataWriter, Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter, SimpleDataReader,
};
use rustdds::policy::{Durability, History};
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, Duration, GUID, Publisher, QosPolicies,
    QosPolicyBuilder, RTPSEntity as _, RepresentationIdentifier, Subscriber, Topic, TopicKind,
};

use super::cdr::Cdr;

/// Longest time that a message waits for slow readers of reliable topics.
const LONGEST_WAIT: Duration = Duration::from_millis(5);

/// Quality of service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quality {
    /// What is lost is not sent again.
    BestEffort,
    /// What is lost is sent again.
    Reliable,
    /// The last message is kept for readers that come later.
    Latched,
}

impl Quality {
    fn policies(self, depth: i32) -> QosPolicies {
        let policies = QosPolicyBuilder::new().history(History::KeepLast { depth });
        match self {
            Self::BestEffort => policies.best_effort().durability(Durability::Volatile),
            Self::Reliable => policies
                .reliable(LONGEST_WAIT)
                .durability(Durability::Volatile),
            Self::Latched => {
                (policies.reliable(LONGEST_WAIT)).durability(Durability::TransientLocal)
            }
        }
        .build()
    }
}

/// A node.
pub struct Node {
    name: String,
    participant: DomainParticipant,
    publisher: Publisher,
    subscriber: Subscriber,
    readers: Vec<GUID>,
    writers: Vec<GUID>,
    /// Announces the node of the readers and writers.
    announcement: Option<Writer>,
}

impl Node {
    /// A node in a domain, in the networks of some addresses of this machine, or in all.
    pub fn open(name: &str, domain: u16, networks: Option<Vec<IpAddr>>) -> Result<Self> {
        let open = || {
            let mut builder = DomainParticipantBuilder::new(domain);
            if let Some(addresses) = networks {
                let is_local = addresses.iter().any(IpAddr::is_loopback);
                builder = builder
                    .same_host_loopback(is_local)
                    .with_only_networks(addresses);
            }
            let participant = builder.build()?;
            let policies = Quality::Reliable.policies(1);
            anyhow::Ok(Self {
                name: name.to_owned(),
                publisher: participant.create_publisher(&policies)?,
                subscriber: participant.create_subscriber(&policies)?,
                participant,
                readers: vec![],
                writers: vec![],
                announcement: None,
            })
        };
        open().with_context(|| format!("cannot join domain {domain} of ROS 2"))
    }

    /// Subscribes to a topic with a type such as `sensor_msgs/msg/PointCloud2`.
    pub fn reader(
        &mut self,
        topic: &str,
        message_type: &str,
        quality: Quality,
        depth: i32,
    ) -> Result<Reader> {
        let policies = quality.policies(depth);
        let found = self.topic(&wire_topic(topic), &wire_type(message_type), &policies)?;
        let subscriber = &self.subscriber;
        let reader = Reader {
            topic: topic.to_owned(),
            messages: subscriber.create_simple_datareader_no_key(&found, Some(policies))?,
        };
        self.readers.push(reader.messages.guid());
        Ok(reader)
    }

    /// Offers a topic.
    pub fn writer(
        &mut self,
        topic: &str,
        message_type: &str,
        quality: Quality,
        depth: i32,
    ) -> Result<Writer> {
        let policies = quality.policies(depth);
        self.raw_writer(&wire_topic(topic), &wire_type(message_type), policies)
    }

    /// Announces the name of the node, its readers and writers, in the format of Iron and later; call it after they were made.
    pub fn announce(&mut self) -> Result<()> {
        const TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
        let policies = Quality::Latched.policies(1);
        let writer = self.raw_writer("ros_discovery_info", TYPE, policies)?;
        let mut info = Cdr::default().array(&self.participant.guid().to_bytes());
        // One node, in the topmost namespace.
        info = info.u32(1).text("/").text(&self.name);
        for entities in [&self.readers, &self.writers] {
            info = info.u32(entities.len() as u32);
            info = entities
                .iter()
                .fold(info, |info, it| info.array(&it.to_bytes()));
        }
        writer.send(info);
        self.announcement = Some(writer);
        Ok(())
    }

    /// Whether a topic is one of those that the node names after itself.
    pub fn owns(&self, topic: &str) -> bool {
        let name = topic.strip_prefix('/').and_then(|it| it.split_once('/'));
        name.is_some_and(|(name, _)| name == self.name)
    }

    /// Topics of a type that others offer or read.
    pub fn topics_of(&self, message_type: &str) -> Vec<String> {
        let topics = self.participant.discovered_topics();
        let is_of_type = |name: &str| name == wire_type(message_type);
        let of_type = topics.iter().filter(|it| is_of_type(it.type_name()));
        let mut names: Vec<String> = of_type
            .filter_map(|it| Some(format!("/{}", it.topic_name().strip_prefix("rt/")?)))
            .collect();
        sort_unique(&mut names);
        names
    }

    /// Other types than this one with which others offer or read a topic.
    pub fn other_types_of(&self, topic: &str, message_type: &str) -> Vec<String> {
        let topics = self.participant.discovered_topics();
        let of_topic = topics
            .iter()
            .filter(|it| *it.topic_name() == wire_topic(topic));
        let types = of_topic.map(|it| type_of_wire(it.type_name()));
        let mut types: Vec<String> = types.filter(|it| it != message_type).collect();
        sort_unique(&mut types);
        types
    }

    /// Offers a topic by its name and type on the wire.
    fn raw_writer(
        &mut self,
        topic: &str,
        message_type: &str,
        policies: QosPolicies,
    ) -> Result<Writer> {
        let topic = self.topic(topic, message_type, &policies)?;
        let publisher = &self.publisher;
        let writer = Writer(publisher.create_datawriter_no_key(&topic, Some(policies))?);
        self.writers.push(writer.0.guid());
        Ok(writer)
    }

    fn topic(&self, name: &str, message_type: &str, policies: &QosPolicies) -> Result<Topic> {
        let (name, message_type) = (name.to_owned(), message_type.to_owned());
        Ok(self
            .participant
            .create_topic(name, message_type, policies, TopicKind::NoKey)?)
    }
}

/// The name of a topic on the wire: of `/points`, `rt/points`.
fn wire_topic(topic: &str) -> String {
    format!("rt{topic}")
}

/// The name of a type on the wire: of `tf2_msgs/msg/TFMessage`, `tf2_msgs::msg::dds_::TFMessage_`.
fn wire_type(message_type: &str) -> String {
    let (package, name) = message_type
        .split_once("/msg/")
        .unwrap_or(("", message_type));
    format!("{package}::msg::dds_::{name}_")
}

/// The inverse of [`wire_type`].
fn type_of_wire(name: &str) -> String {
    let name = name.replace("::dds_::", "::").replace("::", "/");
    name.strip_suffix('_').unwrap_or(&name).to_owned()
}

fn sort_unique(names: &mut Vec<String>) {
    names.sort();
    names.dedup();
}

/// Receives messages of a topic, with the header of CDR.
pub struct Reader {
    /// Name of the topic.
    pub topic: String,
    messages: SimpleDataReader<Vec<u8>, Raw>,
}

impl Reader {
    /// The oldest message that was not taken; an error of one that is too large, or of an encoding that ROS 2 does not use.
    pub fn take(&self) -> Option<Result<Vec<u8>, String>> {
        self.messages.drain_read_notifications();
        let taken = self.messages.try_take_one();
        let taken = taken.map_err(|error| error.to_string()).transpose()?;
        Some(taken.map(|message| message.sample))
    }

    /// Has a message wake this thread.
    pub fn wakes(&self, waker: &Waker) {
        self.messages.set_waker(Some(waker.clone()));
    }
}

/// Sends messages of a topic.
pub struct Writer(DataWriter<Bytes, Raw>);

impl Writer {
    /// Sends a message. One that slow readers leave no room for is lost.
    pub fn send(&self, message: Cdr) {
        if let Err(error) = self.0.write(message.finish().into(), None) {
            tracing::debug!("a message is not sent: {error}");
        }
    }
}

/// Wakes a thread that is parked.
struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

/// Wakes this thread.
pub fn waker() -> Waker {
    Arc::new(Unpark(thread::current())).into()
}

/// Messages as their bytes.
pub struct Raw;

/// Largest message that is read, ten times the largest clouds [bytes].
const MOST_BYTES: usize = 1 << 27;

/// Why a message is not read.
#[derive(Debug, thiserror::Error)]
#[error("it has {0} bytes, more than {MOST_BYTES}")]
pub struct TooLarge(usize);

impl DeserializerAdapter<Vec<u8>> for Raw {
    type Error = TooLarge;
    type Decoded = Vec<u8>;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &[
            RepresentationIdentifier::CDR_LE,
            RepresentationIdentifier::CDR_BE,
        ]
    }

    fn transform_decoded(decoded: Vec<u8>) -> Vec<u8> {
        decoded
    }
}

impl DefaultDecoder<Vec<u8>> for Raw {
    type Decoder = Copied;
    const DECODER: Copied = Copied;
}

/// Copies a message, so that what comes next does not wait until it is understood.
#[derive(Clone)]
pub struct Copied;

impl Decode<'_, Vec<u8>> for Copied {
    type Error = TooLarge;

    fn decode_bytes(
        self,
        bytes: &[u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Vec<u8>, TooLarge> {
        if bytes.len() > MOST_BYTES {
            return Err(TooLarge(bytes.len()));
        }
        let is_little_endian = encoding == RepresentationIdentifier::CDR_LE;
        let header = [0, u8::from(is_little_endian), 0, 0];
        Ok([&header, bytes].concat())
    }
}

impl SerializerAdapter<Bytes> for Raw {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(message: &Bytes) -> Result<Bytes, Infallible> {
        Ok(message.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_and_types_have_their_names_on_the_wire() {
        assert_eq!(wire_topic("/fpmcl/pose"), "rt/fpmcl/pose");
        assert_eq!(
            wire_type("tf2_msgs/msg/TFMessage"),
            "tf2_msgs::msg::dds_::TFMessage_"
        );
        let known = "sensor_msgs/msg/PointCloud2";
        assert_eq!(type_of_wire(&wire_type(known)), known);
    }
}
