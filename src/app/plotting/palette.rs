//! A picture with at most 256 colours: a quarter of the bytes, and nobody sees the difference.
//!
//! Colours are taken from the most frequent on, each unless one that is taken is within a
//! distance of it; every pixel becomes the nearest that was taken. The distance is the smallest
//! of a few that leaves 256, so the flat colours of lines and text stay as they are, and no
//! channel of a pixel moves by more than it.

use std::collections::BTreeMap;
use std::path::Path;

use super::bitmap::Bitmap;
use super::color::Rgb;
use super::error::PlotError;

/// Colours of a palette of a byte.
const COLORS: usize = 256;

/// The PNG of a picture with a palette.
pub fn with_palette(path: &Path) -> Result<Vec<u8>, PlotError> {
    let read = |source| PlotError::Read {
        path: path.to_owned(),
        source,
    };
    let image = Bitmap::read_png(path).map_err(read)?;
    encoded(&image).map_err(|source| PlotError::Encode {
        path: path.to_owned(),
        source,
    })
}

fn encoded(image: &Bitmap) -> Result<Vec<u8>, std::io::Error> {
    let (palette, place) = palette_of(image);
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, image.width, image.height);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::High);
    // Neighbours in a palette have nothing in common that a filter could take away.
    encoder.set_filter(png::Filter::NoFilter);
    encoder.set_palette(palette.concat());
    let mut writer = encoder.write_header()?;
    let pixels: Vec<u8> = image.pixels.iter().map(|pixel| place[pixel]).collect();
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(bytes)
}

/// The palette, and for every colour of the picture its place in it.
fn palette_of(image: &Bitmap) -> (Vec<Rgb>, BTreeMap<Rgb, u8>) {
    let mut counts = BTreeMap::<Rgb, usize>::new();
    for &pixel in &image.pixels {
        *counts.entry(pixel).or_default() += 1;
    }
    let mut colors: Vec<(Rgb, usize)> = counts.into_iter().collect();
    colors.sort_by_key(|&(color, count)| (std::cmp::Reverse(count), color));
    let palette = (0..=u8::MAX)
        .find_map(|apart| chosen(&colors, apart))
        .unwrap_or_default();
    let nearest = |color: Rgb| {
        let places = 0..=u8::MAX;
        let place = places
            .zip(&palette)
            .min_by_key(|(_, taken)| distance(color, **taken));
        place.map_or(0, |(place, _)| place)
    };
    let places = colors.iter().map(|&(color, _)| (color, nearest(color)));
    let places = places.collect();
    (palette, places)
}

/// Frequent colours that are farther apart than some distance; `None` if they are too many.
fn chosen(colors: &[(Rgb, usize)], apart: u8) -> Option<Vec<Rgb>> {
    let mut taken: Vec<Rgb> = Vec::new();
    for &(color, _) in colors {
        if taken.iter().all(|other| distance(color, *other) > apart) {
            if taken.len() == COLORS {
                return None;
            }
            taken.push(color);
        }
    }
    Some(taken)
}

/// The largest difference of a channel.
fn distance(a: Rgb, b: Rgb) -> u8 {
    let [red, green, blue] = std::array::from_fn(|channel| a[channel].abs_diff(b[channel]));
    red.max(green).max(blue)
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
    fn a_picture_of_few_colours_stays_as_it_is() {
        let image = Bitmap::from_fn(40, 30, |x, y| [x as u8, (y / 6) as u8, 9]);
        assert_eq!(decoded(&image), image);
    }

    #[test]
    fn lines_keep_their_colours_and_no_pixel_moves_far() {
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
