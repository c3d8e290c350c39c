//! The folder of the tiles of a map: only files that the program wrote are read, replaced or removed.

use std::fs;
use std::path::PathBuf;

use crate::common::{Fpmcl, Recording, fpmcl};

fn mapped() -> Recording {
    let recording = Recording::street(4);
    recording.fpmcl("build-map").succeeds();
    recording
}

/// The tiles of the map, sorted by name.
fn tiles(recording: &Recording) -> Vec<PathBuf> {
    let entries = fs::read_dir(recording.path("map.ply.tiles")).unwrap();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|it| it == "tile"));
    paths.sort();
    paths
}

#[test]
fn files_of_others_among_the_tiles_are_kept_and_the_map_is_localized_without_a_cache() {
    let recording = mapped();
    fs::remove_dir_all(recording.path("map.ply.tiles")).unwrap();
    fs::create_dir(recording.path("map.ply.tiles")).unwrap();
    let own = ["index", "5_5.12345678.tile", "panoramas-0.1.panoramas"];
    for name in own {
        recording.write(&format!("map.ply.tiles/{name}"), "my own");
    }
    let output = recording.fpmcl("localize").succeeds();
    assert!(output.stderr.contains("not a file that fpmcl wrote"));
    fs::remove_file(recording.path("map.ply.tiles/index")).unwrap();
    recording.fpmcl("localize").with("--force").succeeds();
    assert!(recording.path("map.ply.tiles/index").exists());
    for name in &own[1..] {
        assert_eq!(recording.bytes(&format!("map.ply.tiles/{name}")), b"my own");
    }
}

#[cfg(unix)]
#[test]
fn links_in_place_of_the_tiles_are_not_followed() {
    use std::os::unix::fs::symlink;

    let recording = mapped();
    let folder = recording.path("map.ply.tiles");
    fs::remove_dir_all(&folder).unwrap();
    fs::create_dir(recording.path("elsewhere")).unwrap();
    symlink(recording.path("elsewhere"), &folder).unwrap();
    let output = recording.fpmcl("localize").succeeds();
    assert!(output.stderr.contains("it is a link"), "{}", output.stderr);
    assert_eq!(
        fs::read_dir(recording.path("elsewhere")).unwrap().count(),
        0
    );
    fs::remove_file(&folder).unwrap();
    fs::create_dir(&folder).unwrap();
    recording.write("mine", "my own");
    symlink(recording.path("mine"), folder.join("index")).unwrap();
    recording.fpmcl("localize").with("--force").succeeds();
    assert!(
        fs::symlink_metadata(folder.join("index"))
            .unwrap()
            .is_symlink()
    );
    assert_eq!(recording.bytes("mine"), b"my own");
}

#[test]
fn a_tile_that_was_cut_short_does_not_stay() {
    let recording = mapped();
    recording.fpmcl("localize").succeeds();
    let tile = &tiles(&recording)[0];
    let whole = fs::read(tile).unwrap();
    for length in [0, 100, whole.len() / 2, whole.len() - 1] {
        // Files that may be mapped are replaced as a whole.
        fs::remove_file(tile).unwrap();
        fs::write(tile, &whole[..length]).unwrap();
        recording.fpmcl("localize").with("--force").succeeds();
        assert_eq!(fs::read(tile).unwrap(), whole, "{length} bytes");
    }
}

#[test]
fn info_shows_the_cache_of_a_map_and_clears_it() {
    let recording = mapped();
    recording.write("map.ply.tiles/mine.txt", "my own");
    let info = |options: &[&str]| {
        let call = fpmcl("info").in_folder(recording.folder()).with("map.ply");
        options.iter().fold(call, Fpmcl::with).succeeds().stdout
    };
    let shown = info(&[]);
    assert!(shown.contains("MB in map.ply.tiles"), "{shown}");
    assert!(!info(&["--clear-cache"]).contains("cache"));
    let left = fs::read_dir(recording.path("map.ply.tiles")).unwrap();
    assert_eq!(left.count(), 1);
    fpmcl("info")
        .in_folder(recording.folder())
        .with("velodyne")
        .with("--clear-cache")
        .fails_with(&["not a map", "leave out --clear-cache"]);
}
