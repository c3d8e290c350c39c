//! Animated GIF from the pictures of single frames.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use rayon::prelude::*;

use super::bitmap::Bitmap;
use crate::app::run::output;

/// Largest width [px]; wider pictures are scaled down.
const WIDTH: u32 = 1200;

/// Maximum number of pictures; they are chosen evenly and always include the last one.
const MOST_FRAMES: usize = 150;

/// Total duration [hundredths of a second], the unit of GIF: 10 pictures per second.
const DURATION: usize = 1500;

/// Writes a GIF that repeats forever from PNG files, all of one size.
pub fn save_animation(path: &Path, pictures: &[PathBuf]) -> Result<()> {
    let chosen = choose(pictures, MOST_FRAMES);
    ensure!(
        !chosen.is_empty(),
        "cannot write {}: there are no pictures to animate",
        path.display()
    );
    let frames = (chosen.par_iter())
        .map(|picture| frame(picture, chosen.len()))
        .collect::<Result<Vec<gif::Frame>>>()?;
    output::write_file(path, |file| -> Result<()> {
        let mut encoder = gif::Encoder::new(file, frames[0].width, frames[0].height, &[])?;
        encoder.set_repeat(gif::Repeat::Infinite)?;
        for frame in &frames {
            encoder.write_lzw_pre_encoded_frame(frame)?;
        }
        Ok(())
    })
}

fn choose(pictures: &[PathBuf], most: usize) -> Vec<&PathBuf> {
    let count = pictures.len().min(most);
    (1..=count)
        .map(|k| &pictures[k * pictures.len() / count - 1])
        .collect()
}

/// Reads, scales, quantizes and compresses one of `count` pictures.
fn frame(picture: &Path, count: usize) -> Result<gif::Frame<'static>> {
    // The fastest search for a palette; our pictures have few colors.
    const SPEED: i32 = 30;
    let mut image =
        Bitmap::read_png(picture).with_context(|| format!("cannot read {}", picture.display()))?;
    if image.width > WIDTH {
        let height = (image.height * WIDTH).div_ceil(image.width);
        image = image.resized(WIDTH, height);
    }
    let (width, height) = (image.width as u16, image.height as u16);
    let pixels = image.pixels.as_flattened();
    let mut frame = gif::Frame::from_rgb_speed(width, height, pixels, SPEED);
    frame.make_lzw_pre_encoded();
    // Viewers do not show less than two hundredths.
    frame.delay = u16::try_from((DURATION / count).max(2)).unwrap_or(u16::MAX);
    Ok(frame)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chosen_pictures_are_even_and_end_with_the_last() {
        let pictures: Vec<PathBuf> = (0..100).map(|k| PathBuf::from(k.to_string())).collect();
        let chosen = choose(&pictures, 10);
        assert_eq!(chosen.len(), 10);
        assert_eq!((chosen[0], chosen[9]), (&pictures[9], &pictures[99]));
        assert_eq!(choose(&pictures[..3], 10).len(), 3);
        assert!(choose(&[], 10).is_empty());
    }
}
