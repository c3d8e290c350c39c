//! Raster image in memory: read from PNG, written as PNG, resampled.

use std::fs::File;
use std::io::{self, BufReader, Write};
use std::path::Path;

use rayon::prelude::*;

use super::color::Rgb;

/// Raster of colors.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bitmap {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Colors, row by row from the top.
    pub pixels: Vec<Rgb>,
}

impl Bitmap {
    /// Evaluates `color` for each (column, row).
    pub fn from_fn(width: u32, height: u32, color: impl Fn(u32, u32) -> Rgb + Sync) -> Self {
        let color = &color;
        let rows = (0..height).into_par_iter();
        let pixels = rows.flat_map_iter(|y| (0..width).map(move |x| color(x, y)));
        Self {
            width,
            height,
            pixels: pixels.collect(),
        }
    }

    /// Reads a PNG file of any color type; transparency is ignored.
    pub fn read_png(path: &Path) -> io::Result<Self> {
        let mut decoder = png::Decoder::new(BufReader::new(File::open(path)?));
        decoder.set_transformations(png::Transformations::normalize_to_color8());
        let mut reader = decoder.read_info()?;
        let size = reader.output_buffer_size();
        let mut bytes = vec![0; size.ok_or_else(|| io::Error::other("the image is too large"))?];
        let frame = reader.next_frame(&mut bytes)?;
        let samples = bytes[..frame.buffer_size()].chunks_exact(frame.color_type.samples());
        let pixels = samples.map(|samples| match *samples {
            [red, green, blue, ..] => [red, green, blue],
            _ => [samples[0]; 3],
        });
        Ok(Self {
            width: frame.width,
            height: frame.height,
            pixels: pixels.collect(),
        })
    }

    /// Writes a PNG of 8 bits per channel.
    pub fn write_png(&self, writer: impl Write) -> io::Result<()> {
        self.encode(writer, png::Compression::Fast)
    }

    fn encode(&self, writer: impl Write, compression: png::Compression) -> io::Result<()> {
        let mut encoder = png::Encoder::new(writer, self.width, self.height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_compression(compression);
        encoder.set_filter(png::Filter::Adaptive);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(self.pixels.as_flattened())?;
        Ok(writer.finish()?)
    }

    /// A PNG of few bytes in memory.
    pub fn to_png(&self) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.encode(&mut bytes, png::Compression::Balanced)?;
        Ok(bytes)
    }

    /// Color at (column, row).
    pub fn pixel(&self, x: u32, y: u32) -> Rgb {
        self.pixels[y as usize * self.width as usize + x as usize]
    }

    /// Resamples to another size: each pixel is the mean of the area that it covers.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let columns = covered(self.width, width);
        let rows = covered(self.height, height);
        Self::from_fn(width, height, |x, y| {
            let mut mean = [0.5_f32; 3];
            for &(row, row_weight) in &rows[y as usize] {
                for &(column, column_weight) in &columns[x as usize] {
                    let color = self.pixel(column, row);
                    for (mean, channel) in mean.iter_mut().zip(color) {
                        *mean += row_weight * column_weight * f32::from(channel);
                    }
                }
            }
            mean.map(|channel| channel as u8)
        })
    }
}

/// For each of `target` pixels along an axis of `source` pixels, the source pixels that it covers
/// and their weights, whose sum is 1.
fn covered(source: u32, target: u32) -> Vec<Vec<(u32, f32)>> {
    let scale = f64::from(source) / f64::from(target);
    let pixel = |k: u32| {
        let (start, end) = (f64::from(k) * scale, f64::from(k + 1) * scale);
        let last = (end.ceil() as u32).min(source);
        let overlap = |i: u32| f64::from(i + 1).min(end) - f64::from(i).max(start);
        (start as u32..last)
            .map(|i| (i, (overlap(i) / scale) as f32))
            .collect()
    };
    (0..target).map(pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gradient(width: u32, height: u32) -> Bitmap {
        Bitmap::from_fn(width, height, |x, y| [x as u8, y as u8, (x + y) as u8])
    }

    #[test]
    fn a_png_is_read_as_it_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gradient.png");
        let bitmap = gradient(40, 30);
        bitmap.write_png(File::create(&path).unwrap()).unwrap();
        assert_eq!(Bitmap::read_png(&path).unwrap(), bitmap);
        std::fs::write(&path, "half a").unwrap();
        assert!(Bitmap::read_png(&path).is_err());
    }

    #[test]
    fn resampling_keeps_the_mean_and_the_same_size_keeps_all() {
        let bitmap = gradient(120, 60);
        assert_eq!(bitmap.resized(120, 60), bitmap);
        let half = bitmap.resized(60, 30);
        // Mean of 0, 1, 0, 1, rounded half up.
        assert_eq!(half.pixel(0, 0), [1, 1, 1]);
        let mean = |bitmap: &Bitmap| {
            let sum: u32 = bitmap.pixels.iter().map(|pixel| u32::from(pixel[0])).sum();
            f64::from(sum) / bitmap.pixels.len() as f64
        };
        for (width, height) in [(100, 50), (97, 13), (240, 90)] {
            let resized = bitmap.resized(width, height);
            assert!((mean(&resized) - mean(&bitmap)).abs() < 0.6, "{width}");
        }
    }

    #[test]
    fn weights_of_covered_pixels_sum_to_one() {
        for (source, target) in [(1400, 1200), (2800, 1400), (10, 25), (7, 1)] {
            for pixel in covered(source, target) {
                let sum: f32 = pixel.iter().map(|(_, weight)| weight).sum();
                assert!((sum - 1.0).abs() < 1e-5, "{source} to {target}: {pixel:?}");
            }
        }
    }
}
