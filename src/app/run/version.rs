//! Identification of this program, by which results of another build are recognized.

use std::io;
use std::path::PathBuf;
use std::sync::{LazyLock, OnceLock};

use anyhow::{Context as _, Result};

/// Version of the package.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The file with this code, if it is not the executable of the process.
static LIBRARY: OnceLock<PathBuf> = OnceLock::new();

/// Sets the file with this code, where it is a library of another program, such as an interpreter; before the first
/// command.
pub fn set_library(path: PathBuf) {
    // The first one stays: a process has one.
    let _ = LIBRARY.set(path);
}

/// BLAKE3 hash of the running executable or of the library with this code, 16 hexadecimal digits.
///
/// Results are reused only by the executable that made them: any change of the source, of a
/// dependency or of the compiler changes it.
pub fn executable_hash() -> Result<&'static str> {
    static HASH: LazyLock<io::Result<String>> = LazyLock::new(|| {
        let path = LIBRARY.get().cloned();
        let executable = std::fs::read(path.map_or_else(std::env::current_exe, Ok)?)?;
        Ok(blake3::hash(&executable).to_hex()[..16].to_owned())
    });
    HASH.as_deref()
        .map_err(|error| anyhow::anyhow!("{error}"))
        .context("cannot read the running executable, by whose hash results are recognized")
}

/// Name and version of the program, with the hash of its executable.
pub fn program() -> Result<String> {
    Ok(format!(
        "fpmcl {VERSION} (executable {})",
        executable_hash()?
    ))
}
