//! `.bag` of ROS 1, version 2.0, from the index at its end and those after its chunks.
//!
//! Format: <https://wiki.ros.org/Bags/Format/2.0>. The crate `rosbag` decompresses every chunk that it passes, so that
//! an index of a large bag takes minutes, and it panics on bags that were not closed.

use std::io::Read;

use super::chunk_file::{ChunkFile, ChunkFormat, decompress, read_bytes, read_u32, truncated};
use super::index::{Connection, Index, Place, Serialization};

pub const FORMAT: ChunkFormat = ChunkFormat { chunk, message };

const MAGIC: &[u8] = b"#ROSBAG V2.0\n";

/// Types of records.
mod op {
    pub const MESSAGE: u64 = 2;
    pub const BAG: u64 = 3;
    pub const INDEX: u64 = 4;
    pub const CHUNK: u64 = 5;
    pub const CHUNK_INFO: u64 = 6;
    pub const CONNECTION: u64 = 7;
}

/// The header of a record and the length of the data after it.
struct Record {
    header: Vec<u8>,
    data_length: u64,
}

impl Record {
    fn read(source: &mut dyn Read) -> Result<Self, String> {
        let header_length = read_u32(source)?.into();
        let header = read_bytes(source, header_length)?;
        let data_length = read_u32(source)?.into();
        Ok(Self {
            header,
            data_length,
        })
    }

    fn number(&self, name: &str) -> Result<u64, String> {
        let value = field(&self.header, name).filter(|value| value.len() <= 8);
        let value = value.ok_or_else(truncated)?;
        let digits = value.iter().rev();
        Ok(digits.fold(0, |number, &byte| number << 8 | u64::from(byte)))
    }

    /// Reads the data, if the record has a type.
    fn data(&self, source: &mut dyn Read, expected: u64) -> Result<Vec<u8>, String> {
        if self.number("op")? != expected {
            return Err(truncated());
        }
        read_bytes(source, self.data_length)
    }

    /// Bytes of the record before its data.
    fn head(&self) -> u64 {
        8 + self.header.len() as u64
    }
}

/// The value of a field of a header: fields are a length, and `name=value`.
fn field<'a>(mut header: &'a [u8], name: &str) -> Option<&'a [u8]> {
    while let Some((length, rest)) = header.split_first_chunk() {
        let length = u32::from_le_bytes(*length) as usize;
        let (field, after) = rest.split_at_checked(length)?;
        let value = field.strip_prefix(name.as_bytes());
        if let Some(value) = value.and_then(|rest| rest.strip_prefix(b"=")) {
            return Some(value);
        }
        header = after;
    }
    None
}

/// Reads the index of a file.
pub fn index(file: &mut ChunkFile, empty: impl Fn() -> Index) -> Result<Index, String> {
    let magic = read_bytes(file.at(0)?, MAGIC.len() as u64);
    if magic.as_deref() != Ok(MAGIC) {
        return Err(
            "is not a ROS 1 bag of version 2.0; `rosbag fix` converts older ones".to_owned(),
        );
    }
    let bag = Record::read(&mut file.file)?;
    let index_at = bag.number("index_pos")?;
    if bag.number("op")? != op::BAG || index_at == 0 || index_at >= file.length {
        return Err(
            "has no index, its recorder was interrupted; repair it with `rosbag reindex`"
                .to_owned(),
        );
    }
    let mut index = empty();
    let mut chunks = Vec::new();
    let mut position = index_at;
    while position < file.length {
        let record = Record::read(file.at(position)?)?;
        match record.number("op")? {
            op::CONNECTION => {
                let data = read_bytes(&mut file.file, record.data_length)?;
                index.connect(record.number("conn")?, connection(&record, &data));
            }
            op::CHUNK_INFO => chunks.push(record.number("chunk_pos")?),
            _ => {}
        }
        position += record.head() + record.data_length;
    }
    let mut index_bytes = 0;
    for chunk in chunks {
        index_bytes += add_chunk(&mut index, file, chunk)?;
        if index_bytes > file.length {
            return Err(
                "is damaged: its chunks overlap; repair it with `rosbag reindex`".to_owned(),
            );
        }
    }
    Ok(index)
}

fn connection(record: &Record, data: &[u8]) -> Connection {
    let text =
        |value: Option<&[u8]>| String::from_utf8_lossy(value.unwrap_or_default()).into_owned();
    Connection {
        topic: text(field(&record.header, "topic")),
        message_type: text(field(data, "type")),
        serialization: Some(Serialization::Ros1),
        is_latched: field(data, "latching") == Some(b"1"),
    }
}

/// Adds the messages of a chunk from the indexes after it. Returns the size of these [bytes].
fn add_chunk(index: &mut Index, file: &mut ChunkFile, chunk_at: u64) -> Result<u64, String> {
    let chunk = Record::read(file.at(chunk_at)?)?;
    let data_at = chunk_at + chunk.head();
    let is_compressed = field(&chunk.header, "compression") != Some(b"none");
    let indexes_at = data_at + chunk.data_length;
    let mut position = indexes_at;
    while position < file.length {
        let record = Record::read(file.at(position)?)?;
        if record.number("op")? != op::INDEX {
            break;
        }
        let data = read_bytes(&mut file.file, record.data_length)?;
        let connection = record.number("conn")?;
        for entry in data.as_chunks::<12>().0 {
            let [seconds, nanoseconds, offset] = [0, 4, 8].map(|at| {
                let bytes = [entry[at], entry[at + 1], entry[at + 2], entry[at + 3]];
                u64::from(u32::from_le_bytes(bytes))
            });
            let place = if is_compressed {
                Place::Chunk(chunk_at, offset)
            } else {
                Place::Record(data_at + offset)
            };
            index.add(connection, 1_000_000_000 * seconds + nanoseconds, place)?;
        }
        position += record.head() + record.data_length;
    }
    Ok(position - indexes_at)
}

fn chunk(source: &mut dyn Read) -> Result<Vec<u8>, String> {
    let record = Record::read(source)?;
    let data = record.data(source, op::CHUNK)?;
    let compression = field(&record.header, "compression").unwrap_or_default();
    let compression = String::from_utf8_lossy(compression);
    decompress(&compression, &data, record.number("size")?)
}

fn message(source: &mut dyn Read) -> Result<Vec<u8>, String> {
    Record::read(source)?.data(source, op::MESSAGE)
}
