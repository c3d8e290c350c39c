//! A file of a bag, which is read from several threads.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use ruzstd::decoding::StreamingDecoder;
use tempfile::TempPath;

use super::chunk_file::{ChunkFile, decompress_zstd};
use super::database::Database;
use super::index::{Index, Message, Place};
use super::{mcap_file, ros1_file};

/// Extensions of bags.
pub const EXTENSIONS: [&str; 3] = ["mcap", "bag", "db3"];

/// Largest ratio of decompression of a whole file.
const LARGEST_RATIO: u64 = 1000;

/// The first bytes of a frame of zstd, which no message has.
const ZSTD: &[u8] = &[0x28, 0xb5, 0x2f, 0xfd];

/// A file of a bag.
pub struct BagFile {
    pub path: PathBuf,
    /// The decompressed file of one that is compressed whole.
    decompressed: Option<TempPath>,
    /// Readers that no thread uses; each has a decompressed chunk.
    readers: Mutex<Vec<Reader>>,
}

enum Reader {
    Mcap(ChunkFile),
    Ros1(ChunkFile),
    Database(Database),
}

impl Reader {
    fn open(path: &Path, format: &str) -> Result<Self, String> {
        match format {
            "mcap" => ChunkFile::open(path).map(Self::Mcap),
            "bag" => ChunkFile::open(path).map(Self::Ros1),
            "db3" => Database::open(path).map(Self::Database),
            other => Err(format!(
                "is not a bag: `{other}` is none of {}",
                EXTENSIONS.join(", ")
            )),
        }
    }

    fn index(&mut self, empty: impl Fn() -> Index) -> Result<Index, String> {
        match self {
            Self::Mcap(file) => mcap_file::index(file, empty),
            Self::Ros1(file) => ros1_file::index(file, empty),
            Self::Database(database) => database.index(empty()),
        }
    }

    fn message(&mut self, place: Place) -> Result<Vec<u8>, String> {
        match (self, place) {
            (Self::Mcap(file), place) => file.message(&mcap_file::FORMAT, place),
            (Self::Ros1(file), place) => file.message(&ros1_file::FORMAT, place),
            (Self::Database(database), Place::Record(row)) => database.message(row.cast_signed()),
            (Self::Database(_), _) => Err("has no such row".to_owned()),
        }
    }
}

impl BagFile {
    /// Opens a file and reads its index into an empty one. One that is compressed whole is decompressed into the folder of
    /// temporary files.
    pub fn open(path: &Path, empty: impl Fn() -> Index) -> Result<(Self, Index), String> {
        let decompressed = if is_compressed(path) {
            Some(decompress_file(path)?)
        } else {
            None
        };
        let file = Self {
            path: path.to_owned(),
            decompressed,
            readers: Mutex::default(),
        };
        let mut reader = file.reader()?;
        let index = reader.index(empty)?;
        file.readers().push(reader);
        Ok((file, index))
    }

    fn reader(&self) -> Result<Reader, String> {
        let unused = self.readers().pop();
        unused.map_or_else(
            || {
                let path = self.decompressed.as_deref().unwrap_or(&self.path);
                Reader::open(path, &format_of(&self.path))
            },
            Ok,
        )
    }

    fn readers(&self) -> MutexGuard<'_, Vec<Reader>> {
        self.readers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads a message.
    pub fn read(&self, message: &Message) -> Result<Vec<u8>, String> {
        let mut reader = self.reader()?;
        let bytes = reader.message(message.place());
        self.readers().push(reader);
        let bytes = bytes?;
        if bytes.starts_with(ZSTD) {
            return decompress_zstd(&bytes)
                .map_err(|error| format!("cannot be decompressed: {error}"));
        }
        Ok(bytes)
    }
}

/// The extension of a bag, without that of compression.
pub fn format_of(path: &Path) -> String {
    let path = if is_compressed(path) {
        &path.with_extension("")
    } else {
        path
    };
    let extension = path.extension().unwrap_or_default();
    extension.to_string_lossy().to_ascii_lowercase()
}

fn is_compressed(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension == "zstd")
}

fn decompress_file(path: &Path) -> Result<TempPath, String> {
    let problem = |error: io::Error| format!("cannot be decompressed: {error}");
    let file = File::open(path).map_err(problem)?;
    let length = file.metadata().map_err(problem)?.len();
    let decoder = StreamingDecoder::new(io::BufReader::new(file));
    let decoder = decoder.map_err(|error| problem(io::Error::other(error)))?;
    let mut decompressed = tempfile::NamedTempFile::new().map_err(problem)?;
    let most = length.saturating_mul(LARGEST_RATIO);
    io::copy(&mut decoder.take(most), &mut decompressed).map_err(problem)?;
    Ok(decompressed.into_temp_path())
}

/// The files of a bag: those that `metadata.yaml` in a folder names, or the file itself.
pub fn paths(path: &Path) -> Result<Vec<PathBuf>, String> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let metadata = fs::read_to_string(path.join("metadata.yaml"));
    let metadata = metadata.map_err(|error| {
        format!("has no readable metadata.yaml ({error}); `ros2 bag reindex` writes one")
    })?;
    let mut lines = metadata.lines().map(str::trim);
    let compression = lines
        .clone()
        .find_map(|line| line.strip_prefix("compression_format:"));
    let compression = unquoted(compression.unwrap_or_default());
    if !matches!(compression, "" | "zstd") {
        return Err(format!(
            "is compressed by `{compression}`, not by zstd; convert it with `ros2 bag convert`"
        ));
    }
    let rest_of_line = lines.find_map(|line| line.strip_prefix("relative_file_paths:"));
    let in_brackets =
        rest_of_line.and_then(|rest| rest.trim().strip_prefix('[')?.strip_suffix(']'));
    let names: Vec<&str> = match in_brackets {
        Some(names) => names.split(',').map(unquoted).collect(),
        None => lines
            .map_while(|line| line.strip_prefix("- "))
            .map(unquoted)
            .collect(),
    };
    if names.is_empty() {
        return Err(
            "has a metadata.yaml without relative_file_paths; `ros2 bag reindex` writes it"
                .to_owned(),
        );
    }
    let file = |name| {
        // The name of old bags begins with that of the folder.
        let name = Path::new(name);
        let inside = path.join(name);
        let sibling = name.file_name().map(|name| path.join(name));
        sibling.filter(|_name| !inside.exists()).unwrap_or(inside)
    };
    Ok(names.into_iter().map(file).collect())
}

/// A scalar of YAML without its quotes.
fn unquoted(scalar: &str) -> &str {
    scalar.trim().trim_matches(['"', '\''])
}
