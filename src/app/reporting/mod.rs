//! What people are told: tables as text, Markdown, CSV, and pages to look at.
//!
//! Everything here makes a text of what it is given; who calls it writes the file. A page is one
//! self-contained HTML file: pictures are embedded, nothing is loaded from anywhere.

// Tables.
pub mod csv;
pub mod markdown;
pub mod text;
mod words;
// Pages.
pub mod html;
pub mod page;

pub use page::{Block, Page, Section};
