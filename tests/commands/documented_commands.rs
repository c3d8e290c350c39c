//! The pages of the documentation name commands, options, keys, commits and tests that exist.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command as Process;

use clap::{CommandFactory as _, Parser as _};
use fpmcl::internals::app::settings::{
    BuildMapConfig, CommandConfig, EvaluationConfig, GroundCommandConfig, LocalizationConfig,
    OdometryCommandConfig, RefinementConfig,
};
use fpmcl::internals::app::{Cli, Command, ComparisonConfig};
use fpmcl::simulation::SimulationConfig;

use crate::common::skips::skipped;

/// Options of other programs: cargo, evo and Snakemake.
const OF_OTHERS: [&str; 9] = [
    "align_origin",
    "cores",
    "directory",
    "features",
    "forcerun",
    "no-default-features",
    "release",
    "set-threads",
    "unlock",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Names and texts of the pages, and of the help of all commands.
fn texts() -> Vec<(String, String)> {
    let folders = ["", "docs", "data", "benches"].map(|folder| root().join(folder));
    let files = folders.iter().flat_map(|it| fs::read_dir(it).unwrap());
    let mut files: Vec<PathBuf> = files.map(|file| file.unwrap().path()).collect();
    files.retain(|path| path.extension().is_some_and(|it| it == "md" || it == "py"));
    files.sort();
    let pages = files.into_iter().map(|path| {
        let text = fs::read_to_string(&path).unwrap();
        (path.display().to_string(), text)
    });
    let program = Cli::command();
    let helps = program.get_subcommands().map(|command| {
        let help = command.clone().render_long_help().to_string();
        (format!("fpmcl {} --help", command.get_name()), help)
    });
    pages.chain(helps).collect()
}

/// The spans of code in a text and its lines that begin with the program, without comments and what is piped.
fn code(text: &str) -> Vec<String> {
    let parts = text.split("\\\n").map(str::trim_start);
    let joined = parts.collect::<Vec<_>>().join("");
    let lines = joined.lines().map(str::trim);
    let lines = lines.map(|line| line.strip_prefix("$ ").unwrap_or(line));
    let commands = lines.filter(|line| line.starts_with("fpmcl "));
    let command = |line: &str| {
        let ends = ["#", "  ", "|", ">", ";", "&&"].map(|end| line.find(end));
        let end = ends.into_iter().flatten().min();
        line[..end.unwrap_or(line.len())].trim().to_owned()
    };
    // Blocks of code are spans that begin with a line break or the name of a language.
    let spans = text.split('`').skip(1).step_by(2);
    let spans = spans.map(|span| command(&span.replace('\n', " ")));
    let mut all: Vec<String> = commands.map(command).chain(spans).collect();
    all.retain(|code| code.starts_with("fpmcl ") || code.starts_with("--"));
    all
}

/// Settings that a command does not have.
fn unknown<T: CommandConfig>(settings: &[(String, String)]) -> Vec<String> {
    let is_unknown = |(key, value): &&(String, String)| {
        let setting = [(key.clone(), value.clone())];
        T::default().with_settings(&setting).is_err_and(|error| {
            let message = error.to_string();
            ["unknown key", "not a key any more", "is ambiguous"]
                .iter()
                .any(|it| message.contains(it))
        })
    };
    let unknown = settings.iter().filter(is_unknown);
    unknown.map(|(key, _)| format!("--set {key}")).collect()
}

/// What is wrong with a command.
fn problems(line: &str) -> Vec<String> {
    let value = |word: String| match word.as_str() {
        "COMMAND" => "localize".to_owned(),
        "X" | "Y" | "Z" | "N" => "1".to_owned(),
        "key=value" | "KEY=VALUE" => "seed=1".to_owned(),
        _ => word,
    };
    let words = shell_words::split(line).unwrap_or_default();
    let words = words.into_iter().map(value);
    let command = match Cli::try_parse_from(words) {
        Ok(cli) => cli.command,
        Err(error) if error.use_stderr() => return vec![error.to_string()],
        Err(_) => return vec![],
    };
    match command {
        Command::BuildMap(args) => unknown::<BuildMapConfig>(&args.run.source.settings),
        Command::Localize(args) => unknown::<LocalizationConfig>(&args.run.source.settings),
        Command::Refine(args) => unknown::<RefinementConfig>(&args.run.source.settings),
        Command::Evaluate(args) => unknown::<EvaluationConfig>(&args.run.source.settings),
        Command::Odometry(args) => unknown::<OdometryCommandConfig>(&args.run.source.settings),
        Command::Simulate(args) => unknown::<SimulationConfig>(&args.source.settings),
        Command::Compare(args) => unknown::<ComparisonConfig>(&args.source.settings),
        Command::Ground(args) => unknown::<GroundCommandConfig>(&args.settings),
        _ => vec![],
    }
}

/// Whether a command, or the program, has an option.
fn has_option(option: &str) -> bool {
    let program = Cli::command();
    let commands = program.get_subcommands().chain([&program]);
    let mut arguments = commands.flat_map(|command| command.get_arguments());
    option == "help" || arguments.any(|argument| argument.get_long() == Some(option))
}

#[test]
fn commands_options_and_keys_of_the_pages_are_those_of_the_program() {
    let mut count = 0;
    let mut wrong = Vec::new();
    for (name, text) in texts() {
        for code in code(&text) {
            let is_command = |rest: &str| !rest.split(' ').next().unwrap().contains(['_', '=']);
            let found = if code.strip_prefix("fpmcl ").is_some_and(is_command) {
                problems(&code)
            } else if let Some(setting) = code.strip_prefix("--set ") {
                let commands = [
                    "build-map",
                    "localize",
                    "refine",
                    "evaluate",
                    "odometry",
                    "simulate",
                    "compare",
                ];
                let all =
                    commands.map(|command| problems(&format!("fpmcl {command} --set {setting}")));
                all.into_iter().min_by_key(Vec::len).unwrap()
            } else if let Some(option) = code.strip_prefix("--") {
                let option = option.split([' ', '=']).next().unwrap();
                let is_known = has_option(option) || OF_OTHERS.contains(&option);
                (!is_known)
                    .then(|| format!("no command has --{option}"))
                    .into_iter()
                    .collect()
            } else {
                continue;
            };
            count += 1;
            wrong.extend(
                found
                    .into_iter()
                    .map(|problem| format!("{name}: `{code}`: {problem}")),
            );
        }
    }
    assert!(count > 100, "{count} commands");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn commits_of_the_pages_are_in_the_history() {
    let git = |arguments: &[&str]| {
        let output = Process::new("git")
            .arg("-C")
            .arg(root())
            .args(arguments)
            .output();
        output.ok().filter(|output| output.status.success())
    };
    let is_shallow = git(&["rev-parse", "--is-shallow-repository"]);
    if is_shallow.is_none_or(|output| output.stdout.starts_with(b"true")) {
        skipped("this is no git checkout with its history");
        return;
    }
    // A hash may have digits only.
    let is_commit = |[before, word]: &[&str; 2]| {
        let has = |is: fn(&u8) -> bool| word.bytes().any(|byte| is(&byte));
        let follows_its_name = || ["commit", "at", "of"].contains(before) && word.len() == 7;
        (7..=40).contains(&word.len())
            && word
                .bytes()
                .all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
            && has(u8::is_ascii_digit)
            && (has(u8::is_ascii_lowercase) || follows_its_name())
    };
    let mut count = 0;
    let mut missing = Vec::new();
    for (name, text) in texts() {
        let words = text.split(|c: char| !c.is_ascii_alphanumeric());
        let words: Vec<&str> = words.filter(|word| !word.is_empty()).collect();
        let pairs = words.windows(2).map(|pair| [pair[0], pair[1]]);
        for [_, commit] in pairs.filter(is_commit) {
            count += 1;
            if git(&["merge-base", "--is-ancestor", commit, "HEAD"]).is_none() {
                missing.push(format!("{name}: {commit}"));
            }
        }
    }
    assert!(count > 0, "no page cites a commit");
    assert!(missing.is_empty(), "{}", missing.join("\n"));
}

#[test]
fn tests_of_the_page_on_reliability_exist() {
    let mut sources = String::new();
    let mut folders = vec![root().join("src"), root().join("tests")];
    while let Some(folder) = folders.pop() {
        for path in fs::read_dir(folder).unwrap().map(|it| it.unwrap().path()) {
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|it| it == "rs") {
                sources += &fs::read_to_string(path).unwrap();
            }
        }
    }
    let page = fs::read_to_string(root().join("docs/reliability.md")).unwrap();
    let spans = page.split('`').skip(1).step_by(2);
    // Names of tests are sentences, with or without their module.
    let names = spans.filter_map(|span| span.rsplit("::").next());
    let is_sentence = |name: &&str| {
        name.matches('_').count() >= 3
            && (name.bytes()).all(|byte| byte.is_ascii_lowercase() || byte == b'_')
    };
    let names: Vec<&str> = names.filter(is_sentence).collect();
    let is_missing = |name: &&&str| !sources.contains(&format!("fn {name}("));
    let missing: Vec<&&str> = names.iter().filter(is_missing).collect();
    assert!(names.len() > 50, "{} tests", names.len());
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn what_does_not_exist_is_reported() {
    assert!(problems("fpmcl localize drive_2/ --map map.ply --set numParticles=1000").is_empty());
    for line in [
        "fpmcl locate drive_2/",
        "fpmcl localize drive_2/ --mapp map.ply",
        "fpmcl localize drive_2/ --set n_particles=1000",
    ] {
        assert_eq!(problems(line).len(), 1, "{line}");
    }
    assert!(has_option("seed") && !has_option("sead"));
    let page = "```sh\n$ fpmcl info a/ \\\n  --json  # text\n```\nAdd `--force`.";
    assert_eq!(code(page), ["fpmcl info a/ --json", "--force"]);
}
