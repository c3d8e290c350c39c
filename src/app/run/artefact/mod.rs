//! Artefacts: results that are kept and used again where they are complete and of the same inputs.
//!
//! | question | answer |
//! |---|---|
//! | of which inputs is it | a hash of texts, files and scans, and of the executable ([`version`](super::version)) |
//! | is it finished | a mark, which is written last, with that hash or in a folder of its name |
//! | is it being made | a [`Lock`], which the operating system releases after a crash |
//!
//! ```text
//! FOLDER/KEY/...             a result of [`get_or_create`]
//! FOLDER/KEY/finished.json   its mark
//! FOLDER/KEY.lock            held while it is made
//! ```

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, Result};
use blake3::Hash;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::app::run::output;
use crate::lidar::Scan;
use crate::recording::{Frame, RecordingError};

/// A complete result.
#[derive(Clone, Debug, PartialEq)]
pub struct SharedResult {
    /// Folder of the result.
    pub folder: PathBuf,
    /// Wall time of its creation [s].
    pub seconds: f64,
}

/// Name of the file that marks a complete result.
pub const FINISHED_FILE: &str = "finished.json";

#[derive(Serialize, Deserialize)]
struct Finished {
    seconds: f64,
}

/// Returns the result with a key below `folder`. Creates it if it is missing, while other processes
/// that need it wait.
pub fn get_or_create(
    folder: &Path,
    key: &str,
    create: impl FnOnce(&Path) -> Result<()>,
) -> Result<SharedResult> {
    output::create_folder(folder)?;
    let _lock = Lock::wait(&folder.join(format!("{key}.lock")))?;
    let folder = folder.join(key);
    let mark = folder.join(FINISHED_FILE);
    let seconds = if let Ok(text) = fs::read_to_string(&mark) {
        let finished: Finished = serde_json::from_str(&text)
            .with_context(|| format!("{} is damaged; remove it", mark.display()))?;
        finished.seconds
    } else {
        output::create_folder(&folder)?;
        let start = Instant::now();
        create(&folder)?;
        let seconds = start.elapsed().as_secs_f64();
        output::write_json(&mark, &Finished { seconds })?;
        seconds
    };
    Ok(SharedResult { folder, seconds })
}

/// A locked file.
pub struct Lock {
    file: File,
    path: PathBuf,
}

impl Drop for Lock {
    fn drop(&mut self) {
        // Closing the file is not enough: a process that is being started holds a copy of it for a moment.
        let _ = self.file.unlock();
    }
}

impl Lock {
    /// Waits until the file can be locked by this process alone.
    pub fn wait(path: &Path) -> Result<Self> {
        let lock = Self::open(path)?;
        lock.file.lock().with_context(|| cannot_lock(path))?;
        Ok(lock)
    }

    /// Locks the file, with others who share it or alone; `None` if others hold it.
    pub fn now(path: &Path, is_shared: bool) -> Result<Option<Self>> {
        let lock = Self::open(path)?;
        let locked = if is_shared {
            lock.file.try_lock_shared()
        } else {
            lock.file.try_lock()
        };
        match locked {
            // Who has just ended removes the file, and another one may have made its own.
            Ok(()) => Ok(Some(lock).filter(Self::is_in_place)),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(error).with_context(|| cannot_lock(path)),
        }
    }

    fn open(path: &Path) -> Result<Self> {
        let file = File::create(path).with_context(|| cannot_lock(path))?;
        Ok(Self {
            file,
            path: path.to_owned(),
        })
    }

    /// Whether the file is still the one of its path.
    pub fn is_in_place(&self) -> bool {
        is_at(&self.file, &self.path)
    }
}

fn cannot_lock(path: &Path) -> String {
    format!("cannot lock {}", path.display())
}

/// Whether an open file is the one of a path.
fn is_at(file: &File, path: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt as _;
        let place = |metadata: fs::Metadata| (metadata.dev(), metadata.ino());
        let (of_file, of_path) = (file.metadata().map(place), fs::metadata(path).map(place));
        matches!((of_file, of_path), (Ok(a), Ok(b)) if a == b)
    }
    #[cfg(not(unix))]
    {
        let _ = file;
        path.exists()
    }
}

/// Hash of a file, or of those in a folder, in the order of their names.
pub fn hash_of_file(path: &Path) -> Result<String> {
    let context = || format!("cannot read {}", path.display());
    if path.is_dir() {
        let entries = fs::read_dir(path).with_context(context)?;
        let mut paths: Vec<PathBuf> = entries
            .map(|entry| Ok(entry.with_context(context)?.path()))
            .collect::<Result<_>>()?;
        paths.sort();
        let hashes: Result<Vec<String>> = paths.iter().map(|path| hash_of_file(path)).collect();
        return Ok(hash_of_texts(&hashes?));
    }
    let mut hasher = blake3::Hasher::new();
    let file = File::open(path).with_context(context)?;
    hasher.update_reader(file).with_context(context)?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// Hash of a list of texts, 32 hexadecimal digits.
pub fn hash_of_texts(parts: &[impl AsRef<str>]) -> String {
    let mut hasher = blake3::Hasher::new();
    for part in parts {
        let part = part.as_ref();
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part.as_bytes());
    }
    hasher.finalize().to_hex()[..32].to_owned()
}

/// Hash of the scans of frames, in order.
pub fn hash_of_scans(frames: &[Frame]) -> Result<String, RecordingError> {
    let hash = |frame: &Frame| Ok(hash_of_scan(&frame.read()?));
    let hashes: Vec<Hash> = frames
        .par_iter()
        .map(hash)
        .collect::<Result<_, RecordingError>>()?;
    Ok(joint_hash(hashes))
}

/// Hash of the hashes of scans, in order.
pub fn joint_hash(hashes: impl IntoIterator<Item = Hash>) -> String {
    let mut joint = blake3::Hasher::new();
    for hash in hashes {
        joint.update(hash.as_bytes());
    }
    joint.finalize().to_hex().to_string()
}

/// Hash of the points of a scan with their times.
pub fn hash_of_scan(scan: &Scan) -> Hash {
    let numbers = scan.points.iter().flat_map(|point| point.to_array());
    let numbers = numbers.chain(scan.times_s.iter().copied());
    let bytes: Vec<u8> = numbers.flat_map(f32::to_le_bytes).collect();
    blake3::hash(&bytes)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[test]
    fn simultaneous_requests_create_the_result_once() {
        let folder = tempfile::tempdir().unwrap();
        let created = AtomicUsize::new(0);
        let request = || {
            get_or_create(folder.path(), "key", |folder| {
                created.fetch_add(1, Ordering::Relaxed);
                std::thread::sleep(std::time::Duration::from_millis(30));
                Ok(fs::write(folder.join("map"), "complete")?)
            })
        };
        std::thread::scope(|scope| {
            let all: Vec<_> = (0..4).map(|_| scope.spawn(request)).collect();
            for one in all {
                let shared = one.join().unwrap().unwrap();
                assert_eq!(fs::read(shared.folder.join("map")).unwrap(), b"complete");
            }
        });
        assert_eq!(created.into_inner(), 1);
    }

    #[test]
    fn an_incomplete_result_is_created_again() {
        let folder = tempfile::tempdir().unwrap();
        let broken = get_or_create(folder.path(), "key", |folder| {
            fs::write(folder.join("map"), "half")?;
            anyhow::bail!("interrupted")
        });
        assert!(broken.is_err());
        let whole = get_or_create(folder.path(), "key", |folder| {
            Ok(fs::write(folder.join("map"), "whole")?)
        });
        assert_eq!(
            fs::read(whole.unwrap().folder.join("map")).unwrap(),
            b"whole"
        );
    }

    #[test]
    fn what_has_ended_is_not_locked_by_copies_of_its_lock() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        let lock = Lock::now(&path, false).unwrap().unwrap();
        assert!(Lock::now(&path, true).unwrap().is_none());
        // As of a process that another thread is just starting.
        let copy = lock.file.try_clone().unwrap();
        drop(lock);
        let [first, second] = [true, true].map(|is_shared| Lock::now(&path, is_shared).unwrap());
        assert!(first.is_some() && second.is_some());
        drop(copy);
    }
}
