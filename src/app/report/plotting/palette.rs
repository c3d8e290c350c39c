//! Reduction of a picture to at most 256 colors: a quarter of the bytes without visible difference.
//!
//! Colors are selected in descending order of frequency, each unless a selected color is within a
//! distance of it; every pixel becomes the nearest selected color. The distance is the smallest
//! that leaves at most 256, so the flat colors of lines and text stay as they are, and no
//! channel of a pixel changes by more than it.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context as _, Result};

use super::bitmap::Bitmap;
use super::color::Rgb;

/// Maximum number of colors of a palette with indices of one byte.
const COLORS: usize = 256;

/// Reads a PNG file and encodes it with a palette.
pub fn with_palette(path: &Path) -> Result<Vec<u8>> {
    let image =
        Bitmap::read_png(path).with_context(|| format!("cannot read {}", path.display()))?;
    encoded(&image).with_context(|| format!("cannot reduce the colors of {}", path.display()))
}

/// Encodes a picture with a palette.
pub fn encoded(image: &Bitmap) -> Result<Vec<u8>, png::EncodingError> {
    let (palette, index) = palette_of(image);
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, image.width, image.height);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_compression(png::Compression::High);
    // Neighboring indices have nothing in common that a filter could remove.
    encoder.set_filter(png::Filter::NoFilter);
    encoder.set_palette(palette.concat());
    let mut writer = encoder.write_header()?;
    let pixels: Vec<u8> = image.pixels.iter().map(|pixel| index[pixel]).collect();
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(bytes)
}

/// The palette, and the index in it for every color of the picture.
fn palette_of(image: &Bitmap) -> (Vec<Rgb>, BTreeMap<Rgb, u8>) {
    let mut counts = BTreeMap::<Rgb, usize>::new();
    for &pixel in &image.pixels {
        *counts.entry(pixel).or_default() += 1;
    }
    let mut colors: Vec<(Rgb, usize)> = counts.into_iter().collect();
    colors.sort_by_key(|&(color, count)| (std::cmp::Reverse(count), color));
    let palette = (0..=u8::MAX)
        .find_map(|apart| selected(&colors, apart))
        .unwrap_or_default();
    let nearest = |color: Rgb| {
        let indices = (0..=u8::MAX).zip(&palette);
        let nearest = indices.min_by_key(|(_, selected)| distance(color, **selected));
        nearest.map_or(0, |(index, _)| index)
    };
    let indices = colors.iter().map(|&(color, _)| (color, nearest(color)));
    let indices = indices.collect();
    (palette, indices)
}

/// Frequent colors that are farther apart than a distance; `None` if they are too many.
fn selected(colors: &[(Rgb, usize)], apart: u8) -> Option<Vec<Rgb>> {
    let mut selected: Vec<Rgb> = Vec::new();
    for &(color, _) in colors {
        if selected.iter().all(|other| distance(color, *other) > apart) {
            if selected.len() == COLORS {
                return None;
            }
            selected.push(color);
        }
    }
    Some(selected)
}

/// Largest difference of a channel.
fn distance(a: Rgb, b: Rgb) -> u8 {
    let differences = a.iter().zip(b).map(|(a, b)| a.abs_diff(b));
    differences.max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::super::color::{Colormap, MCL, REFINED};
    use super::*;

    fn decoded(image: &Bitmap) -> Bitmap {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("palette.png");
        std::fs::write(&path, encoded(image).unwrap()).unwrap();
        Bitmap::read_png(&path).unwrap()
    }

    #[test]
    fn a_picture_of_few_colors_is_unchanged() {
        let image = Bitmap::from_fn(40, 30, |x, y| [x as u8, (y / 6) as u8, 9]);
        assert_eq!(decoded(&image), image);
    }

    #[test]
    fn lines_keep_their_colors_and_no_pixel_changes_much() {
        let image = Bitmap::from_fn(300, 300, |x, y| match (x, y) {
            (_, 100) => MCL,
            (_, 101) => REFINED,
            _ => {
                let [red, green, blue] = Colormap::Viridis.at(f64::from(x) / 300.0);
                [red, green, blue / 2 + (y / 3) as u8]
            }
        });
        let colors = |image: &Bitmap| {
            let all: std::collections::BTreeSet<&Rgb> = image.pixels.iter().collect();
            all.len()
        };
        assert!(colors(&image) > 10 * COLORS);
        let found = decoded(&image);
        assert!(colors(&found) <= COLORS);
        assert_eq!(found.pixel(7, 100), MCL);
        assert_eq!(found.pixel(7, 101), REFINED);
        let farthest = image.pixels.iter().zip(&found.pixels);
        let farthest = farthest.map(|(a, b)| distance(*a, *b)).max().unwrap();
        assert!(farthest <= 12, "{farthest}");
    }
}
