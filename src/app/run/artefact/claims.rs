//! Checks of the outputs of a command: nothing is replaced or deleted that this program did not write.
//!
//! The file `.fpmcl` in each folder of outputs has a line `STATE NAME` per output, of which the last
//! one of a name is valid:
//!
//! ```text
//! claimed report.json           may be replaced by this program
//! unfinished localization.npz   is being written, with the files that belong to it
//! finished localization.npz     is complete, with the files that belong to it
//! removed refined_tum.txt       is not claimed any more
//! ```
//!
//! Backslashes and line breaks of names are written as `\\` and `\n`.
//!
//! Lines are only appended, so that processes may write to one folder at the same time. A line that a full disk cut, with
//! no end, counts for nothing.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};

use crate::app::run::output;
use crate::file_path::{FilePath, text_of};
use crate::files::{
    Place, claim_folder, folder_of, remove_abandoned, require_no_link, temporary_next_to,
};

/// File of the claims in each folder.
pub const CLAIMS_FILE: &str = ".fpmcl";

/// Name of the configuration file among the inputs.
pub const CONFIGURATION_FILE: &str = "the configuration file";

/// First bytes of a map.
pub const PLY: &[u8] = b"ply";

/// Outputs of a run, all in one folder.
pub struct Outputs<'a> {
    /// Configuration key that sets their folder.
    pub key: &'a str,
    /// The output that is finished last; it is replaced with `force` only, unless it is unfinished.
    pub main: &'a Path,
    /// First bytes of a main output that the user names: with `force`, such a file is replaced
    /// whoever wrote it. `None` if its name is ours.
    pub magic: Option<&'static [u8]>,
    /// Names of the other files and folders, as texts of paths.
    pub names: Vec<String>,
    /// Input files and their keys.
    pub inputs: Vec<(&'a str, &'a Path)>,
    /// Whether the main output may be replaced.
    pub force: bool,
}

impl Outputs<'_> {
    /// Checks all outputs before any work, creates their folder, removes what a killed process left
    /// of them, and claims them.
    pub fn prepare(&self) -> Result<Claims> {
        let folder = folder_of(self.main);
        let mut claims = Claims::read(folder)?;
        self.check_main(&claims)?;
        for name in &self.names {
            self.check(&folder.join(&*FilePath::of_text(name)), &claims)?;
        }
        let context = || {
            let path = self.magic.map_or(folder, |_| self.main).display();
            let key = self.key;
            format!("{key} is {path}, and nothing can be written there; choose another {key}")
        };
        output::create_folder(folder).with_context(context)?;
        claim_folder(folder).with_context(context)?;
        temporary_next_to(self.main).with_context(context)?;
        for path in claims.paths(&self.names).chain([self.main.to_owned()]) {
            remove_abandoned(&path).with_context(context)?;
        }
        claims.set(&self.names, "claimed")?;
        if self.magic.is_none() {
            claims.set(&[name_of(self.main)], "claimed")?;
        }
        Ok(claims)
    }

    fn check_main(&self, claims: &Claims) -> Result<()> {
        let (key, path) = (self.key, self.main.display());
        self.check_inputs(self.main, |_key| true)?;
        let Ok(found) = fs::symlink_metadata(self.main) else {
            return Ok(());
        };
        ensure!(
            !self.main.is_dir(),
            "{path} is a folder; give {key} the name of a file"
        );
        ensure!(
            found.is_file(),
            "{path} is not a regular file and is never replaced; choose another {key}"
        );
        let Some(magic) = self.magic else {
            self.check(self.main, claims)?;
            return self.ensure_force(claims);
        };
        self.ensure_force(claims)?;
        let mut start = Vec::new();
        File::open(self.main)
            .and_then(|file| file.take(magic.len() as u64).read_to_end(&mut start))
            .with_context(|| format!("cannot read {path}"))?;
        ensure!(
            claims.state(self.main).is_some() || start == magic,
            "{path} exists, is of another kind and was not written by fpmcl; move it, or choose another {key}"
        );
        Ok(())
    }

    fn ensure_force(&self, claims: &Claims) -> Result<()> {
        ensure!(
            self.force || claims.state(self.main) == Some("unfinished"),
            "{} exists; add --force to replace it, or choose another {}",
            self.main.display(),
            self.key
        );
        Ok(())
    }

    /// Checks a file or folder that is replaced with and without `force`.
    fn check(&self, path: &Path, claims: &Claims) -> Result<()> {
        let is_claimed = claims.state(path).is_some();
        // An effective configuration may be run again: it is read before it is replaced.
        let is_replaced = |key: &str| !(is_claimed && key == CONFIGURATION_FILE);
        self.check_inputs(path, is_replaced)?;
        let Ok(found) = fs::symlink_metadata(path) else {
            return Ok(());
        };
        let why = match claims.state(path) {
            None => "was not written by fpmcl",
            Some(_) if !found.is_file() && !found.is_dir() => "is not a regular file",
            Some(_) => return Ok(()),
        };
        bail!(
            "{} exists and {why}; move it, or set {} to a path in another folder",
            path.display(),
            self.key
        )
    }

    /// Checks that an output is none of the inputs whose keys count, also through links.
    fn check_inputs(&self, output: &Path, counts: impl Fn(&str) -> bool) -> Result<()> {
        let Ok(output) = output.canonicalize() else {
            return Ok(());
        };
        let is_same = |input: &Path| input.canonicalize().is_ok_and(|input| input == output);
        match (self.inputs.iter()).find(|(key, input)| counts(key) && is_same(input)) {
            Some((input_key, input)) => bail!(
                "{} would be replaced, but it is an input ({input_key}); set {} to a path in another folder",
                input.display(),
                self.key
            ),
            None => Ok(()),
        }
    }
}

/// States of the outputs in a folder.
pub struct Claims {
    folder: PathBuf,
    states: BTreeMap<String, String>,
}

impl Claims {
    /// Reads the claims of a folder; there are none in a folder that does not exist.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join(CLAIMS_FILE);
        let text = match fs::read(&path) {
            Err(error)
                if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) =>
            {
                Vec::new()
            }
            text => text.with_context(|| format!("cannot read {}", path.display()))?,
        };
        let mut states = BTreeMap::new();
        let text = String::from_utf8_lossy(&text);
        let whole = text.rsplit_once('\n').map_or("", |(whole, _cut)| whole);
        for line in whole.split('\n') {
            match line.split_once(' ') {
                Some(("removed", name)) => drop(states.remove(name)),
                Some((state, name)) => drop(states.insert(name.to_owned(), state.to_owned())),
                None => {}
            }
        }
        Ok(Self {
            folder: folder.to_owned(),
            states,
        })
    }

    /// The state of an output of the folder; `None` if it is not claimed.
    pub fn state(&self, path: &Path) -> Option<&str> {
        let state = self.states.get(&in_line(&name_of(path)))?;
        state.split(':').next()
    }

    /// The key of the inputs of an output; `None` if it has none.
    pub fn key(&self, path: &Path) -> Option<&str> {
        let state = self.states.get(&in_line(&name_of(path)))?;
        Some(state.split_once(':')?.1)
    }

    /// Marks a main output as being written.
    pub fn begin(&mut self, main: &Path) -> Result<()> {
        self.set(&[name_of(main)], "unfinished")
    }

    /// Marks a main output as being written from the inputs of a key.
    pub fn begin_with_key(&mut self, main: &Path, key: &str) -> Result<()> {
        self.set(&[name_of(main)], &format!("unfinished:{key}"))
    }

    /// Marks a main output as complete.
    pub fn finish(&mut self, main: &Path) -> Result<()> {
        let key = self.key(main).map(|key| format!("finished:{key}"));
        self.set(&[name_of(main)], key.as_deref().unwrap_or("finished"))
    }

    /// Removes the claimed ones of some files.
    pub fn remove(&mut self, names: &[&str]) -> Result<()> {
        let is_claimed = |name: &&&str| self.states.contains_key(&in_line(name));
        let claimed: Vec<&str> = names.iter().filter(is_claimed).copied().collect();
        self.paths(&claimed)
            .try_for_each(|path| output::remove_if_exists(&path))?;
        self.set(&claimed, "removed")
    }

    fn paths<'a>(&self, names: &'a [impl AsRef<str>]) -> impl Iterator<Item = PathBuf> + 'a {
        let folder = self.folder.clone();
        names
            .iter()
            .map(move |name| folder.join(&*FilePath::of_text(name.as_ref())))
    }

    /// Appends a state of outputs; a claim does not change another state.
    fn set(&mut self, names: &[impl AsRef<str>], state: &str) -> Result<()> {
        let mut lines = String::new();
        for name in names.iter().map(|name| in_line(name.as_ref())) {
            let found = self.states.get(&name);
            if found.is_some_and(|found| found == state || state == "claimed") {
                continue;
            }
            lines += &format!("{state} {name}\n");
            self.states.insert(name, state.to_owned());
        }
        if lines.is_empty() {
            return Ok(());
        }
        let path = self.folder.join(CLAIMS_FILE);
        require_no_link(&path)
            .and_then(|()| Place::of(&path))
            .and_then(|place| append(&place.path, &lines))
            .with_context(|| format!("cannot write {}", path.display()))
    }
}

/// Appends lines to a file, after the end of one that was cut.
fn append(path: &Path, lines: &str) -> io::Result<()> {
    let mut file = (File::options().read(true).append(true).create(true)).open(path)?;
    let mut last = [b'\n'];
    if file.seek(SeekFrom::End(-1)).is_ok() {
        file.read_exact(&mut last)?;
    }
    let cut = if last == *b"\n" { "" } else { "\n" };
    file.write_all(format!("{cut}{lines}").as_bytes())
}

/// The name of an output, as the text of a path.
fn name_of(path: &Path) -> Cow<'_, str> {
    text_of(Path::new(path.file_name().unwrap_or_default()))
}

/// A name as in the claims: in one line, no two names the same.
fn in_line(name: &str) -> String {
    name.replace('\\', "\\\\").replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outputs(main: &Path) -> Outputs<'_> {
        Outputs {
            key: "output",
            main,
            magic: None,
            names: vec!["report.json".to_owned()],
            inputs: Vec::new(),
            force: false,
        }
    }

    #[test]
    fn a_name_with_a_newline_claims_no_other_file() {
        let folder = tempfile::tempdir().unwrap();
        let victim = folder.path().join("victim.npz");
        fs::write(&victim, "of the user").unwrap();
        let main = folder.path().join("x\nfinished victim.npz");
        let mut claims = outputs(&main).prepare().unwrap();
        claims.begin(&main).unwrap();
        let claims = Claims::read(folder.path()).unwrap();
        assert_eq!(claims.state(&main), Some("unfinished"));
        assert_eq!(claims.state(&victim), None);
        assert!(outputs(&victim).prepare().is_err());
        assert_eq!(fs::read(&victim).unwrap(), b"of the user");
        // Neither does one of the other outputs, and it is known again.
        let named = Outputs {
            names: vec![
                "y\nclaimed victim.npz".to_owned(),
                "y\\nclaimed other".to_owned(),
            ],
            ..outputs(&main)
        };
        named.prepare().unwrap();
        fs::write(folder.path().join(&named.names[0]), "of a run").unwrap();
        named.prepare().unwrap();
        let claims = Claims::read(folder.path()).unwrap();
        assert_eq!(claims.state(&victim), None);
        assert_eq!(claims.state(&folder.path().join("y\nclaimed other")), None);
    }

    #[cfg(unix)]
    #[test]
    fn claims_are_not_written_through_a_link() {
        let folder = tempfile::tempdir().unwrap();
        let notes = folder.path().join("notes");
        fs::write(&notes, "of the user").unwrap();
        let results = folder.path().join("results");
        fs::create_dir(&results).unwrap();
        std::os::unix::fs::symlink(&notes, results.join(CLAIMS_FILE)).unwrap();
        let main = results.join("localization.npz");
        let error = outputs(&main).prepare().err().unwrap();
        assert!(format!("{error:#}").contains("it is a link"), "{error:#}");
        assert_eq!(fs::read(&notes).unwrap(), b"of the user");
    }
}
