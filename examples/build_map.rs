//! Builds a map from a recording in KITTI layout:
//! `cargo run --release --example build_map -- RECORDING MAP.ply`.

#![allow(clippy::print_stdout, reason = "examples print their result")]

use std::path::PathBuf;

use fpmcl::map::{MapBuilder, MapConfig};
use fpmcl::recording::Recording;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [recording, map_file] = arguments.as_slice() else {
        return Err("usage: build_map RECORDING MAP.ply".into());
    };
    let drive = Recording::open(recording)?.with_own_poses()?;
    let map = MapBuilder::new(MapConfig::default()).build(drive.scans_with_poses())?;
    map.save(map_file)?;
    println!(
        "{} triangles, {} key scans",
        map.triangle_count(),
        map.path.map_from_lidar.len()
    );
    Ok(())
}
