//! A scan from above: what was called ground, and where that is wrong.

use std::path::Path;

use glam::Vec3;

use super::color::Rgb;
use super::error::PlotError;
use super::sheet;
use super::trajectory::map_view;
use super::view::{Key, KeyShape, Span, legend, title};

/// Called ground, rightly so.
const GROUND: Rgb = [0, 158, 115];
/// Called something else, rightly so.
const REST: Rgb = [220, 60, 40];
/// Ground that was missed.
const MISSED: Rgb = [0, 60, 220];
/// Something else that was called ground.
const FALSE: Rgb = [20, 20, 20];
/// Points that no class tells right or wrong of are paler.
const PALE: f64 = 0.35;

/// The points of a scan from above by what they were called: ground green and the rest red,
/// errors larger and in colours of their own.
#[derive(Clone, Copy, Debug)]
pub struct GroundPlot<'a> {
    /// Above everything.
    pub title: &'a str,
    /// Lidar frame [m].
    pub points: &'a [Vec3],
    /// Whether each point was called ground.
    pub called_ground: &'a [bool],
    /// Whether each point is ground; `None` where that is not known. Empty without labels.
    pub truth: &'a [Option<bool>],
    /// How far from the sensor the picture reaches, in both directions [m].
    pub reach_m: (f64, f64),
}

impl GroundPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        self.check(path)?;
        let (x_m, y_m) = self.reach_m;
        let (x, y) = (Span::new(-x_m, x_m), Span::new(-y_m, y_m));
        let (view, size) = map_view(x, y, 96.0, 30.0);
        let key = |name: &str, color: Rgb| Key {
            name: name.to_owned(),
            color,
            shape: KeyShape::Square,
        };
        let mut keys = vec![key("ground", GROUND), key("rest", REST)];
        if !self.truth.is_empty() {
            keys.push(key("missed ground", MISSED));
            keys.push(key("falsely called ground", FALSE));
        }
        sheet::save(path, size, |sheet| {
            title(sheet, self.title, view.rect.left)?;
            legend(sheet, &keys, (view.rect.left, 70.0), view.rect.right)?;
            view.grid(sheet)?;
            // Errors last, on top of everything.
            for errors in [false, true] {
                for (index, point) in self.points.iter().enumerate() {
                    let called = self.called_ground[index];
                    let truth = self.truth.get(index).copied().flatten();
                    let wrong = truth.is_some_and(|truth| truth != called);
                    let place = view.at(f64::from(point.x), f64::from(point.y));
                    if wrong != errors || !view.rect.holds(place) {
                        continue;
                    }
                    let (color, radius) = match (wrong, called) {
                        (false, true) => (GROUND, 0.8),
                        (false, false) => (REST, 0.8),
                        (true, true) => (FALSE, 1.7),
                        (true, false) => (MISSED, 1.7),
                    };
                    let unknown = !self.truth.is_empty() && truth.is_none();
                    let alpha = if unknown { PALE } else { 1.0 };
                    sheet.dot(place, radius, color, alpha)?;
                }
            }
            view.frame(sheet, "x [m]", "y [m]")?;
            view.scale_bar(sheet)
        })
    }

    fn check(&self, path: &Path) -> Result<(), PlotError> {
        let expected = self.points.len();
        let wrong_length = |what, found| {
            Err(PlotError::WrongLength {
                path: path.to_owned(),
                what,
                found,
                expected,
            })
        };
        if self.called_ground.len() != expected {
            return wrong_length("answers", self.called_ground.len());
        }
        if !self.truth.is_empty() && self.truth.len() != expected {
            return wrong_length("truths", self.truth.len());
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::bitmap::Bitmap;
    use super::*;

    #[test]
    fn errors_are_shown_in_colours_of_their_own() {
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

    #[test]
    fn an_answer_that_is_missing_is_told() {
        let plot = GroundPlot {
            title: "",
            points: &[Vec3::ZERO; 2],
            called_ground: &[true],
            truth: &[],
            reach_m: (10.0, 5.0),
        };
        let message = plot.save(Path::new("scan.png")).unwrap_err().to_string();
        assert!(message.contains("1 answers where 2 belong"), "{message}");
    }
}
