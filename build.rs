//! Tells the program hashes of its source, by which results of another behaviour are told apart.

#![allow(clippy::print_stdout, reason = "this is how Cargo is told")]

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// What only shows what was computed: a change there makes no result another.
pub const SHOWING: [&str; 6] = [
    "src/reporting",
    "src/plotting",
    "src/commands/compare/collect.rs",
    "src/commands/compare/jobs.rs",
    "src/commands/compare/page.rs",
    "src/commands/compare/pictures.rs",
];

/// What simulated drives follow from, beside their configuration.
pub const OF_DRIVES: [&str; 7] = [
    "src/geometry",
    "src/lidar",
    "src/raycasting",
    "src/kitti",
    "src/map/ply.rs",
    "src/simulation",
    "src/commands/simulate.rs",
];

fn main() -> io::Result<()> {
    let root = Path::new("");
    for (name, places) in [
        ("FPMCL_SOURCE", ["src"].as_slice()),
        ("FPMCL_DRIVE_SOURCE", &OF_DRIVES),
    ] {
        let mut files = sources(root, places)?;
        files.insert(PathBuf::from("Cargo.lock"));
        println!("cargo::rustc-env={name}={:016x}", hash(root, &files)?);
    }
    println!("cargo::rerun-if-changed=src");
    println!("cargo::rerun-if-changed=Cargo.lock");
    Ok(())
}

/// The files in some places that results follow from, with what is included in them; paths below
/// `root`.
pub fn sources(root: &Path, places: &[&str]) -> io::Result<BTreeSet<PathBuf>> {
    let mut files = BTreeSet::new();
    let mut left: Vec<PathBuf> = places.iter().map(PathBuf::from).collect();
    while let Some(path) = left.pop() {
        let whole = root.join(&path);
        if SHOWING.iter().any(|showing| path == Path::new(showing)) {
            continue;
        }
        if whole.is_dir() {
            let entries = fs::read_dir(&whole).map_err(|error| named(&whole, &error))?;
            for entry in entries {
                let entry = entry.map_err(|error| named(&whole, &error))?;
                left.push(path.join(entry.file_name()));
            }
        } else if is_source(&path) {
            let text = read(&whole)?;
            let included = included(&String::from_utf8_lossy(&text));
            let included = included.into_iter().map(|name| path.with_file_name(name));
            files.extend(included.filter(|path| root.join(path).is_file()));
            files.insert(path);
        }
    }
    Ok(files)
}

/// Whether a file is one of the program: not one of its tests, nor what an editor or a file manager
/// leaves there, such as the lock `.#poses.rs`, a link to nowhere.
fn is_source(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let is_known = [".rs", ".wgsl"].iter().any(|end| name.ends_with(end));
    is_known && !name.starts_with('.') && !name.ends_with("tests.rs")
}

/// The names of the files that a text includes.
fn included(text: &str) -> Vec<PathBuf> {
    let words = ["include!(", "include_str!(", "include_bytes!("];
    let calls = words.iter().flat_map(|word| text.split(word).skip(1));
    let names = calls.filter_map(|rest| rest.trim_start().strip_prefix('"')?.split_once('"'));
    names.map(|(name, _)| PathBuf::from(name)).collect()
}

/// Of the files' paths and bytes.
pub fn hash(root: &Path, files: &BTreeSet<PathBuf>) -> io::Result<u64> {
    let mut hash = Fnv::default();
    for file in files {
        hash.add(file.to_string_lossy().as_bytes());
        hash.add(&read(&root.join(file))?);
    }
    Ok(hash.0)
}

fn read(path: &Path) -> io::Result<Vec<u8>> {
    fs::read(path).map_err(|error| named(path, &error))
}

/// An error that says which file it is about.
fn named(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(
        error.kind(),
        format!("cannot read {}: {error}", path.display()),
    )
}

/// FNV-1a (Fowler, Noll and Vo), 64 bits.
struct Fnv(u64);

impl Default for Fnv {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Fnv {
    fn add(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
}
