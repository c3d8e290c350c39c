//! What the user sees of an error that ends a run.

use std::io::Write as _;

use super::interrupt::Interrupted;
pub use super::remedy::POSES;
use super::remedy::remedies;
use super::visible::{visible, visible_in_line};

/// Exit code of a run whose result is kept, but of which less than half of the frames were localized.
pub const NOT_LOCALIZED: u8 = 3;

/// Prints an error with its causes and remedies on standard error; `option` is that of the command that names poses.
pub fn report(error: &anyhow::Error, option: &str) {
    let mut text = format!("error: {}", format_error_chain(error));
    for remedy in remedies(error, option) {
        text += &format!("; {remedy}");
    }
    text += "\n";
    // There is nowhere to report that standard error is closed.
    let _ = std::io::stderr().write_all(text.as_bytes());
}

/// Prints an error of usage on standard error; names in it are as the user gave them.
pub fn report_usage(error: &clap::Error) {
    let text = error.render().to_string();
    // There is nowhere to report that standard error is closed.
    let _ = std::io::stderr().write_all(visible(&text).as_bytes());
}

/// Exit code of a failed run: 130 if it was interrupted, as in shells, else 1; 2 is wrong usage, and 3
/// [`NOT_LOCALIZED`].
pub fn exit_code(error: &anyhow::Error) -> u8 {
    if error.is::<Interrupted>() { 130 } else { 1 }
}

/// Formats an error and its causes, without repetitions.
pub fn format_error_chain(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let words = cause.to_string();
        let words = visible_in_line(&words);
        if text.contains(&*words) {
            continue;
        }
        text += match (text.is_empty(), cause.is::<std::io::Error>()) {
            (true, _) => "",
            // What the operating system reports, such as a full disk.
            (false, true) => ": ",
            (false, false) => "\n  because: ",
        };
        text += &words;
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::RecordingError;

    #[test]
    fn a_cause_is_printed_once() {
        let source = std::io::Error::new(std::io::ErrorKind::NotFound, "no such file");
        let error = anyhow::Error::new(RecordingError::Read {
            path: "poses.txt".into(),
            source,
        })
        .context("while building the map");
        assert_eq!(
            format_error_chain(&error),
            "while building the map\n  because: cannot read poses.txt: no such file"
        );
    }

    #[test]
    fn an_interrupted_run_has_an_exit_code_of_its_own() {
        let interrupted = anyhow::Error::new(Interrupted {
            kept: "12 scans are in results/map.ply".to_owned(),
        });
        assert_eq!(
            exit_code(&interrupted.context("while building the map")),
            130
        );
        assert_eq!(exit_code(&anyhow::anyhow!("else")), 1);
    }
}
