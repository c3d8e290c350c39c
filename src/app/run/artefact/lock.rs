//! Locks that a crash releases.

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};

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

#[cfg(test)]
mod tests {
    use super::*;

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
