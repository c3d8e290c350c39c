//! Output of commands: files, written atomically, and standard output.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use anyhow::{Context as _, bail};
use serde::Serialize;

use crate::app::config::to_yaml;
use crate::files::{temporary_beside, write_atomically};

/// Checks before any work that `path` can be written: an existing file needs `--force`, and its
/// folder is created and must accept new files. `key` is the configuration key of the file.
pub fn prepare(path: &Path, key: &str, force: bool) -> anyhow::Result<()> {
    if path.is_dir() {
        bail!(
            "{} is a folder; give {key} the name of a file",
            path.display()
        );
    }
    if path.exists() && !force {
        bail!(
            "{} exists; add --force to replace it, or choose another {key}",
            path.display()
        );
    }
    temporary_beside(path).map(drop).with_context(|| {
        format!(
            "{key} is {}, and nothing can be written there; choose another {key}",
            path.display()
        )
    })
}

/// Writes a file atomically.
pub fn write_file<E: Into<anyhow::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> Result<(), E>,
) -> anyhow::Result<()> {
    write_atomically(path, |file| write(file).map_err(Into::into))
        .with_context(|| format!("cannot write {}", path.display()))
}

/// Writes a text file atomically.
pub fn write_text(path: &Path, text: &str) -> anyhow::Result<()> {
    write_file(path, |file| file.write_all(text.as_bytes()))
}

/// Writes a report as JSON atomically.
pub fn write_json(path: &Path, report: &impl Serialize) -> anyhow::Result<()> {
    let json = serde_json::to_string_pretty(report)
        .with_context(|| format!("cannot serialize {}", path.display()))?;
    write_text(path, &(json + "\n"))
}

/// Writes the effective configuration atomically; loading it gives an equal one.
pub fn write_yaml(path: &Path, config: &impl Serialize) -> anyhow::Result<()> {
    write_text(path, &to_yaml(config)?)
}

/// Formats rows of a name and a value for standard output.
pub fn rows(rows: &[(&str, String)]) -> String {
    rows.iter()
        .map(|(name, value)| format!("{name:<24} {value:>14}\n"))
        .collect()
}

/// Creates a folder and those above it.
pub fn create_folder(folder: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))
}

/// Removes a file, if it exists.
pub fn remove_if_exists(path: &Path) -> anyhow::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Prints to standard output; a closed pipe is not an error.
pub fn print(text: &str) -> anyhow::Result<()> {
    let mut stdout = io::stdout().lock();
    match stdout
        .write_all(text.as_bytes())
        .and_then(|()| stdout.flush())
    {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(error).context("writing to standard output")
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_existing_file_needs_force() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        prepare(&path, "mesh_file", false).unwrap();
        fs::write(&path, "kept").unwrap();
        let message = prepare(&path, "mesh_file", false).unwrap_err().to_string();
        assert!(message.contains("map.ply exists; add --force"), "{message}");
        prepare(&path, "mesh_file", true).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"kept");
    }

    #[test]
    fn an_impossible_folder_is_an_error_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        let message = prepare(&file.join("map.ply"), "mesh_file", false)
            .unwrap_err()
            .to_string();
        assert!(message.contains("choose another mesh_file"), "{message}");
    }
}
