//! Hashes of inputs.

use std::fmt::{self, Write as _};
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use blake3::Hash;
use rayon::prelude::*;

use crate::lidar::Scan;
use crate::recording::{Frame, Recording, RecordingError};

/// Hash of a file, or of those in a folder, in the order of their names.
pub fn hash_of_file(path: &Path) -> Result<String> {
    let context = || format!("cannot read {}", path.display());
    if path.is_dir() {
        let entries = fs::read_dir(path).with_context(context)?;
        let mut paths: Vec<PathBuf> = entries
            .map(|entry| Ok(entry.with_context(context)?.path()))
            .collect::<Result<_>>()?;
        paths.sort();
        let hashes: Result<Vec<String>> = paths.iter().map(|path| hash_of_file(path)).collect();
        return Ok(hash_of_texts(&hashes?));
    }
    let mut hasher = blake3::Hasher::new();
    let file = File::open(path).with_context(context)?;
    hasher.update_reader(file).with_context(context)?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// Hash of a list of texts, 32 hexadecimal digits.
pub fn hash_of_texts(parts: &[impl AsRef<str>]) -> String {
    let mut hasher = blake3::Hasher::new();
    for part in parts {
        let part = part.as_ref();
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part.as_bytes());
    }
    hasher.finalize().to_hex()[..32].to_owned()
}

/// Hash of a value as it is written for debugging, of which the text is not kept: it may be long.
pub fn hash_of_debug(value: &impl fmt::Debug) -> String {
    struct Text(blake3::Hasher);
    impl fmt::Write for Text {
        fn write_str(&mut self, part: &str) -> fmt::Result {
            self.0.update(part.as_bytes());
            Ok(())
        }
    }
    let mut text = Text(blake3::Hasher::new());
    // The hasher takes every part.
    let _ = write!(text, "{value:?}");
    text.0.finalize().to_hex().to_string()
}

/// Hash of the scans of a recording with their numbers and times, and of its files of poses and calibration.
pub fn hash_of_recording(recording: &Recording) -> Result<String> {
    let mut hashes = (recording.frames.par_iter())
        .map(|frame| {
            let content = hash_of_scan(&frame.read()?);
            Ok(format!("{} {} {content}", frame.number, frame.time_s))
        })
        .collect::<Result<Vec<String>>>()?;
    let files = &recording.files;
    for path in files.poses.iter().chain(&files.calibration) {
        hashes.push(hash_of_file(path)?);
    }
    Ok(hash_of_texts(&hashes))
}

/// Hash of the scans of frames, in order.
pub fn hash_of_scans(frames: &[Frame]) -> Result<String, RecordingError> {
    let hash = |frame: &Frame| Ok(hash_of_scan(&frame.read()?));
    let hashes: Vec<Hash> = frames
        .par_iter()
        .map(hash)
        .collect::<Result<_, RecordingError>>()?;
    Ok(joint_hash(hashes))
}

/// Hash of the hashes of scans, in order.
pub fn joint_hash(hashes: impl IntoIterator<Item = Hash>) -> String {
    let mut joint = blake3::Hasher::new();
    for hash in hashes {
        joint.update(hash.as_bytes());
    }
    joint.finalize().to_hex().to_string()
}

/// Hash of the points of a scan with their times.
pub fn hash_of_scan(scan: &Scan) -> Hash {
    let numbers = scan.points.iter().flat_map(|point| point.to_array());
    let numbers = numbers.chain(scan.times_s.iter().copied());
    let bytes: Vec<u8> = numbers.flat_map(f32::to_le_bytes).collect();
    blake3::hash(&bytes)
}
