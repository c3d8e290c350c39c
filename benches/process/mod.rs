//! Arguments and memory of a bench.

use std::path::{Path, PathBuf};

/// The files that are given on the command line.
#[allow(dead_code, reason = "not every bench reads files")]
pub fn files() -> Vec<PathBuf> {
    let arguments = std::env::args_os().skip(1).map(PathBuf::from);
    arguments
        .filter(|argument| argument != Path::new("--bench"))
        .collect()
}

/// Memory of this process by a key of `/proc/self/status`: `VmRSS` now, `VmHWM` at most (Linux; 0 elsewhere) [MiB].
#[allow(dead_code, reason = "not every bench measures memory")]
pub fn memory_mib(key: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix(key)?.strip_prefix(':'));
    let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
    kib.unwrap_or(0) / 1024
}
