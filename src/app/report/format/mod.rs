//! Reports: tables as plain text, Markdown and CSV, and HTML pages.
//!
//! Everything here renders values that it is given; the caller writes the file. A page is one
//! self-contained HTML file: pictures are embedded, nothing is loaded from a network.

// Tables.
pub mod csv;
mod format;
pub mod markdown;
mod table;
pub mod text;
// Pages.
mod html;
mod page;

#[cfg(test)]
mod tests;

pub use page::{Page, PageElement, Section};
pub use table::{Cell, Column, MeanWithSpread, PairedDifference, SuccessRate, Table};
