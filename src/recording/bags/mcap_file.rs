//! `.mcap`, from the index in its summary, or, where it has none, from one pass over its records.
//!
//! Format: <https://mcap.dev/spec>

use std::collections::BTreeMap;
use std::io::Read;

use mcap::records::{ChunkIndex, Record, op};
use mcap::{MAGIC, parse_record};

use super::chunk_file::{ChunkFile, ChunkFormat, decompress, read_bytes, truncated, unreadable};
use super::index::{Connection, Index, Place, Serialization};

pub const FORMAT: ChunkFormat = ChunkFormat { chunk, message };

/// Bytes before the body of a record: its type and its length.
const HEAD: u64 = 9;
/// Bytes of a message before its data.
const MESSAGE_HEADER: usize = 22;
/// Bytes of the footer, with its head and the magic bytes after it.
const FOOTER: u64 = HEAD + 20 + MAGIC.len() as u64;

/// Reads the index of a file.
pub fn index(file: &mut ChunkFile, number: usize) -> Result<Index, String> {
    let magic = read_bytes(file.at(0)?, MAGIC.len() as u64);
    if magic.as_deref() != Ok(MAGIC) {
        return Err("is not an MCAP file".to_owned());
    }
    from_summary(file, Index::of_file(number)).or_else(|problem| {
        tracing::warn!(
            "a bag {problem}; all of it is read for an index, `mcap recover` writes one"
        );
        from_records(file, Index::of_file(number))
    })
}

/// Reads the summary and the message indexes that it names.
fn from_summary(file: &mut ChunkFile, index: Index) -> Result<Index, String> {
    let length = file.length;
    let footer_at = length.checked_sub(FOOTER).ok_or_else(truncated)?;
    let footer = read_bytes(file.at(footer_at)?, FOOTER)?;
    let summary_at = match footer.strip_suffix(MAGIC) {
        Some([op::FOOTER, rest @ ..]) => match parse(op::FOOTER, &rest[HEAD as usize - 1..])? {
            Record::Footer(footer) => footer.summary_start,
            _ => 0,
        },
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
            op::CHUNK_INDEX | op::STATISTICS => match parse(kind, body)? {
                Record::ChunkIndex(chunk) => chunks.push(chunk),
                Record::Statistics(statistics) => count = statistics.message_count,
                _ => {}
            },
            _ => tables.add(kind, body, Place::Row(0))?,
        }
    }
    let index_lengths = chunks.iter().map(|chunk| chunk.message_index_length);
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
            tracing::warn!("a bag ends within a record; its last messages are missing");
            break;
        };
        match kind {
            op::CHUNK => tables.add_records_of(file, position)?,
            op::MESSAGE => {
                let header = read_bytes(&mut file.file, length.min(MESSAGE_HEADER as u64))?;
                tables.add(kind, &header, Place::File(position))?;
            }
            op::SCHEMA | op::CHANNEL => {
                let body = read_bytes(&mut file.file, length)?;
                tables.add(kind, &body, Place::File(position))?;
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
        if !matches!(kind, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
            return Ok(());
        }
        match parse(kind, body)? {
            Record::Schema { header, .. } => {
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let message_type = self.schemas.get(&channel.schema_id);
                let connection = Connection {
                    topic: channel.topic,
                    message_type: message_type.cloned().unwrap_or_default(),
                    serialization: match channel.message_encoding.as_str() {
                        "cdr" => Some(Serialization::Cdr),
                        "ros1" => Some(Serialization::Ros1),
                        _ => None,
                    },
                    is_latched: false,
                };
                self.index.connect(channel.id.into(), connection);
            }
            Record::Message { header, .. } => {
                (self.index).add(header.channel_id.into(), header.log_time, place)?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Adds the messages of a chunk from the message indexes after it.
    fn add_chunk(&mut self, file: &mut ChunkFile, chunk: &ChunkIndex) -> Result<(), String> {
        let start = chunk.chunk_start_offset;
        let end = start.checked_add(chunk.chunk_length);
        let indexes_at = file.at(end.ok_or_else(truncated)?)?;
        let indexes = read_bytes(indexes_at, chunk.message_index_length)?;
        let data_at = chunk.compressed_data_offset().map_err(damaged)?;
        for record in records(&indexes) {
            let (kind, _offset, body) = record?;
            if kind != op::MESSAGE_INDEX {
                continue;
            }
            let Record::MessageIndex(index) = parse(kind, body)? else {
                continue;
            };
            for entry in index.records {
                let place = match chunk.compression.as_str() {
                    "" => Place::File(data_at.saturating_add(entry.offset)),
                    _ => Place::Chunk(start, entry.offset),
                };
                (self.index).add(index.channel_id.into(), entry.log_time, place)?;
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

fn parse(kind: u8, body: &[u8]) -> Result<Record<'_>, String> {
    parse_record(kind, body).map_err(damaged)
}

fn damaged(error: mcap::McapError) -> String {
    format!("has a damaged record: {error}")
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
    match parse(op::CHUNK, &body(source, op::CHUNK)?)? {
        Record::Chunk { header, data } => {
            decompress(&header.compression, &data, header.uncompressed_size)
        }
        _ => Err(truncated()),
    }
}

fn message(source: &mut dyn Read) -> Result<Vec<u8>, String> {
    let mut message = body(source, op::MESSAGE)?;
    if message.len() < MESSAGE_HEADER {
        return Err(truncated());
    }
    message.drain(..MESSAGE_HEADER);
    Ok(message)
}
