//! Laws of the reconstruction and of the simplification.

mod reconstruction;
pub mod shapes;
mod simplification;
