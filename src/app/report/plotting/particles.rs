//! One frame of localization from above: particles, estimate and true pose on the map.

use std::path::Path;

use anyhow::{Context as _, Result};

use super::MapImage;
use super::bitmap::Bitmap;
use super::color::{Colormap, MCL, Rgb, TRUTH, WHITE};
use super::sheet::{Point, Sheet, save_png, stroke};
use super::view::{AxisRange, ColorBar, LegendEntry, Mark, TopView, View, positions};
use crate::evaluation::ParticleRow;
use crate::geometry::Pose2;

/// Particles and poses of a frame; whatever is absent is left out.
#[derive(Clone, Copy, Debug, Default)]
pub struct LocalizationPicture<'a> {
    /// Title, such as "frame 12".
    pub title: &'a str,
    /// Map, drawn pale below everything.
    pub map: Option<&'a MapImage>,
    /// Particles: x, y [m], heading [rad], and the weight, which colors them.
    pub particles: &'a [ParticleRow],
    /// Name of the weight, relative to the largest.
    pub color_name: &'a str,
    /// Estimate of the filter.
    pub estimate: Option<Pose2>,
    /// True pose.
    pub ground_truth: Option<Pose2>,
    /// True trajectory so far.
    pub driven: &'a [Pose2],
    /// Center and width of the visible part [m]; `None` for particles and poses with a margin.
    pub window: Option<([f64; 2], f64)>,
}

impl LocalizationPicture<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        let (x, y) = self.extent()?;
        let count = format!("{} particles", self.particles.len());
        let particles = Some((count.as_str(), Colormap::Viridis.at(0.0), Mark::Dots));
        let truth = (self.ground_truth).map(|_| ("ground truth", TRUTH, Mark::Line));
        let estimate = self.estimate.map(|_| ("MCL", MCL, Mark::Line));
        let driven = (self.driven.len() > 1).then_some(("driven", TRUTH, Mark::Dashes));
        let entries = [particles, truth, estimate, driven].into_iter().flatten();
        let view = TopView {
            title: self.title,
            legend: entries
                .map(|(name, color, mark)| LegendEntry::new(name, color, mark))
                .collect(),
            x,
            y,
            color_bar: Some(ColorBar {
                range: AxisRange::new(0.0, 1.0),
                colormap: Colormap::Viridis,
                name: self.color_name,
            }),
        };
        view.draw(|sheet, view| self.draw_content(sheet, view))
    }

    /// Draws map, particles and poses.
    fn draw_content(&self, sheet: &Sheet, view: &View) -> Result<()> {
        if let Some(map) = self.map {
            map.draw(sheet, view, 0.5)?;
        }
        let driven = positions(self.driven, view);
        sheet.dashes(&driven, &view.rect, stroke(TRUTH, 2.5), (8.0, 6.0))?;
        self.draw_particles(sheet, view)?;
        // The thinner arrow is on top, so that both are visible where they agree.
        for (pose, color, width, length) in [
            (self.ground_truth, TRUTH, 11.0, 68.0),
            (self.estimate, MCL, 6.0, 52.0),
        ] {
            if let Some(pose) = pose {
                draw_arrow(sheet, view, &pose, color, [width, length])?;
            }
        }
        Ok(())
    }

    /// Visible ranges of x and y: the window, or particles and poses with a margin.
    fn extent(&self) -> Result<(AxisRange, AxisRange)> {
        const NARROWEST_M: f64 = 24.0;
        if let Some(([x, y], width_m)) = self.window {
            let [x, y] = [x, y].map(|center| AxisRange::new(center, center));
            return Ok((x.at_least(width_m), y.at_least(0.6 * width_m)));
        }
        let poses = [self.estimate, self.ground_truth].into_iter().flatten();
        let poses = poses.map(|pose| [pose.translation.x, pose.translation.y]);
        let particles = self.particles.iter();
        let particles = particles.map(|&[x, y, ..]| [f64::from(x), f64::from(y)]);
        let points: Vec<[f64; 2]> = particles.chain(poses).collect();
        let range = |axis: usize, narrowest_m: f64| {
            let range = AxisRange::of(points.iter().map(|point| point[axis]))?;
            Some(range.padded(0.06 * range.length()).at_least(narrowest_m))
        };
        (range(0, NARROWEST_M).zip(range(1, 0.6 * NARROWEST_M)))
            .context("there is nothing to draw: there are no particles and no poses")
    }

    /// Draws particles with a line along their heading, in ascending order of weight.
    fn draw_particles(&self, sheet: &Sheet, view: &View) -> Result<()> {
        let largest = self.particles.iter().map(|p| p[3]).fold(0.0, f32::max);
        let mut order: Vec<&ParticleRow> = self.particles.iter().collect();
        order.sort_by(|a, b| a[3].total_cmp(&b[3]));
        let crowded = order.len() > 2000;
        let (radius, length) = if crowded { (1.5, 0.0) } else { (3.0, 11.0) };
        for particle in order {
            let [x, y, heading, weight] = particle.map(f64::from);
            let place = view.at(x, y);
            if !view.rect.contains(place) {
                continue;
            }
            let color = Colormap::Viridis.at(weight / f64::from(largest).max(1e-30));
            if length > 0.0 {
                let (sin, cos) = heading.sin_cos();
                let end = (place.0 + length * cos, place.1 - length * sin);
                sheet.line(place, end, stroke(color, 1.5))?;
            }
            sheet.dot(place, radius, color, 1.0)?;
        }
        Ok(())
    }
}

/// Draws an arrow with a white border, whose tail is at the pose; width and length in pixels.
fn draw_arrow(
    sheet: &Sheet,
    view: &View,
    pose: &Pose2,
    color: Rgb,
    [width, length]: [f64; 2],
) -> Result<()> {
    let tail = view.at(pose.translation.x, pose.translation.y);
    if !view.rect.contains(tail) {
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
    let half = 5.0 + 0.6 * width;
    for (color, border) in [(WHITE, 1.2), (color, 0.0)] {
        let shaft = stroke(color, width + 2.0 * border);
        sheet.line(tail, at(length - 14.0, 0.0), shaft)?;
        let head = [
            at(length + 2.0 * border, 0.0),
            at(length - 20.0 - border, half + 1.5 * border),
            at(length - 20.0 - border, -half - 1.5 * border),
        ];
        sheet.polygon(&head, color)?;
        sheet.dot(tail, 3.0 + 0.5 * width + border, color, 1.0)?;
    }
    Ok(())
}
