//! Frames of localization as a moving picture.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::time::Duration;

use image::codecs::gif::{GifEncoder, Repeat};
use image::imageops::FilterType;
use image::{Delay, DynamicImage, Frame, ImageError};

use super::error::PlotError;
use crate::evaluation::write_atomically;

/// How a folder of pictures becomes a GIF.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Animation {
    /// Width of the pictures in it [px]; they are shrunk to it.
    pub width: u32,
    /// At most so many pictures, evenly chosen, the last one always.
    pub max_frames: usize,
    /// How long the whole takes.
    pub duration: Duration,
}

impl Default for Animation {
    /// 1,200 pixels wide, up to 150 pictures, ten a second.
    fn default() -> Self {
        Self {
            width: 1200,
            max_frames: 150,
            duration: Duration::from_secs(15),
        }
    }
}

impl Animation {
    /// Makes a GIF that repeats for ever of pictures on disk, which all have one size.
    pub fn save(&self, path: &Path, pictures: &[PathBuf]) -> Result<(), PlotError> {
        let chosen = self.choose(pictures);
        if chosen.is_empty() {
            return Err(PlotError::Nothing {
                path: path.to_owned(),
                what: "there are no pictures to animate",
            });
        }
        // GIF counts in hundredths of a second, and viewers do not show less than two.
        let delay = (self.duration / chosen.len() as u32).max(Duration::from_millis(20));
        write_atomically(path, |file| self.encode(file, &chosen, delay)).map_err(
            |source: PictureError| match source {
                PictureError::Read { path, source } => PlotError::Read { path, source },
                PictureError::Write(source) => PlotError::Write {
                    path: path.to_owned(),
                    source,
                },
            },
        )
    }

    fn choose<'a>(&self, pictures: &'a [PathBuf]) -> Vec<&'a PathBuf> {
        let count = pictures.len().min(self.max_frames.max(1));
        (1..=count)
            .map(|k| &pictures[k * pictures.len() / count - 1])
            .collect()
    }

    fn encode(
        &self,
        file: &mut BufWriter<&mut File>,
        pictures: &[&PathBuf],
        delay: Duration,
    ) -> Result<(), PictureError> {
        // The fastest search for a palette; our pictures have few colours.
        const SPEED: i32 = 30;
        let mut encoder = GifEncoder::new_with_speed(file, SPEED);
        encoder.set_repeat(Repeat::Infinite)?;
        for &picture in pictures {
            let image = image::open(picture).map_err(|source| PictureError::Read {
                path: picture.clone(),
                source,
            })?;
            let pixels = self.shrink(image).into_rgba8();
            let delay = Delay::from_saturating_duration(delay);
            encoder.encode_frame(Frame::from_parts(pixels, 0, 0, delay))?;
        }
        Ok(())
    }

    fn shrink(&self, image: DynamicImage) -> DynamicImage {
        if image.width() <= self.width {
            return image;
        }
        let height = (image.height() * self.width).div_ceil(image.width());
        image.resize_exact(self.width, height, FilterType::Triangle)
    }
}

/// Which side of the work failed.
enum PictureError {
    Read { path: PathBuf, source: ImageError },
    Write(ImageError),
}

impl From<std::io::Error> for PictureError {
    fn from(error: std::io::Error) -> Self {
        Self::Write(ImageError::IoError(error))
    }
}

impl From<ImageError> for PictureError {
    fn from(error: ImageError) -> Self {
        Self::Write(error)
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
