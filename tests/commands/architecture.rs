//! The structure of the source tree, checked over the source text.
//!
//! A module imports only modules of the layers above its own in `src/lib.rs`, and in `src/app/mod.rs` for the
//! rooms of the program, no two files import each
//! other, directly or through others, and some crates and operations (random generators, printing,
//! opening files) are confined to one place each.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Words that only the allowed files may contain, and why.
struct Restriction {
    words: &'static [&'static str],
    allowed: &'static [&'static str],
    reason: &'static str,
}

const RESTRICTIONS: [Restriction; 14] = [
    Restriction {
        words: &["memmap2::", "use memmap2"],
        allowed: &["shared_bytes.rs"],
        reason: "files are mapped into memory in one place",
    },
    Restriction {
        words: &["wgpu::", "use wgpu", "pollster::"],
        allowed: &["rendering/gpu"],
        reason: "the graphics API is confined to rendering/gpu",
    },
    Restriction {
        words: &["plotters::", "use plotters"],
        allowed: &["app/report/plotting"],
        reason: "drawing is confined to plotting",
    },
    Restriction {
        words: &["npyz::", "use npyz"],
        allowed: &["app/report/results", "recording/scan_files/npy.rs"],
        reason: "NumPy's arrays are confined to results and scans",
    },
    Restriction {
        words: &["zip::", "use zip"],
        allowed: &["app/report/results"],
        reason: "archives are confined to results",
    },
    Restriction {
        words: &["proj4rs::", "use proj4rs"],
        allowed: &["georeference"],
        reason: "projections are confined to the georeference",
    },
    Restriction {
        words: &["nmea::", "use chrono", "chrono::"],
        allowed: &["recording/fixes"],
        reason: "sentences of receivers are confined to their reader",
    },
    Restriction {
        words: &["rusqlite::", "ruzstd::", "lz4_flex::", "bzip2::"],
        allowed: &["recording/bags"],
        reason: "databases and compressions are confined to bags",
    },
    Restriction {
        words: &["rustdds::", "use rustdds"],
        allowed: &["app/commands/live/ros2"],
        reason: "DDS is confined to the node of ROS 2",
    },
    Restriction {
        words: &["clap::", "use clap"],
        allowed: &["app"],
        reason: "the command line is confined to app",
    },
    Restriction {
        words: &["anyhow::", "use anyhow", "anyhow!"],
        allowed: &["app"],
        reason: "the library has typed errors",
    },
    Restriction {
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
        allowed: &["app/commands", "app/run"],
        reason: "printing and unseeded randomness are confined to commands",
    },
    Restriction {
        words: &["SeedableRng", "seed_from_u64", "from_seed("],
        allowed: &[
            "app/commands",
            "app/run",
            "random.rs",
            // Threads that share the work draw from independent streams of the seed.
            "simulation/random.rs",
            // The classifier is shared by threads: equal scans give equal results.
            "ground/ransac.rs",
        ],
        reason: "generators are made in commands or in random and passed down",
    },
    Restriction {
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
        allowed: &[
            "recording",
            "map/files/ply.rs",
            "map/files/mesh_file.rs",
            "map/tiles/contents.rs",
            "map/tiles/store.rs",
            "map/places/panorama_file.rs",
            "files.rs",
            "shared_bytes.rs",
            // Whole files, within the budget.
            "memory.rs",
            "app",
        ],
        reason: "files are opened only in recording, the readers of meshes and tiles, files.rs, memory.rs, shared_bytes.rs and app",
    },
];

/// A source file: its path below `src`, and its lines without comments and tests.
struct Source {
    path: PathBuf,
    lines: Vec<(usize, String)>,
}

impl Source {
    fn new(path: impl Into<PathBuf>, text: &str) -> Self {
        Self {
            path: path.into(),
            lines: product_lines(text),
        }
    }

    /// The path of the module that the file defines: empty for `lib.rs`.
    fn module(&self) -> Module {
        let mut names: Module = self
            .path
            .with_extension("")
            .iter()
            .map(|name| name.to_str().unwrap().to_owned())
            .collect();
        if matches!(names.last().unwrap().as_str(), "mod" | "lib") {
            names.pop();
        }
        names
    }

    fn is_below(&self, places: &[&str]) -> bool {
        places.iter().any(|place| self.path.starts_with(place))
    }
}

/// The names from the crate's root to a module or item.
type Module = Vec<String>;

/// A path in the source text: of a `use` declaration, or inline.
#[derive(Debug)]
struct Mention {
    names: Vec<String>,
    /// The name that a `use` declaration binds, `None` for inline paths.
    binding: Option<String>,
    is_public: bool,
    line: usize,
}

/// What one file mentions.
struct Mentions {
    paths: Vec<Mention>,
    /// All identifiers outside `use` declarations.
    identifiers: BTreeSet<String>,
}

/// The words, `::` and punctuation of the lines, without strings, characters and lifetimes.
fn tokens(lines: &[(usize, String)]) -> Vec<(usize, String)> {
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let mut tokens = Vec::new();
    for (number, line) in lines {
        let mut rest = line.as_str();
        while let Some(first) = rest.chars().next() {
            let length = if is_word(first) {
                let end = rest.find(|c| !is_word(c)).unwrap_or(rest.len());
                tokens.push((*number, rest[..end].to_owned()));
                end
            } else if first == '"' {
                let escaped = rest.replace("\\\\", "__").replace("\\\"", "__");
                escaped[1..].find('"').map_or(rest.len(), |end| end + 2)
            } else if first == '\'' {
                let character = if rest[1..].starts_with('\\') { 2 } else { 1 };
                let close = rest.char_indices().nth(character + 1);
                match close {
                    Some((end, '\'')) => end + 1,
                    // A lifetime.
                    _ => 1 + rest[1..].find(|c| !is_word(c)).unwrap_or(rest.len() - 1),
                }
            } else if rest.starts_with("::") {
                tokens.push((*number, "::".to_owned()));
                2
            } else {
                if !first.is_whitespace() {
                    tokens.push((*number, first.to_string()));
                }
                first.len_utf8()
            };
            rest = &rest[length..];
        }
    }
    tokens
}

fn mentions(source: &Source) -> Mentions {
    let tokens = tokens(&source.lines);
    let word = |at: usize| tokens.get(at).map_or("", |(_, word)| word.as_str());
    let is_name = |at: usize| word(at).starts_with(|c: char| c.is_alphabetic() || c == '_');
    let mut paths = Vec::new();
    let mut identifiers = BTreeSet::new();
    let mut at = 0;
    while at < tokens.len() {
        if word(at) == "use" && word(at + 1) != "<" {
            let is_public = at > 0 && matches!(word(at - 1), "pub" | ")");
            let end = (at..tokens.len()).find(|i| word(*i) == ";").unwrap();
            use_tree(&tokens[at + 1..end], &[], is_public, &mut paths);
            at = end;
        } else if is_name(at) {
            let mut names = vec![word(at).to_owned()];
            let line = tokens[at].0;
            while word(at + 1) == "::" && is_name(at + 2) {
                at += 2;
                names.push(word(at).to_owned());
            }
            identifiers.insert(names[0].clone());
            if names.len() > 1 {
                paths.push(Mention {
                    names,
                    binding: None,
                    is_public: false,
                    line,
                });
            }
        }
        at += 1;
    }
    Mentions { paths, identifiers }
}

/// Collects the paths of a `use` declaration: `a::{b, c::d as e}` gives `a::b` and `a::c::d`.
fn use_tree(
    tokens: &[(usize, String)],
    prefix: &[String],
    is_public: bool,
    paths: &mut Vec<Mention>,
) {
    let mut depth = 0;
    let branches = tokens.split(|(_, word)| {
        depth += i32::from(word == "{") - i32::from(word == "}");
        depth == 0 && word == ","
    });
    for branch in branches.filter(|branch| !branch.is_empty()) {
        let words: Vec<&str> = branch.iter().map(|(_, word)| word.as_str()).collect();
        if let Some(open) = words.iter().position(|word| *word == "{") {
            let names = words[..open].iter().filter(|word| **word != "::");
            let prefix = [
                prefix,
                &names.map(|name| name.to_string()).collect::<Vec<_>>(),
            ]
            .concat();
            use_tree(
                &branch[open + 1..branch.len() - 1],
                &prefix,
                is_public,
                paths,
            );
            continue;
        }
        let (path, alias) = match words.iter().position(|word| *word == "as") {
            Some(position) => (&words[..position], Some(words[position + 1])),
            None => (words.as_slice(), None),
        };
        let mut names = prefix.to_vec();
        names.extend(
            path.iter()
                .filter(|word| **word != "::")
                .map(|word| word.to_string()),
        );
        // `a::{self}` and `a::*` import `a`.
        if names.len() > 1 && matches!(names.last().unwrap().as_str(), "self" | "*") {
            names.pop();
        }
        paths.push(Mention {
            binding: Some(alias.unwrap_or(names.last().unwrap()).to_owned()),
            names,
            is_public,
            line: branch[0].0,
        });
    }
}

/// The files of the crate and the paths that they mention, by module.
struct Crate {
    files: BTreeMap<Module, (PathBuf, Mentions)>,
}

/// File `from` imports file `to` in a line.
struct Import {
    from: Module,
    to: Module,
    line: usize,
}

impl Crate {
    fn new(sources: &[Source]) -> Self {
        let files = sources
            .iter()
            .map(|source| (source.module(), (source.path.clone(), mentions(source))))
            .collect();
        Self { files }
    }

    /// The module that defines what `names` mean in `module`, `None` for other crates.
    fn resolve(&self, module: &Module, names: &[String], depth: usize) -> Option<Module> {
        let mut names = names;
        let mut place = match names[0].as_str() {
            "crate" | "fpmcl" => Module::new(),
            "self" => module.clone(),
            "super" => module[..module.len() - 1].to_vec(),
            first if self.files.contains_key(&child(module, first)) => child(module, first),
            first => {
                let uses = &self.files[module].1.paths;
                let binding = uses.iter().find(|it| it.binding.as_deref() == Some(first));
                self.resolve(module, &binding?.names, depth.checked_sub(1)?)?
            }
        };
        names = &names[1..];
        while let Some(name) = names.first() {
            if name == "super" {
                place.pop();
            } else if self.files.contains_key(&child(&place, name)) {
                place.push(name.clone());
            } else {
                let uses = &self.files[&place].1.paths;
                let binding = uses.iter().find(|it| it.binding.as_ref() == Some(name));
                match binding.filter(|_| depth > 0) {
                    // Another crate's item that this module imports counts as this module's.
                    Some(it) => match self.resolve(&place, &it.names, depth - 1) {
                        Some(target) => place = target,
                        None => return Some(place),
                    },
                    None => return Some(place),
                }
            }
            names = &names[1..];
        }
        Some(place)
    }

    fn imports(&self) -> Vec<Import> {
        let mut imports = Vec::new();
        for (module, (_, mentions)) in &self.files {
            for it in &mentions.paths {
                let Some(to) = self.resolve(module, &it.names, 4) else {
                    continue;
                };
                // A child's item that is only passed on is no import.
                let is_used = it
                    .binding
                    .as_ref()
                    .is_none_or(|name| mentions.identifiers.contains(name));
                let is_passed_on = it.is_public && to.starts_with(module) && !is_used;
                if to != *module && !is_passed_on {
                    imports.push(Import {
                        from: module.clone(),
                        to,
                        line: it.line,
                    });
                }
            }
        }
        imports
    }

    fn describe(&self, import: &Import) -> String {
        let path = |module| self.files[module].0.display();
        let Import { from, to, line } = import;
        format!("src/{}:{line} imports src/{}", path(from), path(to))
    }

    /// The imports between files that import each other, directly or through others.
    fn cycles(&self) -> Vec<String> {
        let imports = self.imports();
        let mut reached: BTreeMap<&Module, BTreeSet<&Module>> = BTreeMap::new();
        for start in self.files.keys() {
            let mut open = vec![start];
            let mut seen = BTreeSet::new();
            while let Some(from) = open.pop() {
                for import in imports.iter().filter(|it| it.from == *from) {
                    if seen.insert(&import.to) {
                        open.push(&import.to);
                    }
                }
            }
            reached.insert(start, seen);
        }
        let mut cyclic: Vec<_> = imports
            .iter()
            .filter(|it| reached[&it.to].contains(&it.from))
            // All files of one cycle reach the same files of it; the first of them names it.
            .map(|it| {
                let group = reached[&it.from]
                    .iter()
                    .find(|m| reached[**m].contains(&it.from));
                (group, self.describe(it))
            })
            .collect();
        cyclic.sort();
        cyclic.dedup();
        cyclic.into_iter().map(|(_, text)| text).collect()
    }

    /// The imports between the modules of one layer, or from a layer below, inside a room: the crate, or a module.
    fn layer_violations(&self, room: &[String], layers: &[Vec<String>]) -> Vec<String> {
        let name = |module: &Module| module.strip_prefix(room)?.first().cloned();
        let layer = |name: &String| layers.iter().position(|layer| layer.contains(name));
        let is_wrong = |import: &&Import| match name(&import.from) {
            Some(from) if import.to.starts_with(room) => {
                let to = name(&import.to);
                let to_layer = to.as_ref().and_then(layer);
                let is_below = || to_layer.is_some_and(|to| Some(to) < layer(&from));
                layer(&from).is_some() && to.as_ref() != Some(&from) && !is_below()
            }
            // The root of a room may import everything, and the room around it has a law of its own.
            _ => false,
        };
        let imports = self.imports();
        let wrong = imports.iter().filter(is_wrong);
        let mut texts: Vec<String> = wrong.map(|it| self.describe(it)).collect();
        texts.dedup();
        texts
    }
}

fn child(module: &Module, name: &str) -> Module {
    [module.as_slice(), &[name.to_owned()]].concat()
}

/// The layers of `lib.rs`: the modules under each heading.
fn layers(lib: &str) -> Vec<Vec<String>> {
    let mut layers: Vec<Vec<String>> = Vec::new();
    for line in lib.lines() {
        if line.starts_with("// ") {
            layers.push(Vec::new());
        } else if let Some(module) = line.trim_start_matches("pub ").strip_prefix("mod ") {
            // A body in place of the semicolon makes no layer.
            if let Some(module) = module.strip_suffix(';') {
                layers.last_mut().unwrap().push(module.to_owned());
            }
        }
    }
    layers
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
                sources.push(Source::new(path, &text));
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
        let attributes = ["#[cfg(test)]", "#[cfg(all(test,"];
        if attributes
            .iter()
            .any(|it| line.trim_start().starts_with(it))
        {
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

fn violations(sources: &[Source]) -> Vec<String> {
    let mut violations = Vec::new();
    for restriction in &RESTRICTIONS {
        let others = sources
            .iter()
            .filter(|it| !it.is_below(restriction.allowed));
        for source in others {
            for (number, line) in &source.lines {
                if restriction.words.iter().any(|word| line.contains(word)) {
                    violations.push(format!(
                        "src/{}:{number}: {}: {}",
                        source.path.display(),
                        restriction.reason,
                        line.trim()
                    ));
                }
            }
        }
    }
    violations
}

/// The lines of the library with a flag of the command line or a configuration file of the program.
fn lines_of_the_program(sources: &[Source]) -> Vec<String> {
    let is_flag = |line: &str| {
        let mut after = line.match_indices("--").map(|(at, _)| &line[at + 2..]);
        after.any(|rest| rest.starts_with(|c: char| c.is_ascii_alphabetic()))
    };
    let library = sources
        .iter()
        .filter(|it| !it.is_below(&["app", "main.rs"]));
    let lines = library.flat_map(|source| source.lines.iter().map(move |line| (source, line)));
    lines
        .filter(|(_, (_, line))| is_flag(line) || line.contains(".yml"))
        .map(|(source, (number, line))| {
            format!("src/{}:{number}: {}", source.path.display(), line.trim())
        })
        .collect()
}

fn text_of(file: &str) -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("src").join(file)).unwrap()
}

#[test]
fn modules_import_only_those_of_the_layers_above() {
    let violations = Crate::new(&sources()).layer_violations(&[], &layers(&text_of("lib.rs")));
    assert!(violations.is_empty(), "{}", violations.join("\n"));
}

#[test]
fn the_rooms_of_the_program_import_only_those_of_the_layers_above() {
    let layers = layers(&text_of("app/mod.rs"));
    assert_eq!(layers.len(), 6);
    let violations = Crate::new(&sources()).layer_violations(&["app".to_owned()], &layers);
    assert!(violations.is_empty(), "{}", violations.join("\n"));
}

#[test]
fn the_table_of_the_front_page_lists_the_layers() {
    let lib = text_of("lib.rs");
    let table = lib
        .lines()
        .skip_while(|line| *line != "//! | layer | modules |");
    let rows = table.skip(2).take_while(|line| line.starts_with("//! |"));
    let names_of = |row: &str| -> Vec<String> {
        let names = row.split('`').skip(1).step_by(2);
        names
            .filter(|name| *name != "cli")
            .map(str::to_owned)
            .collect()
    };
    assert_eq!(rows.map(names_of).collect::<Vec<_>>(), layers(&lib));
}

#[test]
fn modules_inside_the_modules_of_the_library_are_private() {
    let mut public = sources();
    public.retain(|it| !it.is_below(&["app", "simulation", "lib.rs"]));
    public.retain(|it| {
        it.lines
            .iter()
            .any(|(_, line)| line.trim_start().starts_with("pub mod "))
    });
    let public: Vec<_> = public
        .iter()
        .map(|it| it.path.display().to_string())
        .collect();
    assert!(public.is_empty(), "{}", public.join("\n"));
}

#[test]
fn users_of_the_library_do_not_compile_the_simulation() {
    let declaration = "#[cfg(feature = \"simulation\")]\npub mod simulation;";
    assert!(text_of("lib.rs").contains(declaration));
    let users: Vec<PathBuf> = sources()
        .into_iter()
        .filter(|it| !it.is_below(&["app", "simulation"]))
        .filter(|it| {
            it.lines
                .iter()
                .any(|(_, line)| line.contains("simulation::"))
        })
        .map(|it| it.path)
        .collect();
    assert!(users.is_empty(), "{users:?}");
}

#[test]
fn the_python_package_uses_the_library_and_no_module_of_the_program() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/src");
    let files: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    assert!(files.len() > 5, "{files:?}");
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        assert!(!text.contains("fpmcl::app"), "{}", file.display());
    }
}

#[test]
fn no_files_import_each_other() {
    let cycles = Crate::new(&sources()).cycles();
    assert!(cycles.is_empty(), "{}", cycles.join("\n"));
}

#[test]
fn crates_and_operations_are_confined() {
    let violations = violations(&sources());
    assert!(violations.is_empty(), "{}", violations.join("\n"));
}

fn crate_of(files: &[(&str, &str)]) -> Crate {
    let sources = files.iter().map(|(path, text)| Source::new(path, text));
    Crate::new(&sources.collect::<Vec<_>>())
}

#[test]
fn the_library_names_no_flag_and_no_configuration_file_of_the_program() {
    let lines = lines_of_the_program(&sources());
    assert!(lines.is_empty(), "{}", lines.join("\n"));
    let found = |path: &str, text: &str| lines_of_the_program(&[Source::new(path, text)]).len();
    let flag = "const REMEDY: &str = \"use --backend cpu\";";
    assert_eq!(found("rendering/mod.rs", flag), 1);
    assert_eq!(found("app/run/remedy.rs", flag), 0);
    assert_eq!(found("map/mod.rs", "let text = \"a key of map.yml\";"), 1);
    assert_eq!(
        found("map/mod.rs", "// --backend\nlet text = \"-- or -1\";"),
        0
    );
}

#[test]
fn a_wrong_import_is_reported_with_file_and_line() {
    let lib = "// Values.\npub mod lidar;\npub mod poses;\n// Map.\npub mod map;\n// App.\npub mod app;\n";
    let layers = layers(lib);
    assert_eq!(layers.len(), 3);
    assert_eq!(layers[0], ["lidar", "poses"]);
    let files = [
        (
            "lidar.rs",
            "\nuse crate::{map::Tile, lidar::X};\nfn f() { crate::poses::g() }\n",
        ),
        ("poses.rs", "fn f() { let x: crate::app::X; }"),
        ("map/mod.rs", "// crate::app\nuse crate::lidar::{self, X};"),
        ("app.rs", "use crate::map::Tile;"),
        ("main.rs", "use fpmcl::app::X;"),
    ];
    assert_eq!(
        crate_of(&files).layer_violations(&[], &layers),
        [
            "src/lidar.rs:2 imports src/map/mod.rs",
            "src/lidar.rs:3 imports src/poses.rs",
            "src/poses.rs:1 imports src/app.rs"
        ]
    );
    let files = [
        (
            "app/mod.rs",
            "pub mod run;\npub mod cli;\nuse self::cli::C;",
        ),
        (
            "app/run/mod.rs",
            "use crate::lidar::X;\nuse crate::app::cli::C;",
        ),
        ("app/run/log.rs", "use super::super::A;"),
        ("app/cli.rs", "use crate::app::run::{R, log};"),
        ("lidar.rs", ""),
    ];
    let room = ["app".to_owned()];
    let rooms = [["run".to_owned()].into(), ["cli".to_owned()].into()];
    assert_eq!(
        crate_of(&files).layer_violations(&room, &rooms),
        [
            "src/app/run/mod.rs:2 imports src/app/cli.rs",
            "src/app/run/log.rs:1 imports src/app/mod.rs"
        ]
    );
}

#[test]
fn a_cycle_is_found_through_inline_paths_and_re_exports() {
    let parent = (
        "map/mod.rs",
        "mod tile;\nmod tree;\npub use tile::{Tile, Tiles as All};",
    );
    let tile = (
        "map/tile.rs",
        "struct Tile;\nfn f() { super::tree::grow(); }",
    );
    // `super::Tile` is defined in tile.rs: the parent, which only passes it on, is in no cycle.
    let tree = ("map/tree.rs", "use super::Tile;");
    let expected = [
        "src/map/tile.rs:2 imports src/map/tree.rs",
        "src/map/tree.rs:1 imports src/map/tile.rs",
    ];
    assert_eq!(crate_of(&[parent, tile, tree]).cycles(), expected);
    let tile = (
        "map/tile.rs",
        "struct Tile;\n// super::tree\nconst A: &str = \"super::tree::x\";",
    );
    assert!(crate_of(&[parent, tile, tree]).cycles().is_empty());
}

#[test]
fn a_parent_that_uses_its_child_is_no_place_for_the_child_s_types() {
    let child = ("map/tile.rs", "use super::Size;");
    for parent in [
        "mod tile;\nuse tile::Tile;\nstruct Size;",
        "mod tile;\npub use tile::Tile;\nstruct Size;\nfn f() -> Tile {}",
        "mod tile;\nstruct Size;\nfn f() { tile::cut() }",
    ] {
        assert_eq!(crate_of(&[("map/mod.rs", parent), child]).cycles().len(), 2);
    }
    let parent = "mod tile;\npub use tile::Tile;\nstruct Size;\n#[cfg(test)]\nuse tile::cut;";
    assert!(
        crate_of(&[("map/mod.rs", parent), child])
            .cycles()
            .is_empty()
    );
}

#[test]
fn modules_for_tests_are_found_in_any_folder() {
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
fn a_confined_word_is_reported_elsewhere_except_in_tests() {
    let reported = |path: &str, text: &str| violations(&[Source::new(path, text)]);
    let open = "let f = File::open(path)?;";
    assert_eq!(reported("map/tiles.rs", open).len(), 1);
    assert!(reported("map/files/ply.rs", open).is_empty());
    assert_eq!(reported("rendering/cpu.rs", "use wgpu::Device;").len(), 1);
    assert!(reported("rendering/gpu/mod.rs", "use wgpu::Device;").is_empty());
    let test = "#[cfg(test)]\nmod tests {\n    fn f() { fs::read(p) }\n}\nfn g() { fs::read(p) }\n";
    let lines = reported("map/tiles.rs", test);
    assert_eq!(lines.len(), 1);
    assert!(lines[0].starts_with("src/map/tiles.rs:5: "), "{}", lines[0]);
}
