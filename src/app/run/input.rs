//! Checks of the input files of a command before any work is done.

use std::path::Path;

use anyhow::{Result, ensure};

use crate::app::settings::MapInputConfig;

/// Requires the inputs of a command, each with its configuration key: files, the folder or bag of a recording, and poses or
/// measurements, which may be a folder `oxts`.
pub fn require(inputs: &[(&str, &Path)]) -> Result<()> {
    for &(key, path) in inputs {
        match key {
            "scan_folder" if !is_bag(path) => require_folder(key, path)?,
            // A folder of a bag, and a folder `oxts`.
            "scan_folder" | "pose_file" | "odometry_file" | "imu_file" | "gnss_file"
                if path.is_dir() => {}
            _ => require_file(key, path)?,
        }
    }
    Ok(())
}

/// Whether a path is that of a bag.
pub fn is_bag(path: &Path) -> bool {
    #[cfg(feature = "bags")]
    return crate::recording::bags::is_bag(path);
    #[cfg(not(feature = "bags"))]
    return {
        let _ = path;
        false
    };
}

/// A configuration key with the flag or argument that sets it.
fn with_flag(key: &str) -> String {
    let flag = match key {
        "scan_folder" => "the recording",
        "map_file" => "--map",
        "pose_file" => "--poses, --truth",
        "calib_file" => "--calib",
        "odometry_file" => "--odometry",
        "imu_file" => "--imu",
        "gnss_file" => "--gnss",
        "onto" => "--onto",
        _ => return key.to_owned(),
    };
    format!("{key} ({flag})")
}

/// Requires a file at `path`, the value of the configuration key `key`.
pub fn require_file(key: &str, path: &Path) -> Result<()> {
    ensure!(
        !path.is_dir(),
        "{} is {}, which is a folder; give the path of a file",
        with_flag(key),
        path.display()
    );
    let is_default = key == "map_file" && path == &*MapInputConfig::default().map_file;
    ensure!(
        !is_default || path.exists(),
        "{} does not exist, where a map is by default (map_file); build one, or give it by --map MAP",
        path.display()
    );
    let or_topic = match key {
        "pose_file" | "odometry_file" => ", or a topic of the bag, with its slash, such as /odom",
        _ => "",
    };
    ensure!(
        path.exists(),
        "{} is {}, but there is no such file; give the path of one{or_topic}",
        with_flag(key),
        path.display()
    );
    Ok(())
}

/// Requires a folder at `path`, the value of the configuration key `key`.
pub fn require_folder(key: &str, path: &Path) -> Result<()> {
    ensure!(
        !path.is_file(),
        "{} is {}, which is a file; give the path of a folder, or of a bag (.mcap, .db3, .bag)",
        with_flag(key),
        path.display()
    );
    ensure!(
        path.is_dir(),
        "{} is {}, but there is no such folder; give the path of one",
        with_flag(key),
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

    #[cfg(feature = "bags")]
    #[test]
    fn a_recording_may_be_a_folder_of_scans_a_bag_or_the_folder_of_one() {
        let folder = tempfile::tempdir().unwrap();
        let required = |path: &Path| require(&[("scan_folder", path)]);
        required(folder.path()).unwrap();
        let bag = folder.path().join("drive.mcap");
        required(&bag).unwrap_err();
        std::fs::write(&bag, "").unwrap();
        required(&bag).unwrap();
        std::fs::write(folder.path().join("metadata.yaml"), "").unwrap();
        assert!(is_bag(folder.path()));
        required(folder.path()).unwrap();
    }
}
