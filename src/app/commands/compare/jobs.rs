//! One command per run, for those who distribute them.

use super::plan::PlannedRun;
use crate::app::cli::{BackendArg, CompareArgs};

/// A line per run that a shell can execute, from the folder in which this command was.
pub fn lines(runs: &[PlannedRun], args: &CompareArgs) -> String {
    let program = std::env::args()
        .next()
        .unwrap_or_else(|| "fpmcl".to_owned());
    let mut words = vec![program, "compare".to_owned()];
    words.extend(
        args.source
            .config
            .iter()
            .map(|path| path.display().to_string()),
    );
    for (key, value) in &args.source.settings {
        words.extend(["--set".to_owned(), format!("{key}={value}")]);
    }
    if let Some(threads) = args.source.machine.threads {
        words.extend(["--threads".to_owned(), threads.to_string()]);
    }
    match args.source.machine.backend {
        BackendArg::Auto => {}
        BackendArg::Cpu => words.push("--backend=cpu".to_owned()),
        BackendArg::Gpu => words.push("--backend=gpu".to_owned()),
    }
    let command: Vec<String> = words.iter().map(|word| quoted(word)).collect();
    let command = command.join(" ");
    runs.iter()
        .map(|run| format!("{command} --job {}\n", run.id))
        .collect()
}

/// A word as a shell reads it.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_+./=:,@%".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', "'\\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_shell_would_read_otherwise_is_quoted() {
        assert_eq!(quoted("config/comparison.yml"), "config/comparison.yml");
        assert_eq!(quoted("seeds=[1, 2]"), "'seeds=[1, 2]'");
        assert_eq!(quoted("it's"), "'it'\\''s'");
        assert_eq!(quoted(""), "''");
    }
}
