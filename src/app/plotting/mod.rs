//! Pictures of a run, drawn without a display and with a font of our own.
//!
//! Every picture is a plain struct of what it shows, with a `save` that writes a PNG. Maps have
//! equal scales on both axes, axes have units, and legends stand outside the data.

// What pictures are drawn with.
pub mod bitmap;
pub mod color;
mod error;
pub mod palette;
mod sheet;
mod view;
// The pictures.
pub mod animation;
pub mod chart;
pub mod ground_plot;
pub mod map_image;
pub mod map_plot;
pub mod particles;
pub mod range_images;
pub mod trajectory;

#[cfg(test)]
mod tests;

pub use animation::Animation;
pub use bitmap::Bitmap;
pub use chart::{LineChart, Mark, Panel, Series};
pub use error::PlotError;
pub use ground_plot::GroundPlot;
pub use map_image::MapImage;
pub use map_plot::{MapPlot, ScalarMapPlot};
pub use particles::LocalizationPicture;
pub use range_images::RangeImageStrip;
pub use trajectory::{ErrorPlot, Path2, PathPlot, RuntimePlot};
