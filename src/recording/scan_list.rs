//! The scans of a folder: their files, numbers, times and selection.

use std::collections::BTreeSet;
use std::fs;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::error::RecordingError;
use super::scan_files;
use crate::validation::{InvalidValue, Validate, require};

/// Selected frames of a recording: `start_idx`, `start_idx + frame_step`, ...
///
/// Defaults: every frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Selection {
    /// First frame.
    pub start_idx: usize,
    /// Number of consecutive scans to select from; -1 for all.
    #[default(-1)]
    pub n_scans: i64,
    /// Every n-th of them is selected.
    #[default(1)]
    pub frame_step: usize,
}

impl Validate for Selection {
    fn validate(&self) -> Result<(), InvalidValue> {
        require(
            self.n_scans == -1 || self.n_scans >= 1,
            "n_scans",
            self.n_scans,
            "it must be 1 or greater, or -1 for all scans",
        )?;
        require(
            self.frame_step >= 1,
            "frame_step",
            self.frame_step,
            "1 takes every frame, 2 every other one",
        )
    }
}

/// A scan of a folder.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanFile {
    /// Number in the recording.
    pub number: usize,
    /// The file.
    pub path: PathBuf,
    /// Time in the name of the file [s].
    pub time_s: Option<f64>,
}

impl Selection {
    /// The selected ones of all frames of a recording, and the others between them.
    pub(crate) fn of<T>(
        &self,
        frames: Vec<T>,
        number: impl Fn(&T) -> usize,
        path: &Path,
    ) -> Result<(Vec<T>, Vec<T>), RecordingError> {
        let scans = frames.len();
        let window = usize::try_from(self.n_scans).unwrap_or(usize::MAX);
        let window_end = self.start_idx.saturating_add(window);
        let is_selected = |frame: &T| {
            let in_window = (self.start_idx..window_end).contains(&number(frame));
            in_window && (number(frame) - self.start_idx).is_multiple_of(self.frame_step)
        };
        let (selected, mut skipped): (Vec<T>, Vec<T>) = frames.into_iter().partition(is_selected);
        let [first, .., last] = selected.as_slice() else {
            if selected.len() == 1 {
                return Ok((selected, Vec::new()));
            }
            return Err(RecordingError::NothingSelected {
                path: path.to_owned(),
                start_idx: self.start_idx,
                n_scans: self.n_scans,
                frame_step: self.frame_step,
                scans,
            });
        };
        let between = number(first)..number(last);
        skipped.retain(|frame| between.contains(&number(frame)));
        Ok((selected, skipped))
    }
}

/// All scans below a folder, ascending. If their names are numbers, these are their numbers, so that a part of a
/// recording keeps its poses; if the names are times, or if none is a number, they are numbered by their
/// positions. A mixture, and a number that two scans have, are errors.
pub fn scan_files(folder: &Path) -> Result<Vec<ScanFile>, RecordingError> {
    let paths = scan_paths(folder)?;
    let timed: Option<Vec<(f64, PathBuf)>> = (paths.iter())
        .map(|path| Some((time_in_name(path)?, path.clone())))
        .collect();
    if let Some(mut timed) = timed {
        timed.sort_by(|a, b| a.0.total_cmp(&b.0));
        let scan = |(number, (time_s, path))| ScanFile {
            number,
            path,
            time_s: Some(time_s),
        };
        return Ok(timed.into_iter().enumerate().map(scan).collect());
    }
    let scan = |(number, path)| ScanFile {
        number,
        path,
        time_s: None,
    };
    Ok(numbered(paths)?.into_iter().map(scan).collect())
}

/// The time in a name such as `1317384506.4.pcd`, or `1317384506400000000.bin` in nanoseconds, also after other words,
/// as in `n015__LIDAR_TOP__1532402927647951.pcd.bin` (nuScenes), or with the nanoseconds apart, as in
/// `cloud_1317384506_400000000.pcd` [s]: since 1970, from 2001 on.
fn time_in_name(path: &Path) -> Option<f64> {
    let stem = path.file_stem()?.to_str()?;
    let stem = stem.strip_suffix(".pcd").unwrap_or(stem);
    let mut words = stem.rsplit('_');
    let (last, before) = (words.next()?, words.next().unwrap_or_default());
    let is_number = |word: &str, digits: RangeInclusive<usize>| {
        digits.contains(&word.len()) && word.bytes().all(|byte| byte.is_ascii_digit())
    };
    if is_number(before, 10..=10) && is_number(last, 1..=9) {
        return Some(before.parse::<f64>().ok()? + last.parse::<f64>().ok()? * 1e-9);
    }
    // Leading zeros are those of a number: `0000000000.bin` (KITTI raw).
    if last.starts_with('0') {
        return None;
    }
    let number: f64 = last.parse().ok()?;
    let digits = last.split('.').next()?.len();
    match digits {
        10 => Some(number),
        13 => Some(number * 1e-3),
        16 => Some(number * 1e-6),
        19 => Some(number * 1e-9),
        _ => None,
    }
}

/// All scans below a folder, sorted by path, without hidden files and folders, and without meshes, such as a map. A
/// folder that is linked more than once is read once.
pub fn scan_paths(folder: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let mut paths = Vec::new();
    let mut folders = vec![folder.to_owned()];
    let mut visited = BTreeSet::new();
    while let Some(folder) = folders.pop() {
        let read_error = || RecordingError::read(&folder);
        if !visited.insert(folder.canonicalize().map_err(read_error())?) {
            continue;
        }
        for entry in fs::read_dir(&folder).map_err(read_error())? {
            let path = entry.map_err(read_error())?.path();
            let is_hidden = (path.file_name()).is_some_and(|n| n.as_encoded_bytes()[0] == b'.');
            if is_hidden {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else if scan_files::is_scan(&path) && !scan_files::is_mesh(&path) {
                paths.push(path);
            }
        }
    }
    if paths.is_empty() {
        return Err(RecordingError::NoScans {
            path: folder.to_owned(),
        });
    }
    paths.sort();
    Ok(paths)
}

/// Scans with their numbers, ascending: those in their names, or, if no name is a number, their
/// positions.
fn numbered(scans: Vec<PathBuf>) -> Result<Vec<(usize, PathBuf)>, RecordingError> {
    // The name of nuScenes' scans is `000000.pcd.bin`.
    let number_of = |path: &PathBuf| {
        let name = path.file_name()?.to_str()?;
        name.split('.').next()?.parse::<usize>().ok()
    };
    let Some(first) = scans.iter().find(|path| number_of(path).is_some()).cloned() else {
        return Ok(scans.into_iter().enumerate().collect());
    };
    let mut numbered = Vec::with_capacity(scans.len());
    for path in scans {
        let Some(number) = number_of(&path) else {
            return Err(RecordingError::MixedNames {
                number: first,
                word: path,
            });
        };
        numbered.push((number, path));
    }
    numbered.sort();
    for pair in numbered.windows(2) {
        if pair[0].0 == pair[1].0 {
            return Err(RecordingError::SameNumber {
                first: pair[0].1.clone(),
                second: pair[1].1.clone(),
            });
        }
    }
    Ok(numbered)
}
