//! Which program this is.

/// Of the source that results follow from; a rebuilt program with another behaviour has another.
/// Made by `build.rs`.
pub const SOURCE: &str = env!("FPMCL_SOURCE");

/// Of the source that simulated drives follow from. Made by `build.rs`.
pub const DRIVE_SOURCE: &str = env!("FPMCL_DRIVE_SOURCE");

/// Version of the package.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Name, version and source.
pub fn program() -> String {
    format!("fpmcl {VERSION} (source {SOURCE})")
}
