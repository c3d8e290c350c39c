//! Checks of the pictures of a run.

use std::collections::BTreeMap;
use std::path::Path;

use fpmcl::internals::app::Bitmap;

/// Minimum width that is readable on a screen and on paper [px].
const MIN_WIDTH: u32 = 1200;

/// Rows of title and legend, which have every color regardless of the content [px].
const HEADING: u32 = 96;

/// Minimum number of pixels of a line or a marker.
const MIN_PIXELS: usize = 40;

/// Colors of a picture.
pub struct Picture {
    name: String,
    width: u32,
    /// Number of pixels of each color below title and legend.
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

    /// Counts the colors of a bitmap.
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

    /// Expects a readable size, some content, and lines of these colors.
    #[track_caller]
    pub fn shows(&self, colors: &[[u8; 3]]) {
        self.shows_at_least(MIN_PIXELS, colors);
    }

    /// As [`shows`](Self::shows) with a minimum number of pixels of each color, such as more than
    /// the legend of a second chart has.
    #[track_caller]
    pub fn shows_at_least(&self, pixels: usize, colors: &[[u8; 3]]) {
        if let Some(defect) = self.defect(pixels, colors) {
            panic!("{}: {defect}", self.name);
        }
    }

    /// Defect of the picture.
    pub fn defect(&self, least: usize, colors: &[[u8; 3]]) -> Option<String> {
        if self.width < MIN_WIDTH {
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
