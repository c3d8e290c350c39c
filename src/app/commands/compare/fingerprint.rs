//! What a result depends on, as a short text that is the same exactly where the result is.
//!
//! ```text
//! map          = H(source, build_map without paths, scans, poses, calibration)
//! localization = H(map, localization without paths, scans, poses, calibration, odometry)
//! run          = H(localization, refinement without paths, its odometry)
//! ```
//!
//! H is BLAKE3. The source is that of the program ([`version::executable_hash`]): rebuilt with another
//! behaviour, it does not take what an older one made. Of a simulated drive the recipe stands for the
//! scans, which follow from it and the source: a drive that other source made is made anew before it is
//! used ([`Existing::Renew`](crate::app::commands::simulate::Existing::Renew)).

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use rayon::prelude::*;

use super::plan::PlannedRun;
use crate::app::commands::version;
use crate::app::config::{self, BuildMapConfig, LocalizationConfig, RefinementConfig};
use crate::recording::{Selection, Sequence};
use crate::simulation::SimulationConfig;

/// What the stages of a run depend on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keys {
    /// Of the map.
    pub map: String,
    /// Of what the filter finds.
    pub localization: String,
    /// Of the whole run.
    pub run: String,
}

/// Makes keys; remembers inputs that it has looked at.
#[derive(Debug, Default)]
pub struct Fingerprints {
    inputs: BTreeMap<String, String>,
}

impl Fingerprints {
    /// The keys of a run.
    pub fn of(&mut self, run: &PlannedRun) -> Result<Keys> {
        let (map, query) = (&run.build_map, &run.localization);
        let [first, second] = drives_of(run);
        let mapped = self.scans(
            first,
            [&map.scan_folder, &map.pose_file, &map.calib_file],
            &map.selection(),
        )?;
        let query = self.scans(
            second,
            [&query.scan_folder, &query.pose_file, &query.calib_file],
            &query.selection(),
        )?;
        let odometry = self.odometry(run, run.localization.odometry_file.as_deref())?;
        let refined_with =
            (run.refinement.as_ref()).and_then(|refinement| refinement.odometry_file.as_deref());
        let refined_with = self.odometry(run, refined_with)?;
        let [build_map, localization, refinement] = effective(run)?;
        let map = hash(&["map", version::executable_hash()?, &build_map, &mapped]);
        let localization = hash(&["localization", &map, &localization, &query, &odometry]);
        let run = hash(&["run", &localization, &refinement, &refined_with]);
        Ok(Keys {
            map,
            localization,
            run,
        })
    }

    /// Of what is mapped or localized: a simulated drive, or scans, poses and calibration.
    fn scans(
        &mut self,
        simulated: Option<&SimulationConfig>,
        [scans, poses, calibration]: [&Path; 3],
        selection: &Selection,
    ) -> Result<String> {
        match simulated {
            Some(drive) => self.recipe(drive),
            None => self.recording(scans, poses, calibration, selection),
        }
    }

    /// Of an odometry file; nothing for that of a simulated drive, which follows from its recipe.
    fn odometry(&mut self, run: &PlannedRun, file: Option<&Path>) -> Result<String> {
        match file {
            Some(file) if !is_simulated(run, file) => self.file(file),
            _ => Ok(String::new()),
        }
    }

    fn recipe(&mut self, drive: &SimulationConfig) -> Result<String> {
        let recipe = SimulationConfig {
            output_folder: PathBuf::new(),
            path_pose_file: None,
            path_calib_file: None,
            ..drive.clone()
        };
        let mut parts = vec![config::to_yaml(&recipe)?];
        if let Some(poses) = &drive.path_pose_file {
            let beside = poses.with_file_name("calib.txt");
            parts.push(self.file(poses)?);
            parts.push(self.file(drive.path_calib_file.as_deref().unwrap_or(&beside))?);
        }
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        Ok(hash(&parts))
    }

    fn recording(
        &mut self,
        scans: &Path,
        poses: &Path,
        calibration: &Path,
        selection: &Selection,
    ) -> Result<String> {
        let what = format!("{scans:?} {poses:?} {calibration:?} {selection:?}");
        if let Some(known) = self.inputs.get(&what) {
            return Ok(known.clone());
        }
        let sequence = Sequence::open(scans, poses, calibration, selection)?;
        let mut parts = (sequence.frames.par_iter())
            .map(|frame| Ok(format!("{} {}", frame.number, content(&frame.scan_path)?)))
            .collect::<Result<Vec<String>>>()?;
        for file in [poses, calibration] {
            parts.push(self.file(file)?);
        }
        let times = poses.with_file_name("times.txt");
        if times.exists() {
            parts.push(self.file(&times)?);
        }
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        let found = hash(&parts);
        self.inputs.insert(what, found.clone());
        Ok(found)
    }

    fn file(&mut self, path: &Path) -> Result<String> {
        let what = format!("{path:?}");
        if let Some(known) = self.inputs.get(&what) {
            return Ok(known.clone());
        }
        let found = content(path)?;
        self.inputs.insert(what, found.clone());
        Ok(found)
    }
}

/// The simulated drives that a run maps and is localized on; none where its configuration names
/// other files.
fn drives_of(run: &PlannedRun) -> [Option<&SimulationConfig>; 2] {
    let Some([first, second]) = &run.drives else {
        return [None, None];
    };
    let (map, query) = (&run.build_map, &run.localization);
    let files = [
        [&map.scan_folder, &map.pose_file, &map.calib_file],
        [&query.scan_folder, &query.pose_file, &query.calib_file],
    ];
    let of = |drive: &'_ SimulationConfig, files: [&PathBuf; 3]| {
        let folder = drive.drive_folder();
        (files.into_iter()).all(|file| file.parent() == Some(folder.as_path()))
    };
    [
        of(first, files[0]).then_some(first),
        of(second, files[1]).then_some(second),
    ]
}

/// Whether an odometry is the one that its simulated drive comes with.
fn is_simulated(run: &PlannedRun, odometry: &Path) -> bool {
    (run.drives.as_ref())
        .is_some_and(|[_, second]| odometry == second.drive_folder().join("odometry.txt"))
}

/// The files that a run reads, but for those that follow from recipes.
fn inputs_of(run: &PlannedRun) -> String {
    let (map, query) = (&run.build_map, &run.localization);
    let [mapped, found] = drives_of(run).map(|drive| drive.is_some());
    let mut files = Vec::new();
    if !mapped {
        files.extend([&map.scan_folder, &map.pose_file, &map.calib_file]);
    }
    if !found {
        files.extend([&query.scan_folder, &query.pose_file, &query.calib_file]);
    }
    let refined_with = run
        .refinement
        .as_ref()
        .and_then(|r| r.odometry_file.as_ref());
    let odometry = [query.odometry_file.as_ref(), refined_with];
    files.extend(
        odometry
            .into_iter()
            .flatten()
            .filter(|file| !is_simulated(run, file)),
    );
    format!("{files:?}")
}

/// The effective configurations without where things lie and what is drawn: build_map,
/// localization, refinement.
fn effective(run: &PlannedRun) -> Result<[String; 3]> {
    let nowhere = PathBuf::new;
    let build_map = BuildMapConfig {
        scan_folder: nowhere(),
        pose_file: nowhere(),
        calib_file: nowhere(),
        mesh_file: nowhere(),
        visualize: false,
        force: false,
        ..run.build_map.clone()
    };
    let localization = LocalizationConfig {
        scan_folder: nowhere(),
        map_file: nowhere(),
        map_pose_file: None,
        map_calib_file: None,
        pose_file: nowhere(),
        calib_file: nowhere(),
        result_path: nowhere(),
        odometry_file: None,
        plot_loc_results: false,
        visualize: false,
        force: false,
        ..run.localization.clone()
    };
    let refinement = run.refinement.clone().map(|refinement| RefinementConfig {
        scan_folder: nowhere(),
        map_file: nowhere(),
        map_pose_file: None,
        map_calib_file: None,
        pose_file: nowhere(),
        calib_file: nowhere(),
        result_file: nowhere(),
        odometry_file: None,
        plot_loc_results: false,
        force: false,
        ..refinement
    });
    let refinement = match &refinement {
        Some(refinement) => config::to_yaml(refinement)?,
        None => "not refined".to_owned(),
    };
    Ok([
        config::to_yaml(&build_map)?,
        config::to_yaml(&localization)?,
        refinement,
    ])
}

/// What a run was asked to do, with the names of its inputs and without a look at them, for
/// collecting where they are not. Of the program only the version: tables may be made by a later
/// build of it, and say which ones the runs are of.
pub fn settings_of(run: &PlannedRun) -> Result<String> {
    let [build_map, localization, refinement] = effective(run)?;
    let drives = match &run.drives {
        Some(drives) => config::to_yaml(&drives.each_ref().map(|drive| SimulationConfig {
            output_folder: PathBuf::new(),
            path_pose_file: None,
            path_calib_file: None,
            ..drive.clone()
        }))?,
        None => String::new(),
    };
    Ok(hash(&[
        "settings",
        version::VERSION,
        &build_map,
        &localization,
        &refinement,
        &drives,
        &inputs_of(run),
    ]))
}

fn content(path: &Path) -> Result<String> {
    let bytes = fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(blake3::hash(&bytes).to_hex().to_string())
}

/// Of all parts, whose borders count.
fn hash(parts: &[&str]) -> String {
    /// Of the 64 digits; 2⁶⁴ keys would have to be made before two meet by chance.
    const DIGITS: usize = 32;
    let mut hasher = blake3::Hasher::new();
    for part in parts {
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part.as_bytes());
    }
    hasher.finalize().to_hex()[..DIGITS].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::comparison::RunId;

    fn simulated() -> PlannedRun {
        lying_in("here")
    }

    fn lying_in(folder: &str) -> PlannedRun {
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
            drives: Some(drives),
            build_map: BuildMapConfig {
                scan_folder: first.join("velodyne"),
                pose_file: first.join("poses.txt"),
                calib_file: first.join("calib.txt"),
                ..BuildMapConfig::default()
            },
            localization: LocalizationConfig {
                scan_folder: second.join("velodyne"),
                pose_file: second.join("poses.txt"),
                calib_file: second.join("calib.txt"),
                odometry_file: Some(second.join("odometry.txt")),
                ..LocalizationConfig::default()
            },
            refinement: Some(RefinementConfig::default()),
            particles: None,
        }
    }

    fn keys(change: impl FnOnce(&mut PlannedRun)) -> Keys {
        let mut run = simulated();
        change(&mut run);
        Fingerprints::default().of(&run).unwrap()
    }

    #[test]
    fn where_things_lie_and_what_they_are_called_changes_no_key() {
        let moved = keys(|run| {
            run.id.configuration = "B".to_owned();
            run.build_map.mesh_file = "elsewhere.ply".into();
            run.localization.result_path = "elsewhere.npz".into();
            run.localization.force = true;
        });
        assert_eq!(moved, keys(|_| ()));
        let elsewhere = Fingerprints::default().of(&lying_in("elsewhere"));
        assert_eq!(elsewhere.unwrap(), moved);
    }

    #[test]
    fn a_change_moves_the_keys_of_its_stage_and_of_those_after_it() {
        let same = keys(|_| ());
        let other = keys(|run| run.refinement = None);
        assert!(other.run != same.run && other.localization == same.localization);
        let other = keys(|run| run.localization.seed = 9);
        assert!(other.run != same.run && other.localization != same.localization);
        assert_eq!(other.map, same.map);
        let other = keys(|run| run.build_map.depth = 7);
        assert!(other.run != same.run && other.localization != same.localization);
        assert_ne!(other.map, same.map);
        let other = keys(|run| {
            if let Some([_, second]) = &mut run.drives {
                second.traffic.pedestrians_per_100_m = 0.0;
            }
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
        let mut run = simulated();
        run.drives = None;
        run.build_map.scan_folder = path("velodyne");
        run.build_map.pose_file = path("poses.txt");
        run.build_map.calib_file = path("calib.txt");
        run.localization.scan_folder = path("velodyne");
        run.localization.pose_file = path("poses.txt");
        run.localization.calib_file = path("calib.txt");
        run.localization.odometry_file = None;
        let before = Fingerprints::default().of(&run).unwrap();
        assert_eq!(Fingerprints::default().of(&run).unwrap(), before);
        fs::write(path("velodyne/000000.bin"), [1; 16]).unwrap();
        let after = Fingerprints::default().of(&run).unwrap();
        assert!(after.map != before.map && after.run != before.run);
    }

    #[test]
    fn another_odometry_is_another_run_and_one_that_is_not_there_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.txt");
        fs::write(&path, "1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
        let (before, own) = (simulated(), keys(|_| ()));
        let other = keys(|run| run.localization.odometry_file = Some(path.clone()));
        assert!(other.map == own.map && other.localization != own.localization);
        let refined = keys(|run| {
            if let Some(refinement) = &mut run.refinement {
                refinement.odometry_file = Some(path.clone());
            }
        });
        assert!(refined.localization == own.localization && refined.run != own.run);
        let mut missing = simulated();
        missing.localization.odometry_file = Some("nowhere.txt".into());
        assert!(Fingerprints::default().of(&missing).is_err());
        // Without a look at the files, too.
        assert_ne!(
            settings_of(&missing).unwrap(),
            settings_of(&before).unwrap()
        );
    }

    #[test]
    fn borders_between_parts_count() {
        assert_ne!(hash(&["ab", "c"]), hash(&["a", "bc"]));
    }
}
