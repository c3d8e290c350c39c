//! Tests that do not run because what they need is missing. Each says so at once, and `tests/what_was_skipped.rs` lists
//! all of a call of `cargo test` at its end.

use std::fmt::Display;
use std::io::{self, Write as _};
use std::panic::Location;
use std::path::PathBuf;
use std::sync::Mutex;
use std::{env, fs, thread};

/// Reports that the rest of the running test does not run. The line is not captured as those of tests that pass.
#[track_caller]
pub fn skipped(reason: impl Display) {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let thread = thread::current();
    let test = thread.name().unwrap_or("main");
    let line = format!("{test} ({}): {reason}\n", Location::caller().file());
    let _lock = ONE_AT_A_TIME.lock();
    let all = of_this_call() + &line;
    // Where it cannot be written, the line on standard error has to suffice.
    let _ = fs::write(file(), format!("{}\n{all}", call()));
    let _ = write!(io::stderr(), "skipped: {line}");
}

/// The lines of all programs that the same call of `cargo test` has started.
pub fn of_this_call() -> String {
    let text = fs::read_to_string(file()).unwrap_or_default();
    let lines = text.split_once('\n').filter(|(first, _)| *first == call());
    lines.map_or(String::new(), |(_, lines)| lines.to_owned())
}

/// One list for all programs with tests, next to them.
fn file() -> PathBuf {
    let program = env::current_exe().unwrap_or_default();
    program.with_file_name("skipped_tests.txt")
}

/// What distinguishes one call of `cargo test` from another.
fn call() -> String {
    #[cfg(unix)]
    let parent = std::os::unix::process::parent_id();
    #[cfg(not(unix))]
    let parent = 0;
    parent.to_string()
}
