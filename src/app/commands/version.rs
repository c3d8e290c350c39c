//! Identification of this program, by which results of another build are recognized.

use std::sync::LazyLock;

use anyhow::{Context as _, Result};

/// Version of the package.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// BLAKE3 hash of the running executable, 16 hexadecimal digits.
///
/// Results are reused only by the executable that made them: any change of the source, of a
/// dependency or of the compiler changes it.
pub fn executable_hash() -> Result<&'static str> {
    static HASH: LazyLock<std::io::Result<String>> = LazyLock::new(|| {
        let executable = std::fs::read(std::env::current_exe()?)?;
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
