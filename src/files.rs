//! Atomic writing of files: a file is complete or does not exist.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// Writes a temporary file in the folder of `path`, which is created if necessary, and renames it
/// to `path` once it is complete. On an error or an interruption, `path` is unchanged.
pub fn write_atomically<T, E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> Result<T, E>,
) -> Result<T, E> {
    let mut temporary = temporary_beside(path)?;
    let mut writer = BufWriter::new(temporary.as_file_mut());
    let outcome = write(&mut writer)?;
    writer.flush()?;
    drop(writer);
    temporary.persist(path).map_err(|failed| failed.error)?;
    Ok(outcome)
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
