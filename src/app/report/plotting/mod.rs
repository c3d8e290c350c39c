//! Pictures of a run, drawn without a display and with an embedded font.
//!
//! Each picture is a plain struct of its content whose `save` writes a PNG. Maps have equal scales
//! on both axes, axes have units, and legends are outside the data.

// Drawing.
mod bitmap;
pub mod color;
mod sheet;
mod view;
// The pictures.
mod animation;
mod chart;
mod ground_plot;
mod interactive;
mod map_image;
mod map_plot;
mod particles;
mod range_images;
mod trajectory;

#[cfg(test)]
mod tests;

pub use animation::save_animation;
pub use bitmap::Bitmap;
pub use chart::{FRAME, LineChart, Panel, Series};
pub use ground_plot::GroundPlot;
pub use interactive::InteractivePath;
pub use map_image::{MapImage, SURFACES, muted};
pub use map_plot::{MapPlot, VertexNumbers};
pub use particles::LocalizationPicture;
pub use range_images::RangeImageStrip;
pub use trajectory::{PathPlot, drift_chart, error_chart};
pub use view::Mark;
