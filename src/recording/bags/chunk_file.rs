//! Files of records, some of them chunks: compressed sequences of records.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use bzip2::read::BzDecoder;
use lz4_flex::frame::FrameDecoder;
use ruzstd::decoding::StreamingDecoder;

use super::index::Place;

/// Largest record, chunk and message [bytes].
pub const LARGEST: u64 = 1 << 28;

/// A format of such files.
pub struct ChunkFormat {
    /// Reads the data of a chunk from the start of its record.
    pub chunk: fn(&mut dyn Read) -> Result<Vec<u8>, String>,
    /// Reads a message from the start of its record.
    pub message: fn(&mut dyn Read) -> Result<Vec<u8>, String>,
}

/// An open file with the chunk that was read last.
pub struct ChunkFile {
    pub path: PathBuf,
    pub file: BufReader<File>,
    pub length: u64,
    last_chunk: Option<(u64, Vec<u8>)>,
}

impl ChunkFile {
    pub fn open(path: &Path) -> Result<Self, String> {
        let mut file = File::open(path).map_err(unreadable)?;
        let length = file.seek(SeekFrom::End(0)).map_err(unreadable)?;
        Ok(Self {
            path: path.to_owned(),
            file: BufReader::new(file),
            length,
            last_chunk: None,
        })
    }

    /// The file from a position, which must be in it.
    pub fn at(&mut self, position: u64) -> Result<&mut BufReader<File>, String> {
        if position > self.length {
            return Err(truncated());
        }
        self.file
            .seek(SeekFrom::Start(position))
            .map_err(unreadable)?;
        Ok(&mut self.file)
    }

    /// Reads a message.
    pub fn message(&mut self, format: &ChunkFormat, place: Place) -> Result<Vec<u8>, String> {
        let (position, offset) = match place {
            Place::Chunk(position, offset) => (position, offset as usize),
            Place::Record(position) => return (format.message)(self.at(position)?),
        };
        let chunk = match self.last_chunk.take() {
            Some((last, chunk)) if last == position => chunk,
            _ => (format.chunk)(self.at(position)?)?,
        };
        let record = chunk.get(offset..).ok_or_else(truncated);
        let message = record.and_then(|mut record| (format.message)(&mut record));
        self.last_chunk = Some((position, chunk));
        message
    }
}

pub fn unreadable(error: std::io::Error) -> String {
    format!("cannot be read: {error}")
}

pub fn truncated() -> String {
    "is damaged: a record is incomplete; copy it again".to_owned()
}

/// Reads a number of bytes.
pub fn read_bytes(source: &mut dyn Read, length: u64) -> Result<Vec<u8>, String> {
    if length > LARGEST {
        return Err(format!(
            "is damaged: a record has {length} bytes, more than {LARGEST}; copy it again"
        ));
    }
    let mut bytes = Vec::new();
    (source.take(length).read_to_end(&mut bytes)).map_err(unreadable)?;
    if bytes.len() as u64 != length {
        return Err(truncated());
    }
    Ok(bytes)
}

/// Reads a little-endian u32.
pub fn read_u32(source: &mut dyn Read) -> Result<u32, String> {
    let mut bytes = [0; 4];
    source.read_exact(&mut bytes).map_err(|_end| truncated())?;
    Ok(u32::from_le_bytes(bytes))
}

/// Decompresses a chunk of `size` bytes.
pub fn decompress(compression: &str, data: &[u8], size: u64) -> Result<Vec<u8>, String> {
    let damaged = |error: String| format!("has a damaged chunk ({compression}): {error}");
    let chunk = match compression {
        "" | "none" => return Ok(data.to_vec()),
        "zstd" => decompress_zstd(data).map_err(damaged)?,
        "lz4" => read_all(FrameDecoder::new(data)).map_err(damaged)?,
        "bz2" => read_all(BzDecoder::new(data)).map_err(damaged)?,
        other => {
            return Err(format!(
                "has chunks compressed by `{other}`, not by zstd, lz4 or bz2; record or convert it with one of these"
            ));
        }
    };
    if chunk.len() as u64 != size {
        return Err(damaged(format!("{} bytes, not {size}", chunk.len())));
    }
    Ok(chunk)
}

/// Decompresses a frame of zstd.
pub fn decompress_zstd(data: &[u8]) -> Result<Vec<u8>, String> {
    read_all(StreamingDecoder::new(data).map_err(|error| error.to_string())?)
}

fn read_all(decoder: impl Read) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    let read = decoder.take(LARGEST + 1).read_to_end(&mut bytes);
    read.map_err(|error| error.to_string())?;
    if bytes.len() as u64 > LARGEST {
        return Err(format!("more than {LARGEST} bytes"));
    }
    Ok(bytes)
}
