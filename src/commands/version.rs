//! Which program this is.

/// Of the source that results follow from; a rebuilt program with another behaviour has another.
/// Made by `build.rs`.
pub const SOURCE: &str = env!("FPMCL_SOURCE");

/// Version of the package.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Name, version and source.
pub fn program() -> String {
    format!("fpmcl {VERSION} (source {SOURCE})")
}
