//! What a result depends on, as a short text that is the same exactly where the result is.
//!
//! ```text
//! map          = H(version, build_map without paths, scans, poses, calibration)
//! localization = H(map, localization without paths, scans, poses, calibration, odometry)
//! run          = H(localization, refinement without paths)
//! ```
//!
//! H is BLAKE3. Of a simulated drive the recipe stands for the scans, which follow from it.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use rayon::prelude::*;

use super::plan::PlannedRun;
use crate::config::{self, BuildMapConfig, LocalizationConfig, RefinementConfig};
use crate::kitti::{Selection, Sequence};
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
        let (mapped, query) = match &run.drives {
            Some([first, second]) => (self.recipe(first)?, self.recipe(second)?),
            None => {
                let map = &run.build_map;
                let query = &run.localization;
                let mapped = self.recording(
                    &map.scan_folder,
                    &map.pose_file,
                    &map.calib_file,
                    &map.selection(),
                )?;
                let query = self.recording(
                    &query.scan_folder,
                    &query.pose_file,
                    &query.calib_file,
                    &query.selection(),
                )?;
                (mapped, query)
            }
        };
        let odometry = match &run.localization.odometry_file {
            Some(file) if run.drives.is_none() => self.file(file)?,
            _ => String::new(),
        };
        let [build_map, localization, refinement] = effective(run)?;
        let map = hash(&["map", version(), &build_map, &mapped]);
        let localization = hash(&["localization", &map, &localization, &query, &odometry]);
        let run = hash(&["run", &localization, &refinement]);
        Ok(Keys {
            map,
            localization,
            run,
        })
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
        map_pose_file: nowhere(),
        map_calib_file: nowhere(),
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
        map_pose_file: nowhere(),
        map_calib_file: nowhere(),
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

/// What a run was asked to do, without a look at its inputs, for collecting where they are not.
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
        version(),
        &build_map,
        &localization,
        &refinement,
        &drives,
    ]))
}

fn version() -> &'static str {
    env!("CARGO_PKG_VERSION")
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
    use crate::evaluation::comparison::RunId;

    fn simulated() -> PlannedRun {
        PlannedRun {
            id: RunId {
                sequence: "town".to_owned(),
                configuration: "A".to_owned(),
                seed: 1,
            },
            drives: Some([1, 2].map(|drive| SimulationConfig {
                drive,
                ..SimulationConfig::default()
            })),
            build_map: BuildMapConfig::default(),
            localization: LocalizationConfig::default(),
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
            for drive in run.drives.iter_mut().flatten() {
                drive.output_folder = "elsewhere".into();
            }
        });
        assert_eq!(moved, keys(|_| ()));
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
        let before = Fingerprints::default().of(&run).unwrap();
        assert_eq!(Fingerprints::default().of(&run).unwrap(), before);
        fs::write(path("velodyne/000000.bin"), [1; 16]).unwrap();
        let after = Fingerprints::default().of(&run).unwrap();
        assert!(after.map != before.map && after.run != before.run);
    }

    #[test]
    fn borders_between_parts_count() {
        assert_ne!(hash(&["ab", "c"]), hash(&["a", "bc"]));
    }
}
