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
    let command = shell_words::join(&words);
    runs.iter()
        .map(|run| format!("{command} --job {}\n", run.id))
        .collect()
}
