//! Builds a map from a recording, with or without poses, of any sensor:
//! `cargo run --release --example build_map -- RECORDING MAP.ply`.

#![allow(clippy::print_stdout, reason = "examples print their result")]

use std::path::PathBuf;

use fpmcl::map::MapConfig;
use fpmcl::mapping::build_map;
use fpmcl::recording::Recording;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [recording, map_file] = arguments.as_slice() else {
        return Err("usage: build_map RECORDING MAP.ply".into());
    };
    let map = build_map(&Recording::open(recording)?, &MapConfig::default())?;
    map.save(map_file)?;
    println!(
        "{} triangles, {} key scans",
        map.triangle_count(),
        map.path.map_from_lidar.len()
    );
    Ok(())
}
