//! Files that a command needs, asked for by their keys before any work is done.

use std::path::Path;

use anyhow::{Result, ensure};

/// Makes sure that there is a file at `path`, which the configuration key `key` names.
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

/// Makes sure that there is a folder at `path`, which the configuration key `key` names.
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
    fn what_is_missing_or_of_the_wrong_kind_is_told_with_its_key() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("poses.txt");
        std::fs::write(&file, "").unwrap();
        require_file("pose_file", &file).unwrap();
        require_folder("scan_folder", folder.path()).unwrap();
        let missing = folder.path().join("nowhere");
        for told in [
            require_file("a_key", &missing),
            require_file("a_key", folder.path()),
            require_folder("a_key", &missing),
            require_folder("a_key", &file),
        ] {
            let message = told.unwrap_err().to_string();
            assert!(message.starts_with("a_key is "), "{message}");
            assert!(message.contains("; give the path of"), "{message}");
        }
    }
}
