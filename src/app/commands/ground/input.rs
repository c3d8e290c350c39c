//! What is judged: scans with their labels.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};

use crate::app::cli::GroundArgs;
use crate::app::config::{self, GroundCommandConfig};
use crate::geometry::Vec3;
use crate::recording::sequence::selected_scans;
use crate::recording::velodyne;

/// Where scans come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// One file.
    Scan(PathBuf),
    /// All selected scans below a folder.
    Folder(PathBuf),
}

/// A scan on disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScanFiles {
    /// Relative to the folder of the scans, without extension.
    pub name: PathBuf,
    /// Its points.
    pub scan_path: PathBuf,
    /// Its classes, where there are any.
    pub label_path: Option<PathBuf>,
}

/// The points of a scan with their true classes, where these are known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LabelledPoints {
    /// Lidar frame [m].
    pub points: Vec<Vec3>,
    /// One per point.
    pub classes: Option<Vec<u16>>,
}

/// The configuration, with the input of the command line in it, and what is to be judged.
pub fn load(args: &GroundArgs) -> Result<(GroundCommandConfig, Source)> {
    let mut settings = args.settings.clone();
    if args.force {
        settings.push(("force".to_owned(), "true".to_owned()));
    }
    let is_config = |path: &&PathBuf| {
        let extension = path.extension().unwrap_or_default();
        extension == "yml" || extension == "yaml"
    };
    let own = args.input.as_ref().filter(is_config);
    ensure!(
        own.is_none() || args.config.is_none(),
        "two configurations are given; leave out --config or the first argument"
    );
    let input = args.input.as_ref().filter(|path| !is_config(path));
    let path = own.or(args.config.as_ref()).map(PathBuf::as_path);
    let mut config: GroundCommandConfig = config::load(path, &settings)?;
    let Some(path) = input else {
        let folder = config.scan_folder.clone();
        return Ok((config, Source::Folder(folder)));
    };
    if !path.is_dir() {
        let is_scan = path.extension().is_some_and(|extension| extension == "bin");
        if path.exists() && !is_scan {
            bail!(
                "{} is neither a folder nor a scan (.bin) nor a configuration (.yml)",
                path.display()
            );
        }
        return Ok((config, Source::Scan(path.clone())));
    }
    let velodyne = path.join("velodyne");
    config.scan_folder = if velodyne.is_dir() {
        velodyne
    } else {
        path.clone()
    };
    let folder = config.scan_folder.clone();
    Ok((config, Source::Folder(folder)))
}

impl Source {
    /// The scan or the folder.
    pub fn path(&self) -> &Path {
        match self {
            Self::Scan(path) | Self::Folder(path) => path,
        }
    }

    /// The selected scans in order.
    pub fn scans(&self, config: &GroundCommandConfig) -> Result<Vec<ScanFiles>> {
        let folder = match self {
            Self::Scan(path) => {
                let label_path = label_path(path, config.label_folder.as_deref(), None);
                return Ok(vec![ScanFiles {
                    name: path.file_stem().unwrap_or_default().into(),
                    scan_path: path.clone(),
                    label_path,
                }]);
            }
            Self::Folder(folder) => folder,
        };
        let scans = selected_scans(folder, &config.selection())?
            .into_iter()
            .map(|(_, scan_path)| {
                let name = scan_path.strip_prefix(folder).unwrap_or(&scan_path);
                ScanFiles {
                    name: name.with_extension(""),
                    label_path: label_path(&scan_path, config.label_folder.as_deref(), Some(name)),
                    scan_path,
                }
            })
            .collect();
        Ok(scans)
    }
}

impl ScanFiles {
    /// Reads points and classes.
    pub fn read(&self) -> Result<LabelledPoints> {
        let points = velodyne::read_scan(&self.scan_path)?.points;
        let Some(path) = &self.label_path else {
            return Ok(LabelledPoints {
                points,
                classes: None,
            });
        };
        let classes = velodyne::read_labels(path)?;
        ensure!(
            classes.len() == points.len(),
            "{} has {} labels for the {} points of {}; choose the label_folder that belongs to the scans",
            path.display(),
            classes.len(),
            points.len(),
            self.scan_path.display()
        );
        Ok(LabelledPoints {
            points,
            classes: Some(classes),
        })
    }
}

/// The classes of a scan, where there are any.
pub fn labels_of(
    scan_path: &Path,
    label_folder: Option<&Path>,
    name: Option<&Path>,
) -> Result<Option<Vec<u16>>> {
    let path = label_path(scan_path, label_folder, name);
    Ok(path.map(|path| velodyne::read_labels(&path)).transpose()?)
}

/// The label file of a scan, if it is there: of the same name in `label_folder`, or in `labels`
/// beside the folder of the scans.
fn label_path(
    scan_path: &Path,
    label_folder: Option<&Path>,
    name: Option<&Path>,
) -> Option<PathBuf> {
    let name = name.or_else(|| scan_path.file_name().map(Path::new))?;
    let depth = name.components().count();
    let beside = || Some(scan_path.ancestors().nth(depth + 1)?.join("labels"));
    let folder = label_folder.map(Path::to_owned).or_else(beside)?;
    let path = folder.join(name).with_extension("label");
    path.is_file().then_some(path)
}

/// Refuses to write labels over the true ones.
pub fn keep_truth_safe(config: &GroundCommandConfig, source: &Source) -> Result<()> {
    let written = config.output_folder.join("labels");
    let truth: Vec<PathBuf> = source
        .scans(config)?
        .into_iter()
        .filter_map(|scan| scan.label_path?.parent()?.canonicalize().ok())
        .collect();
    let collides = written
        .canonicalize()
        .is_ok_and(|written| truth.iter().any(|folder| folder.starts_with(&written)));
    ensure!(
        !(config.write_labels && collides),
        "{} holds the true labels, which would be overwritten; choose another output_folder",
        written.display()
    );
    Ok(())
}
