//! Picture of one frame: its range images.

use anyhow::{Context as _, Result};

use crate::app::report::plotting::RangeImageStrip;
use crate::app::report::run_output::RunFiles;
use crate::app::settings::LocalizationConfig;
use crate::geometry::Pose3;
use crate::lidar::RangeImage;
use crate::map::Map;
use crate::recording::Recording;

/// Draws the range image of a frame beside that of the map at the estimate.
pub fn draw_example(
    config: &LocalizationConfig,
    files: &RunFiles,
    map: &Map,
    recording: &Recording,
    map_from_lidar: &[Pose3],
) -> Result<()> {
    let row = map_from_lidar.len() / 2;
    let model = config.tracker.sensor.range_image.model();
    let scan = recording.frames[row].read()?;
    let observed = RangeImage::project(&scan.points, &model);
    let rendered = map.renderer.render(&map_from_lidar[row..=row], &model)?;
    let rendered = rendered.first().context("one pose gives one image")?;
    let frame = &recording.frames[row];
    RangeImageStrip {
        title: &format!("Frame {}: observed, rendered, difference", frame.number),
        observed: &observed,
        rendered,
    }
    .save(&files.plot("range_images.png")?)
}
