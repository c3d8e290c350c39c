//! Artefacts: outputs that are kept and used again where they are complete and of the same inputs.
//!
//! | question | answer |
//! |---|---|
//! | did this program write it | a line in the [`Claims`] of its folder |
//! | of which inputs is it | a key: a [`hash`] of texts, files and scans, and the executable ([`version`](super::version)) |
//! | is it finished | its claim, or a mark in a folder that the key names; written last |
//! | is it being made | a [`Lock`], which the operating system releases after a crash |
//!
//! ```text
//! FOLDER/.fpmcl              the claims of a folder of outputs
//! FOLDER/KEY/...             a result of [`get_or_create`]
//! FOLDER/KEY/finished.json   its mark
//! FOLDER/KEY.lock            held while it is made
//! ```

mod claims;
pub mod hash;
mod lock;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, Result};
use serde::{Deserialize, Serialize};

pub use self::claims::{CLAIMS_FILE, CONFIGURATION_FILE, Claims, Outputs, PLY};
pub use self::lock::Lock;
use crate::app::run::output;

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
}
