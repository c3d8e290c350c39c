//! Ground classification of a scan from above, with its errors.

use std::path::Path;

use anyhow::Result;
use glam::Vec3;

use super::bitmap::Bitmap;
use super::color::Rgb;
use super::sheet::save_png;
use super::view::{AxisRange, LegendEntry, Mark, TopView};

/// Color of points correctly classified as ground.
const GROUND: Rgb = [0, 158, 115];
/// Color of points correctly classified as not ground.
const REST: Rgb = [220, 60, 40];
/// Color of ground points that were missed.
const MISSED: Rgb = [0, 60, 220];
/// Color of other points that were classified as ground.
const FALSE: Rgb = [20, 20, 20];
/// Opacity of points whose true class is unknown.
const UNKNOWN_ALPHA: f64 = 0.35;

/// Points of a scan from above, colored by class; errors are larger, in colors of their own.
#[derive(Clone, Copy, Debug)]
pub struct GroundPlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Points in the lidar frame [m].
    pub points: &'a [Vec3],
    /// Whether each point was classified as ground.
    pub called_ground: &'a [bool],
    /// Whether each point is ground; `None` where unknown. Empty without labels.
    pub truth: &'a [Option<bool>],
    /// Visible distance from the sensor along x and along y [m].
    pub reach_m: (f64, f64),
}

impl GroundPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        let (points, answers, truths) = (self.points, self.called_ground, self.truth);
        debug_assert_eq!(answers.len(), points.len());
        let entry = |name: &str, color: Rgb| LegendEntry::new(name, color, Mark::Area);
        let mut legend = vec![entry("ground", GROUND), entry("rest", REST)];
        if !truths.is_empty() {
            legend.push(entry("missed ground", MISSED));
            legend.push(entry("false ground", FALSE));
        }
        let (x_m, y_m) = self.reach_m;
        let view = TopView {
            title: self.title,
            legend,
            x: AxisRange::new(-x_m, x_m),
            y: AxisRange::new(-y_m, y_m),
            color_bar: None,
        };
        view.draw(|sheet, view| {
            // Errors last, on top of everything.
            for errors in [false, true] {
                for (index, point) in points.iter().enumerate() {
                    let called = answers[index];
                    let truth = truths.get(index).copied().flatten();
                    let wrong = truth.is_some_and(|truth| truth != called);
                    let place = view.at(f64::from(point.x), f64::from(point.y));
                    if wrong != errors || !view.rect.contains(place) {
                        continue;
                    }
                    let (color, radius) = match (wrong, called) {
                        (false, true) => (GROUND, 0.8),
                        (false, false) => (REST, 0.8),
                        (true, true) => (FALSE, 1.7),
                        (true, false) => (MISSED, 1.7),
                    };
                    let unknown = !truths.is_empty() && truth.is_none();
                    let alpha = if unknown { UNKNOWN_ALPHA } else { 1.0 };
                    sheet.dot(place, radius, color, alpha)?;
                }
            }
            Ok(())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_have_colors_of_their_own() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scan.png");
        let points: Vec<Vec3> = (0..4)
            .map(|i| Vec3::new(4.0 * i as f32 - 6.0, 1.0, -1.7))
            .collect();
        let plot = GroundPlot {
            title: "four points",
            points: &points,
            called_ground: &[true, false, false, true],
            truth: &[Some(true), Some(false), Some(true), Some(false)],
            reach_m: (10.0, 5.0),
        };
        plot.save(&path).unwrap();
        let image = Bitmap::read_png(&path).unwrap();
        // In the legend and in the picture.
        let count = |color: Rgb| image.pixels.iter().filter(|pixel| **pixel == color).count();
        let with_errors = [GROUND, REST, MISSED, FALSE].map(count);
        assert!(
            with_errors.iter().all(|&count| count > 0),
            "{with_errors:?}"
        );
        let right = GroundPlot {
            truth: &[Some(true), Some(false), Some(false), Some(true)],
            ..plot
        };
        right.save(&path).unwrap();
        let image = Bitmap::read_png(&path).unwrap();
        let count = |color: Rgb| image.pixels.iter().filter(|pixel| **pixel == color).count();
        let without = [GROUND, REST, MISSED, FALSE].map(count);
        assert!(without[0] > with_errors[0] && without[2] < with_errors[2]);
    }
}
