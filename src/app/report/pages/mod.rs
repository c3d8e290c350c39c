//! Tables as data, and HTML pages.
//!
//! Everything here renders values that it is given; the caller writes the file. A page is one
//! self-contained HTML file: pictures are embedded, nothing is loaded from a network.

// Tables.
mod format;
mod table;
// Pages.
mod html;
mod page;

#[cfg(test)]
pub mod tests;

pub use format::value_and_uncertainty;
pub use page::{Page, PageElement, Section};
pub use table::{Cell, Column, MeanWithSpread, PairedDifference, SuccessRate, Table};
