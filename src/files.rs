//! Atomic writing of files: a file is complete or does not exist.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Temporary files of writes that are under way.
static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Writes a temporary file in the folder of `path`, which is created if necessary, and renames it
/// to `path` once it is complete. On an error or an interruption, `path` is unchanged.
pub fn write_atomically<T, E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> Result<T, E>,
) -> Result<T, E> {
    let (mut temporary, _unfinished) = {
        let mut unfinished = unfinished();
        let temporary = temporary_beside(path)?;
        unfinished.push(temporary.path().to_owned());
        let entry = Unfinished(temporary.path().to_owned());
        (temporary, entry)
    };
    let mut writer = BufWriter::new(temporary.as_file_mut());
    let outcome = write(&mut writer)?;
    writer.flush()?;
    drop(writer);
    temporary.persist(path).map_err(|failed| failed.error)?;
    Ok(outcome)
}

/// Removes the temporary files of all writes that are under way, and lets none finish; for the moment
/// before the process ends.
pub fn abandon_writes() {
    let unfinished = unfinished();
    for path in unfinished.iter() {
        // There is nobody left to whom a failure matters.
        let _ = std::fs::remove_file(path);
    }
    // A write that goes on must not begin another file.
    std::mem::forget(unfinished);
}

fn unfinished() -> MutexGuard<'static, Vec<PathBuf>> {
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Entry of a temporary file among the unfinished ones.
struct Unfinished(PathBuf);

impl Drop for Unfinished {
    fn drop(&mut self) {
        unfinished().retain(|path| *path != self.0);
    }
}

/// Creates a temporary file in the folder of `path`, and that folder if necessary. Its permissions
/// are those that the umask allows, as of other files.
pub fn temporary_beside(path: &Path) -> io::Result<tempfile::NamedTempFile> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    std::fs::create_dir_all(folder)?;
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder
        .prefix(".fpmcl-")
        .suffix(".part")
        .tempfile_in(folder)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_failed_write_leaves_what_was_there_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report.json");
        fs::write(&path, "old").unwrap();
        let outcome: io::Result<()> = write_atomically(&path, |writer| {
            writer.write_all(b"half of the n")?;
            Err(io::Error::other("the disk is full"))
        });
        assert_eq!(outcome.unwrap_err().to_string(), "the disk is full");
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_whole_write_replaces_what_was_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/report.json");
        for text in ["old", "new"] {
            let outcome: io::Result<()> =
                write_atomically(&path, |writer| writer.write_all(text.as_bytes()));
            outcome.unwrap();
        }
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
    }
}
