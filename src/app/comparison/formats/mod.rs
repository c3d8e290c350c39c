//! Tables as CSV, Markdown and plain text.

pub mod csv;
pub mod markdown;
pub mod text;
