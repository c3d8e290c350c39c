//! Locks that a crash releases.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};

use crate::files::{UnlockedOnDrop, require_own};

/// A locked file.
pub struct Lock {
    file: UnlockedOnDrop,
    path: PathBuf,
}

impl Lock {
    /// Waits until the file can be locked by this process alone.
    pub fn wait(path: &Path) -> Result<Self> {
        let lock = Self::open(path)?;
        lock.file.0.lock().with_context(|| cannot_lock(path))?;
        Ok(lock)
    }

    /// Locks the file, with others who share it or alone; `None` if others hold it.
    pub fn now(path: &Path, is_shared: bool) -> Result<Option<Self>> {
        let lock = Self::open(path)?;
        let locked = if is_shared {
            lock.file.0.try_lock_shared()
        } else {
            lock.file.0.try_lock()
        };
        match locked {
            // Who has just ended removes the file, and another one may have made its own.
            Ok(()) => Ok(Some(lock).filter(Self::is_in_place)),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(error).with_context(|| cannot_lock(path)),
        }
    }

    fn open(path: &Path) -> Result<Self> {
        let open = || {
            require_own(path, None)?;
            let mut options = File::options();
            let file = options
                .write(true)
                .create(true)
                .truncate(false)
                .open(path)?;
            // It may have been replaced meanwhile.
            require_own(path, None)?;
            io::Result::Ok(file)
        };
        Ok(Self {
            file: UnlockedOnDrop(open().with_context(|| cannot_lock(path))?),
            path: path.to_owned(),
        })
    }

    /// Whether the file is still the one of its path.
    pub fn is_in_place(&self) -> bool {
        is_at(&self.file.0, &self.path)
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
        let of_file = file.metadata().map(place);
        let of_path = fs::symlink_metadata(path).map(place);
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
        let copy = lock.file.0.try_clone().unwrap();
        drop(lock);
        let [first, second] = [true, true].map(|is_shared| Lock::now(&path, is_shared).unwrap());
        assert!(first.is_some() && second.is_some());
        drop(copy);
    }

    #[cfg(unix)]
    #[test]
    fn a_file_of_the_user_is_no_lock_and_a_link_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let [own, link] = ["own", "lock"].map(|name| folder.path().join(name));
        fs::write(&own, "precious").unwrap();
        std::os::unix::fs::symlink(&own, &link).unwrap();
        for path in [&own, &link] {
            assert!(Lock::now(path, false).is_err() && Lock::wait(path).is_err());
        }
        assert_eq!(fs::read(&own).unwrap(), b"precious");
        let missing = folder.path().join("missing");
        fs::remove_file(&link).unwrap();
        std::os::unix::fs::symlink(&missing, &link).unwrap();
        assert!(Lock::now(&link, false).is_err() && !missing.exists());
    }
}
