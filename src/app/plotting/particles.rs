//! One frame of localization from above: particles, estimate and truth on the map.

use std::path::Path;

use super::MapImage;
use super::color::{Colormap, MCL, REFINED, Rgb, TRUTH, WHITE};
use super::error::{DrawError, PlotError};
use super::sheet::{self, Pen, Point, Rect, Sheet};
use super::trajectory::{map_view, places};
use super::view::{Key, KeyShape, Span, View, color_bar, legend, title};
use crate::evaluation::ParticleRow;
use crate::geometry::Pose2;

/// What is known in one frame. Everything that is absent is left out.
#[derive(Clone, Copy, Debug, Default)]
pub struct LocalizationPicture<'a> {
    /// Above everything, such as "frame 12".
    pub title: &'a str,
    /// Drawn pale below everything.
    pub map: Option<&'a MapImage>,
    /// x, y [m], heading [rad], weight.
    pub particles: &'a [ParticleRow],
    /// The filter's estimate.
    pub estimate: Option<Pose2>,
    /// The refined pose.
    pub refined: Option<Pose2>,
    /// The true pose.
    pub ground_truth: Option<Pose2>,
    /// Where the car has been, by the truth.
    pub driven: &'a [Pose2],
    /// Centre and width of what is shown [m]; all of the above where it is absent.
    pub window: Option<([f64; 2], f64)>,
}

impl LocalizationPicture<'_> {
    /// Writes the picture, 1400 pixels wide.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        let (x, y) = self.extent().ok_or_else(|| PlotError::Nothing {
            path: path.to_owned(),
            what: "there are no particles and no poses",
        })?;
        let (view, size) = map_view(x, y, 96.0, 150.0);
        sheet::save(path, size, |sheet| self.draw(sheet, &view))
    }

    /// What is shown: the window, or everything with a margin.
    fn extent(&self) -> Option<(Span, Span)> {
        const NARROWEST_M: f64 = 24.0;
        if let Some(([x, y], width_m)) = self.window {
            let square = |center: f64| Span::new(center, center).at_least(width_m);
            return Some((square(x), Span::new(y, y).at_least(0.6 * width_m)));
        }
        let poses = [self.estimate, self.refined, self.ground_truth];
        let poses = || poses.iter().flatten().map(|pose| pose.translation.vector);
        let particles = || self.particles.iter();
        let x = Span::of(
            particles()
                .map(|p| f64::from(p[0]))
                .chain(poses().map(|t| t.x)),
        )?;
        let y = Span::of(
            particles()
                .map(|p| f64::from(p[1]))
                .chain(poses().map(|t| t.y)),
        )?;
        let margin = |span: Span| span.padded(0.06 * span.length());
        Some((
            margin(x).at_least(NARROWEST_M),
            margin(y).at_least(0.6 * NARROWEST_M),
        ))
    }

    fn draw(&self, sheet: &Sheet, view: &View) -> Result<(), DrawError> {
        title(sheet, self.title, view.rect.left)?;
        legend(sheet, &self.keys(), (view.rect.left, 70.0), view.rect.right)?;
        view.grid(sheet)?;
        if let Some(map) = self.map {
            map.draw(sheet, view, 0.65)?;
        }
        let driven = places(self.driven, view);
        sheet.dashes(&driven, &view.rect, Pen::new(TRUTH, 2.5), (8.0, 6.0))?;
        let weights = self.draw_particles(sheet, view)?;
        // The thinner ones on top, so that all are seen where they agree.
        for (pose, pen, length) in [
            (self.ground_truth, Pen::new(TRUTH, 11.0), 68.0),
            (self.estimate, Pen::new(MCL, 6.0), 52.0),
            (self.refined, Pen::new(REFINED, 2.5), 40.0),
        ] {
            if let Some(pose) = pose {
                arrow(sheet, view, &pose, pen, length)?;
            }
        }
        view.frame(sheet, "x [m]", "y [m]")?;
        view.scale_bar(sheet)?;
        let bar = Rect {
            left: view.rect.right + 22.0,
            right: view.rect.right + 48.0,
            ..view.rect
        };
        match weights {
            Some(span) => color_bar(sheet, bar, span, Colormap::Viridis, "weight / largest"),
            None => Ok(()),
        }
    }

    fn keys(&self) -> Vec<Key> {
        let key = |name: &str, color: Rgb, shape: KeyShape| Key {
            name: name.to_owned(),
            color,
            shape,
        };
        let count = format!("{} particles, coloured by weight", self.particles.len());
        [
            Some(key(&count, Colormap::Viridis.at(0.0), KeyShape::Dot)),
            (self.ground_truth).map(|_| key("ground truth", TRUTH, KeyShape::Line)),
            self.estimate.map(|_| key("MCL", MCL, KeyShape::Line)),
            self.refined
                .map(|_| key("refined", REFINED, KeyShape::Line)),
            (self.driven.len() > 1).then(|| key("driven", TRUTH, KeyShape::Dashes)),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    /// Particles with a tail against their heading, light ones first; the span of the weights.
    fn draw_particles(&self, sheet: &Sheet, view: &View) -> Result<Option<Span>, DrawError> {
        let largest = self.particles.iter().map(|p| p[3]).fold(0.0, f32::max);
        let mut order: Vec<&ParticleRow> = self.particles.iter().collect();
        order.sort_by(|a, b| a[3].total_cmp(&b[3]));
        let crowded = order.len() > 2000;
        let (radius, tail) = if crowded { (1.5, 0.0) } else { (3.0, 11.0) };
        for particle in order {
            let [x, y, heading, weight] = particle.map(f64::from);
            let place = view.at(x, y);
            if !view.rect.holds(place) {
                continue;
            }
            let color = Colormap::Viridis.at(weight / f64::from(largest).max(1e-30));
            if tail > 0.0 {
                let end = (
                    place.0 + tail * heading.cos(),
                    place.1 - tail * heading.sin(),
                );
                sheet.line(place, end, Pen::new(color, 1.5))?;
            }
            sheet.dot(place, radius, color, 1.0)?;
        }
        Ok((!self.particles.is_empty()).then(|| Span::new(0.0, 1.0)))
    }
}

/// An arrow of a length in pixels, whose tail is at the pose, with a white rim.
fn arrow(sheet: &Sheet, view: &View, pose: &Pose2, pen: Pen, length: f64) -> Result<(), DrawError> {
    let tail = view.at(pose.translation.x, pose.translation.y);
    if !view.rect.holds(tail) {
        return Ok(());
    }
    let (sin, cos) = pose.rotation.angle().sin_cos();
    // Forward and left of the arrow on the sheet, whose y points down.
    let at = |forward: f64, left: f64| -> Point {
        (
            tail.0 + forward * cos - left * sin,
            tail.1 - forward * sin - left * cos,
        )
    };
    let half = 5.0 + 0.6 * pen.width;
    for (color, rim) in [(WHITE, 1.2), (pen.color, 0.0)] {
        let stem = Pen::new(color, pen.width + 2.0 * rim);
        sheet.line(tail, at(length - 14.0, 0.0), stem)?;
        let head = [
            at(length + 2.0 * rim, 0.0),
            at(length - 20.0 - rim, half + 1.5 * rim),
            at(length - 20.0 - rim, -half - 1.5 * rim),
        ];
        sheet.polygon(&head, color)?;
        sheet.dot(tail, 3.0 + 0.5 * pen.width + rim, color, 1.0)?;
    }
    Ok(())
}
