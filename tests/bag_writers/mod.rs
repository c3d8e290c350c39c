//! Writers of small bags in every format: messages in both serializations, chunks in every compression.

#![allow(dead_code, reason = "each test file uses its own part")]

use std::collections::BTreeMap;
use std::io::{Cursor, Write as _};
use std::path::Path;

use mcap::records::MessageHeader;

/// Serialization of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Ros1,
    CdrLittle,
    CdrBig,
}

/// Serializes a message field by field.
pub struct Serializer {
    kind: Kind,
    pub bytes: Vec<u8>,
}

impl Serializer {
    pub fn new(kind: Kind) -> Self {
        let bytes = match kind {
            Kind::Ros1 => vec![],
            Kind::CdrLittle => vec![0, 1, 0, 0],
            Kind::CdrBig => vec![0, 0, 0, 0],
        };
        Self { kind, bytes }
    }

    pub fn align(&mut self, size: usize) {
        while self.kind != Kind::Ros1 && !(self.bytes.len() - 4).is_multiple_of(size) {
            self.bytes.push(0);
        }
    }

    fn number<const N: usize>(&mut self, mut little: [u8; N]) -> &mut Self {
        self.align(N);
        if self.kind == Kind::CdrBig {
            little.reverse();
        }
        self.bytes.extend(little);
        self
    }

    pub fn u8(&mut self, number: u8) -> &mut Self {
        self.number([number])
    }

    pub fn u16(&mut self, number: u16) -> &mut Self {
        self.number(number.to_le_bytes())
    }

    pub fn u32(&mut self, number: u32) -> &mut Self {
        self.number(number.to_le_bytes())
    }

    pub fn u64(&mut self, number: u64) -> &mut Self {
        self.number(number.to_le_bytes())
    }

    pub fn f32(&mut self, number: f32) -> &mut Self {
        self.number(number.to_le_bytes())
    }

    pub fn f64(&mut self, number: f64) -> &mut Self {
        self.number(number.to_le_bytes())
    }

    pub fn text(&mut self, text: &str) -> &mut Self {
        let zero = usize::from(self.kind != Kind::Ros1);
        self.u32((text.len() + zero) as u32);
        self.bytes.extend(text.bytes());
        self.bytes.extend(&[0][..zero]);
        self
    }

    pub fn header(&mut self, stamp_ns: u64, frame: &str) -> &mut Self {
        if self.kind == Kind::Ros1 {
            self.u32(7);
        }
        self.u32((stamp_ns / 1_000_000_000) as u32);
        self.u32((stamp_ns % 1_000_000_000) as u32).text(frame)
    }

    fn numbers(&mut self, numbers: &[f64]) -> &mut Self {
        for &number in numbers {
            self.f64(number);
        }
        self
    }
}

/// The points of a `PointCloud2`.
#[derive(Clone, Debug, Default)]
pub struct Cloud {
    /// Name, offset and data type of each field.
    pub fields: Vec<(&'static str, u32, u8)>,
    pub width: u32,
    pub height: u32,
    pub point_step: u32,
    pub row_step: u32,
    pub is_big_endian: bool,
    pub data: Vec<u8>,
}

impl Cloud {
    /// One row of points: float32 x, y, z, intensity, uint16 ring and float32 time, in 26 bytes.
    pub fn of(points: &[([f32; 4], u16, f32)]) -> Self {
        let mut data = Vec::new();
        for (numbers, ring, time) in points {
            data.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
            data.extend(ring.to_le_bytes());
            data.extend(time.to_le_bytes());
            data.extend([0; 4]);
        }
        Self {
            fields: vec![
                ("x", 0, 7),
                ("y", 4, 7),
                ("z", 8, 7),
                ("intensity", 12, 7),
                ("ring", 16, 4),
                ("time", 18, 7),
            ],
            width: points.len() as u32,
            height: 1,
            point_step: 26,
            row_step: 26 * points.len() as u32,
            is_big_endian: false,
            data,
        }
    }
}

/// `sensor_msgs/PointCloud2`.
pub fn point_cloud2(kind: Kind, stamp_ns: u64, frame: &str, cloud: &Cloud) -> Vec<u8> {
    let mut to = Serializer::new(kind);
    to.header(stamp_ns, frame);
    to.u32(cloud.height).u32(cloud.width);
    to.u32(cloud.fields.len() as u32);
    for (name, offset, datatype) in &cloud.fields {
        to.text(name).u32(*offset).u8(*datatype).u32(1);
    }
    to.u8(cloud.is_big_endian.into());
    to.u32(cloud.point_step).u32(cloud.row_step);
    to.u32(cloud.data.len() as u32);
    to.bytes.extend(&cloud.data);
    to.u8(1);
    to.bytes
}

/// `CustomMsg` of Livox: time after the stamp [ns], x, y, z, reflectivity and line.
pub fn livox(kind: Kind, stamp_ns: u64, points: &[(u32, [f32; 3], u8, u8)]) -> Vec<u8> {
    let mut to = Serializer::new(kind);
    to.header(stamp_ns, "livox_frame").u64(stamp_ns);
    to.u32(points.len() as u32).u8(1).u8(0).u8(0).u8(0);
    to.u32(points.len() as u32);
    for (time_ns, [x, y, z], reflectivity, line) in points {
        to.u32(*time_ns).f32(*x).f32(*y).f32(*z);
        to.u8(*reflectivity).u8(0).u8(*line);
    }
    to.bytes
}

/// `nav_msgs/Odometry`: x, y, z, and a quaternion x, y, z, w.
pub fn odometry(kind: Kind, stamp_ns: u64, frame: &str, child: &str, pose: &[f64; 7]) -> Vec<u8> {
    let mut to = Serializer::new(kind);
    to.header(stamp_ns, frame).text(child).numbers(pose);
    to.numbers(&[0.0; 36]).numbers(&[0.0; 6 + 36]);
    to.bytes
}

/// `sensor_msgs/NavSatFix` with a status, latitude, longitude [deg], altitude [m], and the diagonal of its covariance.
pub fn nav_sat_fix(
    kind: Kind,
    stamp_ns: u64,
    frame: &str,
    (status, covariance_type): (i8, u8),
    position: [f64; 3],
    [xx, yy, zz]: [f64; 3],
) -> Vec<u8> {
    let mut to = Serializer::new(kind);
    to.header(stamp_ns, frame).u8(status as u8).u16(1);
    to.numbers(&position);
    to.numbers(&[xx, 0.0, 0.0, 0.0, yy, 0.0, 0.0, 0.0, zz]);
    to.u8(covariance_type);
    to.bytes
}

/// `sensor_msgs/Imu` with angular rates [rad/s] and forces; orientation and covariances are numbers that are neither.
pub fn imu(kind: Kind, stamp_ns: u64, frame: &str, rates: &[f64; 3], forces: &[f64; 3]) -> Vec<u8> {
    let mut to = Serializer::new(kind);
    to.header(stamp_ns, frame).numbers(&[0.1, 0.2, 0.3, 0.9]);
    to.numbers(&[11.0; 9]).numbers(rates);
    to.numbers(&[12.0; 9]).numbers(forces);
    to.numbers(&[13.0; 9]);
    to.bytes
}

/// `geometry_msgs/PoseStamped`.
pub fn pose_stamped(kind: Kind, stamp_ns: u64, frame: &str, pose: &[f64; 7]) -> Vec<u8> {
    let mut to = Serializer::new(kind);
    to.header(stamp_ns, frame).numbers(pose);
    to.bytes
}

/// `geometry_msgs/PoseWithCovarianceStamped`, with the variances of x, y and heading.
pub fn proposal(
    kind: Kind,
    stamp_ns: u64,
    frame: &str,
    pose: &[f64; 7],
    variances: [f64; 3],
) -> Vec<u8> {
    let mut covariance = [0.0; 36];
    for (place, variance) in [0, 7, 35].into_iter().zip(variances) {
        covariance[place] = variance;
    }
    let mut to = Serializer::new(kind);
    to.header(stamp_ns, frame)
        .numbers(pose)
        .numbers(&covariance);
    to.bytes
}

/// `tf2_msgs/TFMessage` of transforms from child to parent.
pub fn transforms(kind: Kind, tree: &[(&str, &str, [f64; 7])]) -> Vec<u8> {
    let mut to = Serializer::new(kind);
    to.u32(tree.len() as u32);
    for (parent, child, pose) in tree {
        to.align(4);
        to.header(0, parent).text(child).numbers(pose);
    }
    to.bytes
}

/// A message of a bag.
#[derive(Clone, Debug)]
pub struct Recorded {
    pub topic: &'static str,
    /// Type in the notation of ROS 2.
    pub message_type: &'static str,
    pub time_ns: u64,
    pub data: Vec<u8>,
}

/// An `.mcap`.
pub fn mcap(options: mcap::WriteOptions, encoding: &str, messages: &[Recorded]) -> Vec<u8> {
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    for (number, message) in (0..).zip(messages) {
        let schema = writer.add_schema(message.message_type, "ros2msg", b"");
        let channel =
            writer.add_channel(schema.unwrap(), message.topic, encoding, &BTreeMap::new());
        let header = MessageHeader {
            channel_id: channel.unwrap(),
            sequence: number,
            log_time: message.time_ns,
            publish_time: message.time_ns,
        };
        writer
            .write_to_known_channel(&header, &message.data)
            .unwrap();
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

/// The records of an `.mcap` until its summary, with compressed chunks.
pub fn mcap_compressed(file: &[u8], compression: &str) -> Vec<u8> {
    let mut out = file[..8].to_vec();
    let mut rest = &file[8..];
    while rest.first().is_some_and(|kind| *kind != 0x0f) {
        let length = u64::from_le_bytes(*rest[1..].first_chunk().unwrap()) as usize;
        let (record, after) = rest.split_at(9 + length);
        rest = after;
        if record[0] != 0x06 {
            out.extend(record);
            continue;
        }
        // Times, size and checksum, no compression, size, data.
        let data = compress(compression, &record[9 + 40..]);
        let mut body = record[9..9 + 28].to_vec();
        body.extend((compression.len() as u32).to_le_bytes());
        body.extend(compression.bytes());
        body.extend((data.len() as u64).to_le_bytes());
        body.extend(data);
        out.push(0x06);
        out.extend((body.len() as u64).to_le_bytes());
        out.extend(body);
    }
    out
}

/// Compresses a chunk.
pub fn compress(compression: &str, data: &[u8]) -> Vec<u8> {
    match compression {
        "zstd" => {
            ruzstd::encoding::compress_to_vec(data, ruzstd::encoding::CompressionLevel::Fastest)
        }
        "lz4" => {
            let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
            encoder.write_all(data).unwrap();
            encoder.finish().unwrap()
        }
        "bz2" => {
            let level = bzip2::Compression::fast();
            let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), level);
            encoder.write_all(data).unwrap();
            encoder.finish().unwrap()
        }
        _ => data.to_vec(),
    }
}

fn ros1_fields(fields: &[(&str, &[u8])]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (name, value) in fields {
        bytes.extend((name.len() as u32 + 1 + value.len() as u32).to_le_bytes());
        bytes.extend(name.bytes());
        bytes.push(b'=');
        bytes.extend(*value);
    }
    bytes
}

fn ros1_record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
    let header = ros1_fields(fields);
    let [header_length, length] = [header.len(), data.len()].map(|n| (n as u32).to_le_bytes());
    [&header_length[..], &header, &length, data].concat()
}

fn ros1_time(time_ns: u64) -> [u8; 8] {
    let [s, ns] = [time_ns / 1_000_000_000, time_ns % 1_000_000_000];
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&(s as u32).to_le_bytes());
    bytes[4..].copy_from_slice(&(ns as u32).to_le_bytes());
    bytes
}

/// A `.bag` with chunks of up to three messages.
pub fn ros1(compression: &str, messages: &[Recorded]) -> Vec<u8> {
    let mut topics: Vec<(&str, String)> = Vec::new();
    for message in messages {
        let topic = (message.topic, message.message_type.replace("/msg/", "/"));
        if !topics.contains(&topic) {
            topics.push(topic);
        }
    }
    let connections: Vec<Vec<u8>> = (0_u32..)
        .zip(&topics)
        .map(|(number, (topic, message_type))| {
            let data = ros1_fields(&[
                ("topic", topic.as_bytes()),
                ("type", message_type.as_bytes()),
                ("md5sum", b"0123456789abcdef0123456789abcdef"),
                ("message_definition", b""),
            ]);
            let number = number.to_le_bytes();
            let fields: &[(&str, &[u8])] =
                &[("op", &[7]), ("conn", &number), ("topic", topic.as_bytes())];
            ros1_record(fields, &data)
        })
        .collect();
    let mut bag = vec![0; 13 + 4096];
    let mut infos = Vec::new();
    for messages in messages.chunks(3) {
        let mut chunk = connections.concat();
        let mut entries: BTreeMap<u32, Vec<u8>> = BTreeMap::new();
        for message in messages {
            let connection = topics.iter().position(|t| t.0 == message.topic).unwrap() as u32;
            let entry = entries.entry(connection).or_default();
            entry.extend(ros1_time(message.time_ns));
            entry.extend((chunk.len() as u32).to_le_bytes());
            let (number, time) = (connection.to_le_bytes(), ros1_time(message.time_ns));
            let fields: &[(&str, &[u8])] = &[("op", &[2]), ("conn", &number), ("time", &time)];
            chunk.extend(ros1_record(fields, &message.data));
        }
        let position = (bag.len() as u64).to_le_bytes();
        let size = (chunk.len() as u32).to_le_bytes();
        let fields: &[(&str, &[u8])] = &[
            ("op", &[5]),
            ("compression", compression.as_bytes()),
            ("size", &size),
        ];
        bag.extend(ros1_record(fields, &compress(compression, &chunk)));
        let mut counts = Vec::new();
        for (connection, entries) in &entries {
            let number = connection.to_le_bytes();
            let count = (entries.len() as u32 / 12).to_le_bytes();
            let fields: &[(&str, &[u8])] = &[
                ("op", &[4]),
                ("ver", &[1, 0, 0, 0]),
                ("conn", &number),
                ("count", &count),
            ];
            bag.extend(ros1_record(fields, entries));
            counts.extend([number, count].concat());
        }
        let count = (entries.len() as u32).to_le_bytes();
        let (start, end) = (
            ros1_time(messages[0].time_ns),
            ros1_time(messages[0].time_ns),
        );
        let fields: &[(&str, &[u8])] = &[
            ("op", &[6]),
            ("ver", &[1, 0, 0, 0]),
            ("chunk_pos", &position),
            ("start_time", &start),
            ("end_time", &end),
            ("count", &count),
        ];
        infos.push(ros1_record(fields, &counts));
    }
    let index_at = (bag.len() as u64).to_le_bytes();
    let counts = [connections.len(), infos.len()].map(|count| (count as u32).to_le_bytes());
    let fields: &[(&str, &[u8])] = &[
        ("op", &[3]),
        ("index_pos", &index_at),
        ("conn_count", &counts[0]),
        ("chunk_count", &counts[1]),
    ];
    let header = ros1_fields(fields).len();
    let head = ros1_record(fields, &vec![b' '; 4096 - 8 - header]);
    bag[..13].copy_from_slice(b"#ROSBAG V2.0\n");
    bag[13..13 + 4096].copy_from_slice(&head);
    bag.extend(connections.concat());
    bag.extend(infos.concat());
    bag
}

/// Writes a `.db3`.
pub fn db3(path: &Path, messages: &[Recorded]) {
    let _ = std::fs::remove_file(path);
    let database = rusqlite::Connection::open(path).unwrap();
    database
        .execute_batch(
            "PRAGMA page_size = 512; PRAGMA synchronous = OFF; PRAGMA journal_mode = OFF; BEGIN;
             CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
                serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
             CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
                timestamp INTEGER NOT NULL, data BLOB NOT NULL);
             CREATE INDEX timestamp_idx ON messages (timestamp ASC);",
        )
        .unwrap();
    let mut topics: Vec<&str> = Vec::new();
    for message in messages {
        let known = topics.iter().position(|topic| *topic == message.topic);
        let topic = known.unwrap_or_else(|| {
            topics.push(message.topic);
            let row = (topics.len() as i64, message.topic, message.message_type);
            let insert = "INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr', '')";
            database.execute(insert, row).unwrap();
            topics.len() - 1
        });
        let row = (topic as i64 + 1, message.time_ns as i64, &message.data);
        let insert = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?1, ?2, ?3)";
        database.execute(insert, row).unwrap();
    }
    database.execute_batch("COMMIT").unwrap();
}
