//! Whether a file is a picture that somebody can look at.

use std::collections::BTreeMap;
use std::path::Path;

use fpmcl::app::plotting::Bitmap;

/// Least width that is readable on a screen and on paper [pixels].
const LEAST_WIDTH: u32 = 1200;

/// The uppermost rows have title and legend, which show every colour whatever is drawn [pixels].
const HEADING: u32 = 96;

/// Fewer pixels of a colour than this are no line and no marker.
const LEAST_OF_A_COLOR: usize = 40;

/// A picture by its colours.
pub struct Picture {
    name: String,
    width: u32,
    /// Pixels of each colour below the heading.
    colors: BTreeMap<[u8; 3], usize>,
}

impl Picture {
    /// Reads a PNG.
    #[track_caller]
    pub fn read(path: &Path) -> Self {
        let name = path.display().to_string();
        let pixels = match Bitmap::read_png(path) {
            Ok(pixels) => pixels,
            Err(error) => panic!("{name}: {error}"),
        };
        Self::of(name, &pixels)
    }

    /// The picture that some pixels make.
    pub fn of(name: String, pixels: &Bitmap) -> Self {
        let mut colors = BTreeMap::new();
        let heading = (HEADING * pixels.width) as usize;
        for pixel in pixels.pixels.iter().skip(heading) {
            *colors.entry(*pixel).or_default() += 1;
        }
        Self {
            name,
            width: pixels.width,
            colors,
        }
    }

    /// Expects a readable size, something drawn on it, and lines of these colours.
    #[track_caller]
    pub fn shows(&self, colors: &[[u8; 3]]) {
        self.shows_at_least(LEAST_OF_A_COLOR, colors);
    }

    /// The same, with that many pixels of each of these colours: more than the legend of a
    /// second chart has.
    #[track_caller]
    pub fn shows_at_least(&self, pixels: usize, colors: &[[u8; 3]]) {
        if let Some(objection) = self.objection(pixels, colors) {
            panic!("{}: {objection}", self.name);
        }
    }

    /// What speaks against the picture.
    pub fn objection(&self, least: usize, colors: &[[u8; 3]]) -> Option<String> {
        if self.width < LEAST_WIDTH {
            return Some(format!("only {} pixels wide", self.width));
        }
        let pixels = self.colors.values().sum::<usize>();
        let background = self.colors.values().copied().max().unwrap_or_default();
        if self.colors.len() < 5 || pixels - background < pixels / 200 {
            return Some("blank".to_owned());
        }
        colors
            .iter()
            .find(|color| self.colors.get(*color).copied().unwrap_or_default() < least)
            .map(|color| format!("nothing is drawn in {color:?}"))
    }
}
