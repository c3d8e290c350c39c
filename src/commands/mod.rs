//! One file per subcommand; each `run` reads as a paragraph.
pub mod simulate;
