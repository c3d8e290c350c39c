//! The hashes of the source that `build.rs` makes: what changes them and what does not.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

use std::fs;
use std::path::{Path, PathBuf};

#[allow(dead_code, reason = "Cargo calls its main, not this test")]
#[path = "../build.rs"]
mod build;

/// A small source tree.
struct Tree(tempfile::TempDir);

impl Tree {
    fn planted() -> Self {
        let tree = Self(tempfile::tempdir().unwrap());
        tree.write("src/lib.rs", "mod map;");
        tree.write("src/map/mod.rs", "include_str!( \"table.txt\");");
        tree.write("src/map/table.txt", "1 2 3");
        tree.write("src/map/ray.wgsl", "fn ray() {}");
        tree.write("src/commands/compare/execute.rs", "fn execute() {}");
        tree
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    fn hash(&self) -> u64 {
        let files = build::sources(self.0.path(), &["src"]).unwrap();
        build::hash(self.0.path(), &files).unwrap()
    }
}

#[test]
fn what_results_follow_from_changes_the_hash() {
    for name in [
        "src/map/mod.rs",
        "src/map/ray.wgsl",
        "src/map/table.txt",
        "src/commands/compare/execute.rs",
        "src/commands/compare/plan.rs",
        "src/map/new.rs",
    ] {
        let tree = Tree::planted();
        let before = tree.hash();
        tree.write(name, "another");
        assert_ne!(tree.hash(), before, "{name}");
    }
}

#[test]
fn what_only_shows_or_tests_and_what_editors_leave_does_not() {
    let tree = Tree::planted();
    let before = tree.hash();
    for name in [
        "src/reporting/page.rs",
        "src/plotting/path.rs",
        "src/commands/compare/page.rs",
        "src/commands/compare/pictures.rs",
        "src/commands/compare/collect.rs",
        "src/commands/compare/jobs.rs",
        "src/map/tests.rs",
        "src/map/seam_tests.rs",
        "src/map/.mod.rs.swp",
        "src/map/mod.rs~",
        "src/map/notes.txt",
        "src/.DS_Store",
    ] {
        tree.write(name, "another");
        assert_eq!(tree.hash(), before, "{name}");
    }
    #[cfg(unix)]
    {
        let lock = tree.path("src/map/.#mod.rs");
        std::os::unix::fs::symlink("someone@somewhere.1234", lock).unwrap();
        assert_eq!(tree.hash(), before, "a lock of an editor");
    }
}

#[cfg(unix)]
#[test]
fn a_source_that_cannot_be_read_is_told_by_its_path() {
    let tree = Tree::planted();
    std::os::unix::fs::symlink("nowhere.rs", tree.path("src/map/lost.rs")).unwrap();
    let told = build::sources(tree.0.path(), &["src"])
        .unwrap_err()
        .to_string();
    assert!(told.contains("src/map/lost.rs"), "{told}");
}

#[test]
fn what_is_exempt_and_what_drives_follow_from_is_there() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for place in build::SHOWING.iter().chain(&build::OF_DRIVES) {
        assert!(root.join(place).exists(), "{place}");
    }
}

/// Or a change in a module that the list forgot would leave old drives in place.
#[test]
fn drives_follow_from_no_module_that_their_hash_leaves_out() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let library = build::OF_DRIVES
        .iter()
        .filter(|place| !place.contains("commands"));
    let library: Vec<&str> = library.copied().collect();
    let files = build::sources(root, &library).unwrap();
    assert!(files.len() > 40, "{files:?}");
    for file in files {
        let text = fs::read_to_string(root.join(&file)).unwrap();
        let code = text
            .lines()
            .filter(|line| !line.trim_start().starts_with("//"));
        for line in code {
            for rest in line.split("crate::").skip(1) {
                let end = rest.find(|c: char| !(c.is_alphanumeric() || c == '_'));
                let module = &rest[..end.unwrap_or(rest.len())];
                let place = format!("src/{module}");
                let is_listed = library.contains(&place.as_str());
                assert!(is_listed, "{} uses {module}: {line}", file.display());
            }
        }
    }
}
