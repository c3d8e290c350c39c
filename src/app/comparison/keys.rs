//! Keys of results: hashes of all that a stage depends on.
//!
//! ```text
//! map          = H(executable, build_map settings, scans, poses, calibration)
//! localization = H(map, localization settings, scans, poses, calibration, odometry)
//! run          = H(localization, refinement settings, odometry)
//! ```
//!
//! Scans are those that are selected, with the poses next to them, or a whole bag. H is BLAKE3. Settings are the effective configuration without paths, so that a copied or renamed
//! folder keeps its results. A simulated drive is represented by its configuration instead of its
//! files, which need not exist yet; drives of another executable are simulated again before use
//! ([`Existing::Renew`](crate::app::commands::simulate::Existing::Renew)).

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context as _, Result};
use serde::Serialize;
use serde_json::Value;

use super::plan::PlannedRun;
use crate::app::run::artefact::hash::{hash_of_file, hash_of_recording, hash_of_texts};
use crate::app::run::input::is_bag;
use crate::app::run::{memory, version};
use crate::app::settings::{PoseInputConfig, RecordingConfig};
use crate::recording::{Recording, is_topic};
use crate::simulation::SimulationConfig;

/// Configuration keys without effect on the numbers: paths, plots, permission to replace files.
const IGNORED_KEYS: [&str; 15] = [
    "scan_folder",
    "pose_file",
    "calib_file",
    "mesh_file",
    "map_file",
    "map_pose_file",
    "map_calib_file",
    "result_path",
    "result_file",
    "odometry_file",
    "output_folder",
    "path_pose_file",
    "path_calib_file",
    "visualize",
    "output",
];

/// Keys of the stages of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keys {
    /// Key of the map.
    pub map: String,
    /// Key of the localization.
    pub localization: String,
    /// Key of the run.
    pub run: String,
}

/// Computes keys; hashes each input once.
#[derive(Debug, Default)]
pub struct KeyCache {
    inputs: BTreeMap<String, String>,
}

impl KeyCache {
    /// Keys of a run.
    pub fn keys(&mut self, run: &PlannedRun) -> Result<Keys> {
        let [map, localization, refinement] = stages(run)?;
        let map = self.key(version::executable_hash()?, map)?;
        let localization = self.key(&map, localization)?;
        Ok(Keys {
            run: self.key(&localization, refinement)?,
            map,
            localization,
        })
    }

    fn key(&mut self, previous: &str, stage: Stage) -> Result<String> {
        let mut parts = vec![previous.to_owned(), stage.settings];
        for input in &stage.inputs {
            parts.push(self.input(input)?);
        }
        Ok(hash_of_texts(&parts))
    }

    fn input(&mut self, input: &Input) -> Result<String> {
        match *input {
            Input::Simulated(drive, _) => {
                let mut parts = vec![input.name()?];
                if let Some(poses) = &drive.path_pose_file {
                    let neighbour = poses.with_file_name("calib.txt");
                    parts.push(self.file(poses)?);
                    parts.push(self.file(drive.path_calib_file.as_deref().unwrap_or(&neighbour))?);
                }
                Ok(hash_of_texts(&parts))
            }
            Input::Scans(config) if is_bag(&config.scan_folder) => self.file(&config.scan_folder),
            Input::Scans(config) => self.once(format!("{config:?}"), || {
                hash_of_recording(&Recording::open_with(
                    &config.scan_folder,
                    config.layout,
                    config.topic.as_deref(),
                    &config.frames,
                    memory::budget(),
                )?)
            }),
            Input::Topic(name) => Ok(format!("{name:?}")),
            Input::File(path) => self.file(path),
        }
    }

    /// Hash of a file and of the `times.txt` next to it, which is part of a file of poses.
    fn file(&mut self, path: &Path) -> Result<String> {
        self.once(format!("{path:?}"), || {
            let times = path.with_file_name("times.txt");
            let times = times.exists().then(|| hash_of_file(&times)).transpose()?;
            Ok(hash_of_texts(&[
                hash_of_file(path)?,
                times.unwrap_or_default(),
            ]))
        })
    }

    fn once(&mut self, name: String, hash: impl FnOnce() -> Result<String>) -> Result<String> {
        if let Some(known) = self.inputs.get(&name) {
            return Ok(known.clone());
        }
        let found = hash()?;
        self.inputs.insert(name, found.clone());
        Ok(found)
    }
}

/// Hash of the settings of a run, the names of its inputs and the version of the program. Needs no
/// access to the inputs, so that records can be collected without them and by a later build.
pub fn settings_hash(run: &PlannedRun) -> Result<String> {
    let mut parts = vec![version::VERSION.to_owned()];
    for stage in stages(run)? {
        parts.push(stage.settings);
        for input in &stage.inputs {
            parts.push(input.name()?);
        }
    }
    Ok(hash_of_texts(&parts))
}

/// What a stage depends on besides the previous stage.
struct Stage<'a> {
    settings: String,
    inputs: Vec<Input<'a>>,
}

/// The stages of a run: map, localization, refinement.
fn stages(run: &PlannedRun) -> Result<[Stage<'_>; 3]> {
    let (map, query, refinement) = (&run.build_map, &run.localization, &run.refinement);
    let mapping = Stage {
        settings: settings(map)?,
        inputs: Input::of_recording(run, &map.recording, &map.given_poses),
    };
    let mut localization = Stage {
        settings: settings(query)?,
        inputs: Input::of_recording(run, &query.recording, &query.given_poses),
    };
    let odometry = query.motion.odometry_file.iter();
    let odometry = odometry.map(|path| Input::of_file(run, &query.recording, path));
    localization.inputs.extend(odometry);
    let odometry = refinement.iter().filter_map(|refined| {
        let path = refined.motion.odometry_file.as_ref()?;
        Some(Input::of_file(run, &refined.recording, path))
    });
    let refinement = Stage {
        settings: settings(refinement)?,
        inputs: odometry.collect(),
    };
    Ok([mapping, localization, refinement])
}

/// A file or folder that a stage reads.
enum Input<'a> {
    /// A part of a simulated drive: the drive, and the path below its folder.
    Simulated(&'a SimulationConfig, &'a Path),
    /// Selected scans of a folder, or a bag.
    Scans(&'a RecordingConfig),
    /// Topic of a bag.
    Topic(&'a Path),
    /// Any other file, or a folder of poses.
    File(&'a Path),
}

impl<'a> Input<'a> {
    /// The scans of a recording, and the files of its poses.
    fn of_recording(
        run: &'a PlannedRun,
        recording: &'a RecordingConfig,
        poses: &'a PoseInputConfig,
    ) -> Vec<Self> {
        let scans = Self::new(run, &recording.scan_folder, Some(recording));
        let files = poses.pose_file.iter().chain(&poses.calib_file);
        let files = files.map(|path| Self::of_file(run, recording, path));
        std::iter::once(scans).chain(files).collect()
    }

    /// A file that belongs to a recording, or a topic of it if it is a bag.
    fn of_file(run: &'a PlannedRun, recording: &RecordingConfig, path: &'a Path) -> Self {
        if is_bag(&recording.scan_folder) && is_topic(path) {
            Self::Topic(path)
        } else {
            Self::new(run, path, None)
        }
    }

    fn new(run: &'a PlannedRun, path: &'a Path, recording: Option<&'a RecordingConfig>) -> Self {
        let below = |drive: &SimulationConfig| path.strip_prefix(drive.drive_folder()).ok();
        let simulated = run
            .drives
            .iter()
            .find_map(|drive| Some((drive, below(drive)?)));
        match (simulated, recording) {
            (Some((drive, path)), _) => Self::Simulated(drive, path),
            (None, Some(recording)) => Self::Scans(recording),
            (None, None) => Self::File(path),
        }
    }

    /// The path; for a simulated drive, its configuration and the path below its folder.
    fn name(&self) -> Result<String> {
        Ok(match self {
            Self::Simulated(drive, path) => format!("{} {path:?}", settings(drive)?),
            Self::Scans(recording) => format!("{:?}", recording.scan_folder),
            Self::Topic(path) | Self::File(path) => format!("{path:?}"),
        })
    }
}

/// A configuration as text, without [`IGNORED_KEYS`].
fn settings(config: &impl Serialize) -> Result<String> {
    let mut settings = serde_json::to_value(config).context("cannot serialize a configuration")?;
    remove_ignored(&mut settings);
    Ok(settings.to_string())
}

fn remove_ignored(settings: &mut Value) {
    if let Value::Object(block) = settings {
        block.retain(|key, _| !IGNORED_KEYS.contains(&key.as_str()));
        block.values_mut().for_each(remove_ignored);
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::PathBuf;

    use super::*;
    use crate::app::comparison::record::RunId;
    use crate::app::settings::{
        BuildMapConfig, LocalizationConfig, MotionSourceConfig, PoseInputConfig, RecordingConfig,
        RefinementConfig,
    };

    fn recording(scan_folder: PathBuf) -> RecordingConfig {
        RecordingConfig {
            scan_folder: scan_folder.into(),
            ..RecordingConfig::default()
        }
    }

    fn true_poses(drive: &Path) -> PoseInputConfig {
        PoseInputConfig {
            pose_file: Some(drive.join("poses.txt").into()),
            calib_file: Some(drive.join("calib.txt").into()),
            ..PoseInputConfig::default()
        }
    }

    fn planned_run() -> PlannedRun {
        planned_run_in("here")
    }

    fn planned_run_in(folder: &str) -> PlannedRun {
        let drives = [1, 2].map(|drive| SimulationConfig {
            drive,
            output_folder: folder.into(),
            ..SimulationConfig::default()
        });
        let [first, second] = drives.each_ref().map(SimulationConfig::drive_folder);
        PlannedRun {
            id: RunId {
                sequence: "town".to_owned(),
                configuration: "A".to_owned(),
                seed: 1,
            },
            drives: drives.into(),
            build_map: BuildMapConfig {
                recording: recording(first.join("velodyne")),
                given_poses: true_poses(&first),
                ..BuildMapConfig::default()
            },
            localization: LocalizationConfig {
                recording: recording(second.join("velodyne")),
                given_poses: true_poses(&second),
                motion: MotionSourceConfig {
                    odometry_file: Some(second.join("odometry.txt").into()),
                    ..MotionSourceConfig::default()
                },
                ..LocalizationConfig::default()
            },
            refinement: Some(RefinementConfig::default()),
            particles: None,
        }
    }

    fn keys(change: impl FnOnce(&mut PlannedRun)) -> Keys {
        let mut run = planned_run();
        change(&mut run);
        KeyCache::default().keys(&run).unwrap()
    }

    #[test]
    fn paths_and_names_change_no_key() {
        let moved = keys(|run| {
            run.id.configuration = "B".to_owned();
            run.build_map.mesh_file = "elsewhere.ply".into();
            run.localization.result_path = "elsewhere.npz".into();
            run.localization.output.force = true;
        });
        assert_eq!(moved, keys(|_| ()));
        let elsewhere = KeyCache::default().keys(&planned_run_in("elsewhere"));
        assert_eq!(elsewhere.unwrap(), moved);
    }

    #[test]
    fn a_change_affects_the_keys_of_its_stage_and_of_later_stages() {
        let same = keys(|_| ());
        let other = keys(|run| run.refinement = None);
        assert!(other.run != same.run && other.localization == same.localization);
        let other = keys(|run| run.localization.tracker.seed = 9);
        assert!(other.run != same.run && other.localization != same.localization);
        assert_eq!(other.map, same.map);
        let other = keys(|run| run.build_map.map.local_map.poisson.depth = Some(7));
        assert!(other.run != same.run && other.localization != same.localization);
        assert_ne!(other.map, same.map);
        let other = keys(|run| {
            run.drives[1].traffic.pedestrians_per_100_m = 0.0;
        });
        assert!(other.map == same.map && other.localization != same.localization);
    }

    #[test]
    fn a_byte_of_a_recording_changes_the_key() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::create_dir(path("velodyne")).unwrap();
        fs::write(path("velodyne/000000.bin"), [0; 16]).unwrap();
        fs::write(path("poses.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
        fs::write(path("calib.txt"), "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n").unwrap();
        let mut run = planned_run();
        run.drives.clear();
        run.build_map.recording.scan_folder = path("velodyne").into();
        run.build_map.given_poses.pose_file = Some(path("poses.txt").into());
        run.build_map.given_poses.calib_file = Some(path("calib.txt").into());
        run.localization.recording.scan_folder = path("velodyne").into();
        run.localization.given_poses.pose_file = Some(path("poses.txt").into());
        run.localization.given_poses.calib_file = Some(path("calib.txt").into());
        run.localization.motion.odometry_file = None;
        let before = KeyCache::default().keys(&run).unwrap();
        assert_eq!(KeyCache::default().keys(&run).unwrap(), before);
        fs::write(path("velodyne/000000.bin"), [1; 16]).unwrap();
        let after = KeyCache::default().keys(&run).unwrap();
        assert!(after.map != before.map && after.run != before.run);
    }

    #[cfg(feature = "bags")]
    #[test]
    fn a_byte_of_a_bag_and_the_names_of_its_topics_change_the_key() {
        let folder = tempfile::tempdir().unwrap();
        let bag = folder.path().join("drive.mcap");
        fs::write(&bag, [0; 16]).unwrap();
        let mut run = planned_run();
        run.drives.clear();
        run.build_map.recording.scan_folder = bag.clone().into();
        run.build_map.given_poses.pose_file = Some("/slam/odometry".into());
        run.build_map.given_poses.calib_file = None;
        run.localization.recording.scan_folder = bag.clone().into();
        run.localization.given_poses.pose_file = None;
        run.localization.given_poses.calib_file = None;
        run.localization.motion.odometry_file = Some("/wheels/odometry".into());
        run.refinement = None;
        let keys = |run: &PlannedRun| KeyCache::default().keys(run).unwrap();
        let before = keys(&run);
        assert_eq!(keys(&run), before);
        for (change, is_map) in [
            (|run: &mut PlannedRun| run.build_map.recording.topic = Some("/rear".to_owned()))
                as fn(&mut _),
            |run| run.build_map.given_poses.pose_file = Some("/other".into()),
            |run| run.localization.motion.odometry_file = Some("/other".into()),
        ]
        .into_iter()
        .zip([true, true, false])
        {
            let mut other = run.clone();
            change(&mut other);
            let after = keys(&other);
            assert_eq!(after.map != before.map, is_map);
            assert_ne!(after.localization, before.localization);
        }
        fs::write(&bag, [1; 16]).unwrap();
        assert_ne!(keys(&run).map, before.map);
    }

    #[test]
    fn poses_of_the_recording_itself_change_the_key() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::create_dir(path("velodyne")).unwrap();
        fs::write(path("velodyne/000000.bin"), [0; 16]).unwrap();
        let mut run = planned_run();
        run.drives.clear();
        run.build_map.recording.scan_folder = folder.path().into();
        run.build_map.given_poses.pose_file = None;
        run.build_map.given_poses.calib_file = None;
        run.localization = LocalizationConfig {
            recording: recording(path("velodyne")),
            ..LocalizationConfig::default()
        };
        let map = |row: &str| {
            fs::write(path("poses.txt"), row).unwrap();
            KeyCache::default().keys(&run).unwrap().map
        };
        let before = map("1 0 0 0 0 1 0 0 0 0 1 0\n");
        assert_ne!(map("1 0 0 1 0 1 0 0 0 0 1 0\n"), before);
    }

    #[test]
    fn another_odometry_changes_the_key_and_a_missing_one_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.txt");
        fs::write(&path, "1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
        let (before, own) = (planned_run(), keys(|_| ()));
        let other = keys(|run| run.localization.motion.odometry_file = Some(path.clone().into()));
        assert!(other.map == own.map && other.localization != own.localization);
        let refined = keys(|run| {
            if let Some(refinement) = &mut run.refinement {
                refinement.motion.odometry_file = Some(path.clone().into());
            }
        });
        assert!(refined.localization == own.localization && refined.run != own.run);
        let mut missing = planned_run();
        missing.localization.motion.odometry_file = Some("nowhere.txt".into());
        assert!(KeyCache::default().keys(&missing).is_err());
        // The settings differ without access to the files, too.
        assert_ne!(
            settings_hash(&missing).unwrap(),
            settings_hash(&before).unwrap()
        );
    }

    #[test]
    fn boundaries_between_parts_change_the_hash() {
        assert_ne!(hash_of_texts(&["ab", "c"]), hash_of_texts(&["a", "bc"]));
    }
}
