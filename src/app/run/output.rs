//! Output of commands: files, written atomically, and standard output.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use anyhow::Context as _;
use serde::Serialize;

use super::failure::NOT_LOCALIZED;
use super::visible::{visible, visible_in_line};
use crate::app::settings::to_yaml;
use crate::files::{Place, write_atomically};

/// Writes a file atomically.
pub fn write_file<E: Into<anyhow::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> Result<(), E>,
) -> anyhow::Result<()> {
    write_atomically(path, |file| write(file).map_err(Into::into))
        .with_context(|| format!("cannot write {}", path.display()))
}

/// Writes a text file atomically.
pub fn write_text(path: &Path, text: &str) -> anyhow::Result<()> {
    write_file(path, |file| file.write_all(text.as_bytes()))
}

/// Writes a report as JSON atomically.
pub fn write_json(path: &Path, report: &impl Serialize) -> anyhow::Result<()> {
    let json = serde_json::to_string_pretty(report)
        .with_context(|| format!("cannot serialize {}", path.display()))?;
    write_text(path, &(json + "\n"))
}

/// Writes the effective configuration atomically; loading it gives an equal one.
pub fn write_yaml(path: &Path, config: &impl Serialize) -> anyhow::Result<()> {
    write_text(path, &to_yaml(config)?)
}

/// What a command prints: for people, the main part or all of it, or for programs.
#[derive(Clone, Debug)]
pub struct Printed {
    main: String,
    all: String,
    json: String,
    /// Exit code of the program.
    pub exit_code: u8,
}

/// How much is printed, and in which form.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// Tables of at most twelve rows.
    Main,
    /// Whole tables.
    All,
    /// JSON.
    Json,
}

impl Printed {
    /// Text that is printed as a whole; in JSON, a string.
    pub fn text(text: impl Into<String>) -> Self {
        let text = text.into();
        Self::parts(text.clone(), text)
    }

    /// Rows of a name and a value, most important first; in JSON, the value that they describe.
    pub fn rows(rows: &[(&str, String)], described: &impl Serialize) -> anyhow::Result<Self> {
        const MAIN: usize = 12;
        let lines = |rows: &[(&str, String)]| -> String {
            let line = |(name, value): &(&str, String)| {
                let value = visible_in_line(value);
                if value.starts_with(char::is_alphabetic) {
                    format!("{name:<24} {value}\n")
                } else {
                    format!("{name:<24} {value:>14}\n")
                }
            };
            rows.iter().map(line).collect()
        };
        let mut main = lines(&rows[..rows.len().min(MAIN)]);
        if rows.len() > MAIN {
            main += &format!("{} more rows: --all\n", rows.len() - MAIN);
        }
        Self::parts(main, lines(rows)).with_json(described)
    }

    /// The main part and all of a text.
    pub fn parts(main: String, all: String) -> Self {
        Self {
            json: serde_json::Value::from(all.trim_end()).to_string(),
            main,
            all,
            exit_code: 0,
        }
    }

    /// The same with another value for programs.
    pub fn with_json(self, value: &impl Serialize) -> anyhow::Result<Self> {
        let json = serde_json::to_string_pretty(value).context("cannot serialize the output")?;
        Ok(Self { json, ..self })
    }

    /// The same with the exit code of a run that was localized or, as far as is known, not: [`NOT_LOCALIZED`].
    #[must_use]
    pub fn of_run(self, localized: Option<bool>) -> Self {
        let exit_code = if localized == Some(false) {
            NOT_LOCALIZED
        } else {
            0
        };
        Self { exit_code, ..self }
    }

    /// The text in a form.
    pub fn in_form(&self, form: Form) -> String {
        match form {
            Form::Main => self.main.clone(),
            Form::All => self.all.clone(),
            Form::Json => self.json.clone() + "\n",
        }
    }
}

/// Creates a folder and those above it.
pub fn create_folder(folder: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))
}

/// Creates a folder in one that must exist.
pub fn create_subfolder(folder: &Path) -> anyhow::Result<()> {
    match Place::of(folder).and_then(|place| fs::create_dir(&place.path)) {
        Err(error) if !folder.is_dir() => {
            Err(error).with_context(|| format!("cannot create {}", folder.display()))
        }
        _ => Ok(()),
    }
}

/// Removes a file, if it exists.
pub fn remove_if_exists(path: &Path) -> anyhow::Result<()> {
    match Place::of(path).and_then(|place| fs::remove_file(&place.path)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Prints a text to standard output, with control characters as escapes; a closed pipe is not an error.
pub fn print(text: &str) -> anyhow::Result<()> {
    let mut stdout = io::stdout().lock();
    match stdout
        .write_all(visible(text).as_bytes())
        .and_then(|()| stdout.flush())
    {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(error).context("writing to standard output")
        }
        _ => Ok(()),
    }
}
