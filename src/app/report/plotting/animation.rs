//! Animated GIF from the pictures of single frames.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use rayon::prelude::*;

use super::bitmap::Bitmap;
use crate::files::write_atomically;

/// Settings of an animated GIF.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Animation {
    /// Largest width [px]; wider pictures are scaled down.
    pub width: u32,
    /// Maximum number of pictures; they are chosen evenly and always include the last one.
    pub max_frames: usize,
    /// Total duration.
    pub duration: Duration,
}

impl Default for Animation {
    /// 1,200 pixels wide, up to 150 pictures, 10 per second.
    fn default() -> Self {
        Self {
            width: 1200,
            max_frames: 150,
            duration: Duration::from_secs(15),
        }
    }
}

impl Animation {
    /// Writes a GIF that repeats forever from PNG files, all of one size.
    pub fn save(&self, path: &Path, pictures: &[PathBuf]) -> Result<()> {
        let chosen = self.choose(pictures);
        ensure!(
            !chosen.is_empty(),
            "cannot write {}: there are no pictures to animate",
            path.display()
        );
        let frames = chosen
            .par_iter()
            .map(|picture| self.frame(picture, chosen.len()))
            .collect::<Result<Vec<gif::Frame>>>()?;
        write_atomically(path, |file| -> Result<()> {
            let mut encoder = gif::Encoder::new(file, frames[0].width, frames[0].height, &[])?;
            encoder.set_repeat(gif::Repeat::Infinite)?;
            for frame in &frames {
                encoder.write_lzw_pre_encoded_frame(frame)?;
            }
            Ok(())
        })
        .with_context(|| format!("cannot write {}", path.display()))
    }

    fn choose<'a>(&self, pictures: &'a [PathBuf]) -> Vec<&'a PathBuf> {
        let count = pictures.len().min(self.max_frames.max(1));
        (1..=count)
            .map(|k| &pictures[k * pictures.len() / count - 1])
            .collect()
    }

    /// Reads, scales, quantizes and compresses one of `count` pictures.
    fn frame(&self, picture: &Path, count: usize) -> Result<gif::Frame<'static>> {
        // The fastest search for a palette; our pictures have few colors.
        const SPEED: i32 = 30;
        let mut image = Bitmap::read_png(picture)
            .with_context(|| format!("cannot read {}", picture.display()))?;
        if image.width > self.width {
            let height = (image.height * self.width).div_ceil(image.width);
            image = image.resized(self.width, height);
        }
        let (width, height) = (image.width as u16, image.height as u16);
        let pixels = image.pixels.as_flattened();
        let mut frame = gif::Frame::from_rgb_speed(width, height, pixels, SPEED);
        frame.make_lzw_pre_encoded();
        // GIF counts hundredths of a second, and viewers do not show less than two.
        let delay = self.duration.as_millis() / 10 / count as u128;
        frame.delay = u16::try_from(delay.max(2)).unwrap_or(u16::MAX);
        Ok(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chosen_pictures_are_even_and_end_with_the_last() {
        let pictures: Vec<PathBuf> = (0..100).map(|k| PathBuf::from(k.to_string())).collect();
        let animation = Animation {
            max_frames: 10,
            ..Animation::default()
        };
        let chosen = animation.choose(&pictures);
        assert_eq!(chosen.len(), 10);
        assert_eq!((chosen[0], chosen[9]), (&pictures[9], &pictures[99]));
        assert_eq!(animation.choose(&pictures[..3]).len(), 3);
        assert!(animation.choose(&[]).is_empty());
    }
}
