//! Checks of the input files of a command before any work is done.

use std::path::Path;

use anyhow::{Result, ensure};

/// Requires a file at `path`, the value of the configuration key `key`.
pub fn require_file(key: &str, path: &Path) -> Result<()> {
    ensure!(
        !path.is_dir(),
        "{key} is {}, which is a folder; give the path of a file",
        path.display()
    );
    ensure!(
        path.exists(),
        "{key} is {}, but there is no such file; give the path of one",
        path.display()
    );
    Ok(())
}

/// Requires a file at `path`, if there is one; `key` is the configuration key.
pub fn require_optional_file(key: &str, path: Option<&Path>) -> Result<()> {
    path.map_or(Ok(()), |path| require_file(key, path))
}

/// Requires a folder at `path`, the value of the configuration key `key`.
pub fn require_folder(key: &str, path: &Path) -> Result<()> {
    ensure!(
        path.is_dir(),
        "{key} is {}, but there is no such folder; give the path of one",
        path.display()
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_about_missing_and_wrong_paths_name_the_key() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("poses.txt");
        std::fs::write(&file, "").unwrap();
        require_file("pose_file", &file).unwrap();
        require_folder("scan_folder", folder.path()).unwrap();
        let missing = folder.path().join("nowhere");
        for result in [
            require_file("a_key", &missing),
            require_file("a_key", folder.path()),
            require_folder("a_key", &missing),
            require_folder("a_key", &file),
        ] {
            let message = result.unwrap_err().to_string();
            assert!(message.starts_with("a_key is "), "{message}");
            assert!(message.contains("; give the path of"), "{message}");
        }
    }
}
