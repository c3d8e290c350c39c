//! What several runs need and one of them makes.
//!
//! ```text
//! FOLDER/KEY/...             as its maker left it
//! FOLDER/KEY/finished.json   written last: where it is, the rest is complete
//! FOLDER/KEY.lock            held by the one who makes it; the file system frees it after a crash
//! ```

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, Result};
use serde::{Deserialize, Serialize};

use crate::app::commands::output;

/// Something that is there.
#[derive(Clone, Debug, PartialEq)]
pub struct Shared {
    /// Its folder.
    pub folder: PathBuf,
    /// How long it took to make [s].
    pub seconds: f64,
}

/// Name of the file that says that something is complete.
pub const MARK: &str = "finished.json";

#[derive(Serialize, Deserialize)]
struct Finished {
    seconds: f64,
}

/// What has this key below `folder`; if it is not there, `make` makes it, while others who want it
/// wait.
pub fn get(folder: &Path, key: &str, make: impl FnOnce(&Path) -> Result<()>) -> Result<Shared> {
    let _alone = lock(folder, key)?;
    let own = folder.join(key);
    let mark = own.join(MARK);
    if let Ok(text) = fs::read_to_string(&mark) {
        let Finished { seconds } = serde_json::from_str(&text)
            .with_context(|| format!("{} is damaged; remove it", mark.display()))?;
        return Ok(Shared {
            folder: own,
            seconds,
        });
    }
    fs::create_dir_all(&own).with_context(|| format!("cannot create {}", own.display()))?;
    let started = Instant::now();
    make(&own)?;
    let seconds = started.elapsed().as_secs_f64();
    output::write_json(&mark, &Finished { seconds })?;
    Ok(Shared {
        folder: own,
        seconds,
    })
}

/// Waits until nobody else has `folder/name.lock`, and has it until it is dropped.
pub fn lock(folder: &Path, name: &str) -> Result<File> {
    fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    let path = folder.join(format!("{name}.lock"));
    let locking = || format!("cannot lock {}", path.display());
    let lock = File::create(&path).with_context(locking)?;
    lock.lock().with_context(locking)?;
    Ok(lock)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[test]
    fn what_many_want_at_once_is_made_once() {
        let folder = tempfile::tempdir().unwrap();
        let made = AtomicUsize::new(0);
        let want = || {
            get(folder.path(), "key", |own| {
                made.fetch_add(1, Ordering::Relaxed);
                std::thread::sleep(std::time::Duration::from_millis(30));
                Ok(fs::write(own.join("map"), "all of it")?)
            })
        };
        std::thread::scope(|scope| {
            let all: Vec<_> = (0..4).map(|_| scope.spawn(want)).collect();
            for one in all {
                let shared = one.join().unwrap().unwrap();
                assert_eq!(fs::read(shared.folder.join("map")).unwrap(), b"all of it");
            }
        });
        assert_eq!(made.into_inner(), 1);
    }

    #[test]
    fn what_was_not_finished_is_made_again() {
        let folder = tempfile::tempdir().unwrap();
        let broken = get(folder.path(), "key", |own| {
            fs::write(own.join("map"), "half")?;
            anyhow::bail!("interrupted")
        });
        assert!(broken.is_err());
        let whole = get(folder.path(), "key", |own| {
            Ok(fs::write(own.join("map"), "whole")?)
        });
        assert_eq!(
            fs::read(whole.unwrap().folder.join("map")).unwrap(),
            b"whole"
        );
    }
}
