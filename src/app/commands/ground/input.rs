//! Arguments, configuration and input files of `ground`.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use clap::Args;

use crate::app::run::arguments::{is_config, require_input, settings_parser};
use crate::app::run::input::is_bag;
use crate::app::run::input::require_folder;
use crate::app::run::{MachineArgs, memory};
use crate::app::settings::{self, GroundCommandConfig};
use crate::evaluation::LabelledPoints;
use crate::file_path::FilePath;
use crate::recording::velodyne::label_file;
use crate::recording::{Frame, PointFormat, Recording, ScanSource, scan_files, velodyne};

/// Arguments of `ground`.
#[derive(Clone, Debug, Args)]
pub struct GroundArgs {
    /// Scan (.bin, .pcd, .ply, .npy), recording (its folder, the folder of its scans, or a bag), or configuration
    /// (.yml); by default the configuration's scan_folder.
    pub input: Option<FilePath>,

    /// Explain the decision at the point nearest to X Y Z in the lidar frame [m]; needs one scan.
    #[arg(
        long,
        value_names = ["X", "Y", "Z"],
        num_args = 3,
        allow_negative_numbers = true,
        requires = "input"
    )]
    pub explain: Option<Vec<f32>>,

    /// Compare the methods on simulated slopes, crests, kerbs and drives with exact labels.
    #[arg(long, conflicts_with = "explain")]
    pub simulated: bool,

    /// YAML file; by default config/ground.yml or, without one, built-in values.
    #[arg(long, value_name = "FILE")]
    pub config: Option<FilePath>,

    /// Override a key, such as ground_method=pca; repeatable.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = settings_parser())]
    pub settings: Vec<(String, String)>,

    /// Replace existing output; sets the key `force`.
    #[arg(long)]
    pub force: bool,

    /// Renderer and threads.
    #[command(flatten)]
    pub machine: MachineArgs,
}

/// A scan and its labels.
#[derive(Clone, Debug)]
pub struct LabelledScan {
    /// Path relative to the folder of the scans, without extension; of a bag, the number of the scan.
    pub name: PathBuf,
    frame: Frame,
    /// The file of the classes, if there is one.
    pub label_path: Option<PathBuf>,
}

/// Loads the configuration with the overrides of the command line; returns it with the path of the
/// scan or of the recording.
pub fn load(args: &GroundArgs) -> Result<(GroundCommandConfig, PathBuf)> {
    let mut settings = args.settings.clone();
    if args.force {
        settings.push(("force".to_owned(), "true".to_owned()));
    }
    let argument = args.input.as_deref();
    let (config_path, input) = match argument.filter(|path| is_config(path)) {
        Some(_) if args.config.is_some() => bail!(
            "the first argument and --config both name a configuration; leave one of them out"
        ),
        Some(path) => (Some(path), None),
        None => (args.config.as_deref(), argument),
    };
    let mut config: GroundCommandConfig = settings::load(config_path, &settings)?;
    let Some(path) = input else {
        if !args.simulated {
            require_input(&config, config_path, "scan_folder")?;
        }
        let folder = config.recording.scan_folder.to_path_buf();
        return Ok((config, folder));
    };
    if path.is_dir() || is_bag(path) {
        config.recording.scan_folder = path.into();
        return Ok((config, path.to_owned()));
    }
    ensure!(
        scan_files::is_scan(path) || !path.exists(),
        "{} is neither a recording (a folder, .mcap, .db3 or .bag) nor a scan (.bin, .pcd, .ply, .npy) nor a configuration (.yml)",
        path.display()
    );
    Ok((config, path.to_owned()))
}

/// Lists the scan at a path, or the selected scans of a recording, in order.
pub fn scans(path: &Path, config: &GroundCommandConfig) -> Result<Vec<LabelledScan>> {
    let labels = config.label_folder.as_deref();
    if is_scan(path) {
        let source = ScanSource::File {
            path: path.to_owned(),
            stamp_s: None,
            format: PointFormat::default(),
        };
        let folder = path.parent().unwrap_or(path);
        let frame = Frame::new(0, source, 0.0);
        return Ok(vec![LabelledScan::new(frame, folder, labels)]);
    }
    if !is_bag(path) {
        require_folder("scan_folder", path)?;
    }
    let recording = Recording::open_with(
        path,
        config.recording.layout,
        config.recording.topic.as_deref(),
        &config.recording.frames,
        memory::budget(),
    )?;
    let folder = &recording.files.scans;
    let frames = recording.frames.into_iter();
    Ok(frames
        .map(|frame| LabelledScan::new(frame, folder, labels))
        .collect())
}

/// Whether a path names one scan, not a folder of scans.
pub fn is_scan(path: &Path) -> bool {
    scan_files::is_scan(path) && !path.is_dir()
}

impl LabelledScan {
    fn new(frame: Frame, folder: &Path, labels: Option<&Path>) -> Self {
        let (name, label_path) = match &frame.source {
            ScanSource::File { path, .. } => {
                let name = path.strip_prefix(folder).unwrap_or(path);
                (name.with_extension(""), label_file(path, name, labels))
            }
            _ => {
                let name = PathBuf::from(format!("{:06}", frame.number));
                let path = labels.map(|folder| folder.join(&name).with_extension("label"));
                (name, path.filter(|path| path.is_file()))
            }
        };
        Self {
            name,
            frame,
            label_path,
        }
    }

    /// Reads points and classes.
    pub fn read(&self) -> Result<LabelledPoints> {
        let points = self.frame.read()?.points;
        let label_path = self.label_path.as_deref();
        let classes = label_path.map(velodyne::read_labels).transpose()?;
        if let (Some(path), Some(classes)) = (label_path, &classes) {
            ensure!(
                classes.len() == points.len(),
                "{} has {} labels for the {} points of {}; set label_folder to the labels of these scans",
                path.display(),
                classes.len(),
                points.len(),
                self.frame.source
            );
        }
        Ok(LabelledPoints { points, classes })
    }
}

/// Returns an error if the labels that are written would replace the true ones.
pub fn check_overwrite(config: &GroundCommandConfig, scans: &[LabelledScan]) -> Result<()> {
    let written = config.output_folder.join("labels");
    let collides = written.canonicalize().is_ok_and(|written| {
        let truth = scans.iter().filter_map(|scan| scan.label_path.as_ref());
        truth
            .filter_map(|path| path.parent()?.canonicalize().ok())
            .any(|folder| folder.starts_with(&written))
    });
    ensure!(
        !(config.write_labels && collides),
        "{} contains the true labels, which would be overwritten; choose another output_folder",
        written.display()
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_found_next_to_the_folder_of_the_scans_with_one_or_two_extensions() {
        let folder = tempfile::tempdir().unwrap();
        let labels = folder.path().join("labels");
        std::fs::create_dir(&labels).unwrap();
        let expected = labels.join("000007.label");
        std::fs::write(&expected, []).unwrap();
        for (scans, name) in [
            ("velodyne", "000007.bin"),
            ("", "lidar/000007.pcd.bin"),
            ("lidar", "000007.pcd.bin"),
        ] {
            let scan = folder.path().join(scans).join(name);
            for label_folder in [None, Some(labels.as_path())] {
                let found = label_file(&scan, Path::new(name), label_folder);
                assert_eq!(found.as_ref(), Some(&expected), "{name}");
            }
        }
        let other = folder.path().join("velodyne/000008.bin");
        assert_eq!(label_file(&other, Path::new("000008.bin"), None), None);
    }
}
