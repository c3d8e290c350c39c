//! The layers and the absences that make the tree readable, checked over the source text.
//!
//! Imports point only upwards in the list of `src/lib.rs`; some crates and some powers (making
//! a random generator, printing, opening files) belong to one place each.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

use std::fs;
use std::path::{Path, PathBuf};

/// Each layer may import those before it; the modules of one layer do not import each other. The list
/// of `src/lib.rs` in the same order.
const LAYERS: [&[&str]; 7] = [
    &["files", "geometry", "random", "validation"],
    &["lidar", "raycasting"],
    &["ground", "meshing", "recording", "rendering"],
    &["map", "registration", "simulation"],
    &["evaluation", "localization"],
    &["refinement"],
    &["app", "main"],
];

/// Who belongs together on top and may see each other.
const TOP: &[&str] = &["app", "main"];

/// A text that only some files may contain, and why.
struct Absence {
    words: &'static [&'static str],
    allowed: &'static [&'static str],
    reason: &'static str,
}

const ABSENCES: [Absence; 8] = [
    Absence {
        words: &["wgpu::", "use wgpu", "pollster::"],
        allowed: &["rendering/gpu"],
        reason: "graphics stay in rendering/gpu",
    },
    Absence {
        words: &["plotters::", "use plotters"],
        allowed: &["app/plotting"],
        reason: "drawing stays in plotting",
    },
    Absence {
        words: &["npyz::", "use npyz", "zip::", "use zip"],
        allowed: &["app/results"],
        reason: "NumPy's file formats stay in results",
    },
    Absence {
        words: &["clap::", "use clap"],
        allowed: &["app/cli.rs", "main.rs"],
        reason: "the command line stays in cli.rs and main.rs",
    },
    Absence {
        words: &["anyhow::", "use anyhow", "anyhow!"],
        allowed: &["app", "main.rs"],
        reason: "the library has typed errors",
    },
    Absence {
        words: &[
            "println!",
            "eprintln!",
            "print!(",
            "io::stdout",
            "io::stderr",
            "::rng()",
            "from_os_rng",
            "from_entropy",
            "from_rng(",
            "thread_rng",
            "OsRng",
            "SysRng",
        ],
        allowed: &["app/commands"],
        reason: "randomness that no seed gives, and printing, stay in commands",
    },
    Absence {
        words: &["SeedableRng", "seed_from_u64", "from_seed("],
        allowed: &[
            "app/commands",
            // The numbered streams of a seed.
            "random.rs",
            // Streets, drives and scans are made by many threads at once: every piece draws from
            // a stream of its own that follows from the seed, the purpose and the piece's number.
            "simulation/random.rs",
            // A classifier is shared by threads: it must say the same of a scan whoever asks.
            "ground/ransac.rs",
        ],
        reason: "generators are made in commands and handed down, or the seed's streams in one place",
    },
    Absence {
        words: &[
            "File::open",
            "File::create",
            "OpenOptions",
            "fs::read",
            "fs::write",
            "read_to_string(path",
            "NamedTempFile",
            "tempfile_in",
        ],
        allowed: &["files.rs", "recording", "map/ply.rs", "app"],
        reason: "files are opened only at the edges",
    },
];

/// A source file: its path below `src`, and its lines without comments and tests.
struct Source {
    path: PathBuf,
    lines: Vec<(usize, String)>,
}

impl Source {
    /// The module at the top of the tree that the file belongs to.
    fn module(&self) -> String {
        let first = self.path.iter().next().unwrap().to_str().unwrap();
        first.trim_end_matches(".rs").to_owned()
    }

    fn is_below(&self, places: &[&str]) -> bool {
        places.iter().any(|place| {
            self.path.starts_with(place) || self.path.with_extension("").starts_with(place)
        })
    }
}

fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut sources = Vec::new();
    let mut test_modules = Vec::new();
    let mut folders = vec![root.clone()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let text = fs::read_to_string(&path).unwrap();
                let path = path.strip_prefix(&root).unwrap().to_owned();
                test_modules.extend(test_modules_of(&path, &text));
                sources.push(Source {
                    lines: product_lines(&text),
                    path,
                });
            }
        }
    }
    sources.retain(|source| {
        let module = source.path.with_extension("");
        !test_modules.iter().any(|test| module.starts_with(test))
    });
    sources.sort_by(|a, b| a.path.cmp(&b.path));
    sources
}

/// The modules in files of their own that a file declares for tests only.
fn test_modules_of(path: &Path, text: &str) -> Vec<PathBuf> {
    let is_root = path.ends_with("mod.rs") || path.ends_with("lib.rs");
    let folder = if is_root {
        path.parent().unwrap().to_owned()
    } else {
        path.with_extension("")
    };
    let mut lines = text.lines().map(str::trim);
    let mut modules = Vec::new();
    while lines.by_ref().any(|line| line == "#[cfg(test)]") {
        let mut item = lines.next().unwrap_or_default();
        let elsewhere = item
            .strip_prefix("#[path = \"")
            .and_then(|rest| rest.strip_suffix(".rs\"]"));
        if elsewhere.is_some() {
            item = lines.next().unwrap_or_default();
        }
        let declared = item
            .strip_suffix(';')
            .and_then(|item| item.rsplit_once("mod "));
        if let Some((_, name)) = declared {
            modules.push(match elsewhere {
                Some(file) => path.with_file_name(file),
                None => folder.join(name),
            });
        }
    }
    modules
}

/// The numbered lines of a file without comments and without what is compiled for tests only.
fn product_lines(text: &str) -> Vec<(usize, String)> {
    let mut product = Vec::new();
    let mut in_test = None;
    let mut depth = 0_i32;
    for (number, line) in (1..).zip(text.lines()) {
        let code = line.split("//").next().unwrap_or_default();
        if line.trim_start().starts_with("#[cfg(test)]") {
            in_test = Some(depth);
        }
        let before = depth;
        depth += code.matches('{').count() as i32 - code.matches('}').count() as i32;
        match in_test {
            Some(outer) => {
                // The item ends with its closing brace, or at once if it has no body.
                let closed = before > outer && depth <= outer;
                let one_line = before == outer && depth == outer && code.ends_with([';', '}']);
                if closed || one_line {
                    in_test = None;
                }
            }
            None => product.push((number, code.to_owned())),
        }
    }
    product
}

/// The modules that a line names as `crate::module`, also in `use crate::{a::b, c::d}`.
fn imported(line: &str) -> Vec<String> {
    let known = |name: &str| {
        LAYERS
            .iter()
            .flat_map(|layer| layer.iter())
            .any(|m| *m == name)
    };
    let mut found = Vec::new();
    for part in ["crate::", "fpmcl::"] {
        for (start, _) in line.match_indices(part) {
            let rest = &line[start + part.len()..];
            if let Some(group) = rest.strip_prefix('{') {
                let names = group.split(',').map(|item| first_word(item.trim()));
                found.extend(names.filter(|name| known(name)).map(str::to_owned));
            } else if known(first_word(rest)) {
                found.push(first_word(rest).to_owned());
            }
        }
    }
    found
}

fn first_word(text: &str) -> &str {
    let end = text.find(|c: char| !(c.is_alphanumeric() || c == '_'));
    &text[..end.unwrap_or(text.len())]
}

fn layer_of(module: &str) -> Option<usize> {
    LAYERS.iter().position(|layer| layer.contains(&module))
}

/// Why a module may not import another, if it may not.
fn objection(module: &str, other: &str) -> Option<String> {
    let (Some(own), Some(theirs)) = (layer_of(module), layer_of(other)) else {
        return Some(format!("{module} has no layer; add it to LAYERS"));
    };
    let fine = module == other || theirs < own || (TOP.contains(&module) && TOP.contains(&other));
    (!fine).then(|| format!("{module} may not know {other}"))
}

fn layer_violations(sources: &[Source]) -> Vec<String> {
    let mut violations = Vec::new();
    for source in sources {
        let module = source.module();
        if module == "lib" {
            continue;
        }
        for (number, line) in &source.lines {
            for other in imported(line) {
                if let Some(objection) = objection(&module, &other) {
                    violations.push(format!(
                        "src/{}:{number}: {objection}: {}",
                        source.path.display(),
                        line.trim()
                    ));
                }
            }
        }
    }
    violations
}

fn absence_violations(sources: &[Source]) -> Vec<String> {
    let mut violations = Vec::new();
    for absence in &ABSENCES {
        for source in sources.iter().filter(|it| !it.is_below(absence.allowed)) {
            for (number, line) in &source.lines {
                if absence.words.iter().any(|word| line.contains(word)) {
                    violations.push(format!(
                        "src/{}:{number}: {}: {}",
                        source.path.display(),
                        absence.reason,
                        line.trim()
                    ));
                }
            }
        }
    }
    violations
}

fn source(path: &str, text: &str) -> Source {
    Source {
        path: path.into(),
        lines: product_lines(text),
    }
}

#[test]
fn imports_point_upwards() {
    let violations = layer_violations(&sources());
    assert!(violations.is_empty(), "{}", violations.join("\n"));
}

#[test]
fn crates_and_powers_stay_in_their_places() {
    let violations = absence_violations(&sources());
    assert!(violations.is_empty(), "{}", violations.join("\n"));
}

#[test]
fn every_module_of_the_library_has_a_layer() {
    for source in sources() {
        let module = source.module();
        assert!(module == "lib" || layer_of(&module).is_some(), "{module}");
    }
}

#[test]
fn the_front_page_lists_the_layers_in_their_order() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = fs::read_to_string(root.join("src/lib.rs")).unwrap();
    let mut listed: Vec<Vec<&str>> = Vec::new();
    for line in text.lines() {
        if line.starts_with("// ") {
            listed.push(Vec::new());
        }
        let module = line.strip_prefix("pub mod ");
        if let Some(module) = module.and_then(|rest| rest.strip_suffix(';')) {
            listed.last_mut().unwrap().push(module);
        }
    }
    let mut layers = LAYERS.map(<[&str]>::to_vec);
    layers[LAYERS.len() - 1].retain(|module| *module != "main");
    assert_eq!(listed, layers);
    for module in layers.iter().flatten() {
        let in_table = format!("`{module}`");
        assert!(
            text.contains(&in_table),
            "the table of layers lacks {module}"
        );
    }
}

#[test]
fn a_wrong_import_is_told_with_file_and_line() {
    let told = |path, text| layer_violations(&[source(path, text)]);
    assert_eq!(
        told("recording/poses.rs", "\nuse crate::ground::Fuzzy;\n"),
        ["src/recording/poses.rs:2: recording may not know ground: use crate::ground::Fuzzy;"]
    );
    assert_eq!(
        told("map/mod.rs", "use crate::{lidar::Scan, localization::X};").len(),
        1
    );
    assert_eq!(
        told("lidar/mod.rs", "fn f() { crate::map::build() }").len(),
        1
    );
    assert!(told("map/mod.rs", "use crate::rendering::Backend;").is_empty());
    assert!(told("map/mod.rs", "// as crate::app::commands does\n").is_empty());
}

#[test]
fn modules_for_tests_are_found_wherever_they_lie() {
    let text = "mod a;\n#[cfg(test)]\npub(crate) mod b;\n\n#[cfg(test)]\n\
                #[path = \"elsewhere.rs\"]\nmod c;\n#[cfg(test)]\nmod d {}\n";
    assert_eq!(
        test_modules_of(Path::new("map/tiles.rs"), text),
        [Path::new("map/tiles/b"), Path::new("map/elsewhere")]
    );
    assert_eq!(
        test_modules_of(Path::new("map/mod.rs"), text)[0],
        Path::new("map/b")
    );
}

#[test]
fn a_word_in_the_wrong_place_is_told_and_tests_are_exempt() {
    let told = |path, text| absence_violations(&[source(path, text)]);
    assert_eq!(told("map/tiles.rs", "let f = File::open(path)?;").len(), 1);
    assert!(told("map/ply.rs", "let f = File::open(path)?;").is_empty());
    assert_eq!(told("rendering/cpu.rs", "use wgpu::Device;").len(), 1);
    assert!(told("rendering/gpu/mod.rs", "use wgpu::Device;").is_empty());
    let test = "#[cfg(test)]\nmod tests {\n    fn f() { fs::read(p) }\n}\nfn g() { fs::read(p) }\n";
    assert_eq!(
        told("map/tiles.rs", test),
        ["src/map/tiles.rs:5: files are opened only at the edges: fn g() { fs::read(p) }"]
    );
}
