//! Files that are either whole or not there.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// Writes a file under a temporary name in the same folder and renames it to `path` when it is
/// whole, so that neither an error nor an interruption costs a file that was there before.
///
/// The folder is made where it is missing. Where anything fails, the temporary file is removed.
pub fn write_atomically<T, E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> Result<T, E>,
) -> Result<T, E> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    std::fs::create_dir_all(folder)?;
    let mut temporary = new_temporary(folder)?;
    let mut writer = BufWriter::new(temporary.as_file_mut());
    let outcome = write(&mut writer)?;
    writer.flush()?;
    drop(writer);
    temporary.persist(path).map_err(|failed| failed.error)?;
    Ok(outcome)
}

/// A temporary file that others may read once it is whole, as far as the user's umask lets them.
fn new_temporary(folder: &Path) -> io::Result<tempfile::NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".fpmcl-").suffix(".part");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
        builder.tempfile_in(folder)
    }
    #[cfg(not(unix))]
    builder.tempfile_in(folder)
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
