//! `.mcap`, from the index in its summary, or, where it has none, from one pass over its records.
//!
//! Format: <https://mcap.dev/spec>. The crate `mcap` reserves as much memory as a damaged length claims, and
//! panics on damaged attachments.

use std::collections::BTreeMap;
use std::io::Read;

use super::chunk_file::{ChunkFile, ChunkFormat, decompress, read_bytes, truncated, unreadable};
use super::fields::Fields;
use super::index::{Connection, Index, Place, Serialization};

pub const FORMAT: ChunkFormat = ChunkFormat { chunk, message };

const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// Types of records.
mod op {
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const MESSAGE_INDEX: u8 = 0x07;
    pub const CHUNK_INDEX: u8 = 0x08;
    pub const STATISTICS: u8 = 0x0b;
    pub const DATA_END: u8 = 0x0f;
}

/// Bytes before the body of a record: its type and its length.
const HEAD: u64 = 9;
/// Bytes of a message before its data.
const MESSAGE_HEADER: usize = 22;
/// Bytes of the head of a chunk's body without the name of its compression.
const CHUNK_HEADER: u64 = 40;
/// Bytes of the footer, with its head and the magic bytes after it.
const FOOTER: u64 = HEAD + 20 + MAGIC.len() as u64;

/// Reads the index of a file.
pub fn index(file: &mut ChunkFile, empty: impl Fn() -> Index) -> Result<Index, String> {
    let magic = read_bytes(file.at(0)?, MAGIC.len() as u64);
    if magic.as_deref() != Ok(MAGIC) {
        return Err("is not an MCAP file".to_owned());
    }
    from_summary(file, empty()).or_else(|problem| {
        tracing::warn!(
            "{} {problem}; all of it is read for an index, `mcap recover` writes one",
            file.path.display()
        );
        from_records(file, empty())
    })
}

/// Reads the summary and the message indexes that it names.
fn from_summary(file: &mut ChunkFile, index: Index) -> Result<Index, String> {
    let length = file.length;
    let footer_at = length.checked_sub(FOOTER).ok_or_else(truncated)?;
    let footer = read_bytes(file.at(footer_at)?, FOOTER)?;
    let summary_at = match footer.strip_suffix(MAGIC) {
        Some([op::FOOTER, rest @ ..]) => fields(&rest[HEAD as usize - 1..])?.u64()?,
        _ => return Err("was not closed by its recorder".to_owned()),
    };
    let summary_length = footer_at.checked_sub(summary_at);
    let summary_length = summary_length.filter(|_length| summary_at > 0);
    let summary_length = summary_length.ok_or("has no summary")?;
    let summary = read_bytes(file.at(summary_at)?, summary_length)?;
    let mut tables = Tables {
        schemas: BTreeMap::new(),
        index,
    };
    let (mut chunks, mut count) = (Vec::new(), 0);
    for record in records(&summary) {
        let (kind, _offset, body) = record?;
        match kind {
            op::CHUNK_INDEX => chunks.push(ChunkIndex::parse(body)?),
            op::STATISTICS => count = fields(body)?.u64()?,
            _ => tables.add(kind, body, Place::Record(0))?,
        }
    }
    let index_lengths = chunks.iter().map(|chunk| chunk.index_length);
    if index_lengths.fold(0, u64::saturating_add) > length {
        return Err("has chunks that overlap".to_owned());
    }
    for chunk in &chunks {
        tables.add_chunk(file, chunk)?;
    }
    if tables.index.count() == 0 || tables.index.count() as u64 != count.max(1) {
        return Err("has an index without all messages".to_owned());
    }
    Ok(tables.index)
}

/// Reads all records; those after an incomplete one are missing.
fn from_records(file: &mut ChunkFile, index: Index) -> Result<Index, String> {
    let mut tables = Tables {
        schemas: BTreeMap::new(),
        index,
    };
    let mut position = MAGIC.len() as u64;
    while position + HEAD <= file.length {
        let (kind, length) = read_head(file.at(position)?)?;
        let body_at = position + HEAD;
        let Some(end) = body_at
            .checked_add(length)
            .filter(|&end| end <= file.length)
        else {
            tracing::warn!(
                "{} ends within a record; its last messages are missing",
                file.path.display()
            );
            break;
        };
        match kind {
            op::CHUNK => tables.add_records_of(file, position)?,
            op::MESSAGE => {
                let header = read_bytes(&mut file.file, length.min(MESSAGE_HEADER as u64))?;
                tables.add(kind, &header, Place::Record(position))?;
            }
            op::SCHEMA | op::CHANNEL => {
                let body = read_bytes(&mut file.file, length)?;
                tables.add(kind, &body, Place::Record(position))?;
            }
            op::DATA_END => break,
            _ => {}
        }
        position = end;
    }
    Ok(tables.index)
}

/// The topics of a file with what is needed to add more.
struct Tables {
    /// Message types.
    schemas: BTreeMap<u16, String>,
    index: Index,
}

impl Tables {
    /// Adds a schema, a channel or a message.
    fn add(&mut self, kind: u8, body: &[u8], place: Place) -> Result<(), String> {
        let mut fields = fields(body)?;
        match kind {
            op::SCHEMA => {
                self.schemas.insert(fields.u16()?, fields.text()?);
            }
            op::CHANNEL => {
                let (number, schema) = (fields.u16()?, fields.u16()?);
                let connection = Connection {
                    topic: fields.text()?,
                    message_type: self.schemas.get(&schema).cloned().unwrap_or_default(),
                    serialization: match fields.text()?.as_str() {
                        "cdr" => Some(Serialization::Cdr),
                        "ros1" => Some(Serialization::Ros1),
                        _ => None,
                    },
                    is_latched: false,
                };
                self.index.connect(number.into(), connection);
            }
            op::MESSAGE => {
                let (channel, _sequence, time_ns) = (fields.u16()?, fields.u32()?, fields.u64()?);
                self.index.add(channel.into(), time_ns, place)?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Adds the messages of a chunk from the message indexes after it.
    fn add_chunk(&mut self, file: &mut ChunkFile, chunk: &ChunkIndex) -> Result<(), String> {
        let end = chunk.position.checked_add(chunk.length);
        let indexes_at = file.at(end.ok_or_else(truncated)?)?;
        let indexes = read_bytes(indexes_at, chunk.index_length)?;
        let data_at = chunk.position + HEAD + CHUNK_HEADER;
        for record in records(&indexes) {
            let (kind, _offset, body) = record?;
            if kind != op::MESSAGE_INDEX {
                continue;
            }
            let mut fields = fields(body)?;
            let (channel, length) = (fields.u16()?, fields.u32()?);
            for _ in 0..length / 16 {
                let (time_ns, offset) = (fields.u64()?, fields.u64()?);
                let place = if chunk.is_compressed {
                    Place::Chunk(chunk.position, offset)
                } else {
                    Place::Record(data_at.saturating_add(offset))
                };
                self.index.add(channel.into(), time_ns, place)?;
            }
        }
        Ok(())
    }

    /// Adds the records of a chunk.
    fn add_records_of(&mut self, file: &mut ChunkFile, position: u64) -> Result<(), String> {
        let data = chunk(file.at(position)?)?;
        for record in records(&data) {
            let (kind, offset, body) = record?;
            self.add(kind, body, Place::Chunk(position, offset))?;
        }
        Ok(())
    }
}

/// Where a chunk is.
struct ChunkIndex {
    position: u64,
    length: u64,
    /// Size of the message indexes after it [bytes].
    index_length: u64,
    is_compressed: bool,
}

impl ChunkIndex {
    fn parse(body: &[u8]) -> Result<Self, String> {
        let mut fields = fields(body)?;
        let _times = (fields.u64()?, fields.u64()?);
        let (position, length) = (fields.u64()?, fields.u64()?);
        let offsets = fields.u32()?;
        fields.bytes(offsets as usize)?;
        Ok(Self {
            position,
            length,
            index_length: fields.u64()?,
            is_compressed: !fields.text()?.is_empty(),
        })
    }
}

/// The records in memory: type, position and body.
fn records(bytes: &[u8]) -> impl Iterator<Item = Result<(u8, u64, &[u8]), String>> {
    let mut rest = bytes;
    std::iter::from_fn(move || {
        if rest.is_empty() {
            return None;
        }
        let offset = (bytes.len() - rest.len()) as u64;
        let head = read_head(&mut rest);
        Some(head.and_then(|(kind, length)| {
            let length = usize::try_from(length).ok();
            let split = length.and_then(|length| rest.split_at_checked(length));
            let (body, after) = split.ok_or_else(truncated)?;
            rest = after;
            Ok((kind, offset, body))
        }))
    })
    .scan(false, |has_failed, record| {
        // There is nothing to be read after a wrong length.
        (!std::mem::replace(has_failed, record.is_err())).then_some(record)
    })
}

/// Type and length of a record.
fn read_head(source: &mut dyn Read) -> Result<(u8, u64), String> {
    let mut head = [0; HEAD as usize];
    source.read_exact(&mut head).map_err(unreadable)?;
    let [kind, length @ ..] = head;
    Ok((kind, u64::from_le_bytes(length)))
}

/// The fields of a record: little-endian, without padding.
fn fields(body: &[u8]) -> Result<Fields<'_>, String> {
    Fields::new(body, Serialization::Ros1)
}

/// Reads the body of a record of a type.
fn body(source: &mut dyn Read, expected: u8) -> Result<Vec<u8>, String> {
    let (kind, length) = read_head(source)?;
    if kind != expected {
        return Err(truncated());
    }
    read_bytes(source, length)
}

fn chunk(source: &mut dyn Read) -> Result<Vec<u8>, String> {
    let body = body(source, op::CHUNK)?;
    let mut fields = fields(&body)?;
    let (_start, _end, size, checksum) =
        (fields.u64()?, fields.u64()?, fields.u64()?, fields.u32()?);
    let (compression, length) = (fields.text()?, fields.u64()?);
    let length = usize::try_from(length).map_err(|_large| truncated())?;
    let data = decompress(&compression, fields.bytes(length)?, size)?;
    // 0: the recorder wrote none.
    if checksum != 0 && checksum != crc32fast::hash(&data) {
        return Err("has a damaged chunk: its checksum differs".to_owned());
    }
    Ok(data)
}

fn message(source: &mut dyn Read) -> Result<Vec<u8>, String> {
    let mut message = body(source, op::MESSAGE)?;
    if message.len() < MESSAGE_HEADER {
        return Err(truncated());
    }
    message.drain(..MESSAGE_HEADER);
    Ok(message)
}
