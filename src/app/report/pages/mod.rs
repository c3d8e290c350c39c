//! HTML pages and their tables.
//!
//! Everything here renders values that it is given; the caller writes the file. A page is one
//! self-contained HTML file: pictures are embedded, nothing is loaded from a network.

mod html;
mod page;
mod table;

pub use page::{Page, PageElement, Section};
pub use table::{Cell, Column, Table};
