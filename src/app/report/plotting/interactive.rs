//! Content of the interactive path of a page: the map from above and, for each frame, its pose, state, numbers
//! and the outline of its scan. `interactive.js` of the page draws it.

use std::path::Path;

use anyhow::{Context as _, Result};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use nalgebra::Matrix3;
use serde_json::{Value, json};

use super::color::{Colormap, MCL, REFINED, Rgb, STATES, TRUTH};
use super::map_image::MapImage;
use crate::app::report::results::{LocalizationResults, RowLog};
use crate::app::run::output;
use crate::evaluation::trust::Axes;
use crate::evaluation::{PlanarError, planar_errors};
use crate::geometry::Pose2;
use crate::localization::State;

/// A path of estimates with what is known about each frame.
pub struct InteractivePath<'a> {
    /// Results of the run.
    pub results: &'a LocalizationResults,
    /// Trajectory of the filter, a pose per frame.
    pub estimates: &'a [Pose2],
    /// Map below the path.
    pub map: Option<&'a MapImage>,
}

impl InteractivePath<'_> {
    /// Writes the content as JSON.
    pub fn save(&self, path: &Path) -> Result<()> {
        let content = self.content();
        let content = content.with_context(|| format!("cannot draw {}", path.display()))?;
        output::write_file(path, |file| serde_json::to_writer(file, &content))
    }

    fn content(&self) -> Result<Value> {
        let results = self.results;
        let best = results.refined.as_deref().unwrap_or(self.estimates);
        let axes = |all: &[Matrix3<f64>]| -> Vec<f64> {
            let pairs = all.iter().zip(best);
            pairs
                .map(|(covariance, pose)| {
                    rounded(100.0 * Axes::new(covariance, pose).long_m, 100.0)
                })
                .collect()
        };
        let errors = (results.ground_truth.as_ref()).map(|truth| planar_errors(best, truth));
        let numbers = |value: fn(&PlanarError) -> f64, per_unit: f64| -> Option<Vec<f64>> {
            let errors = errors.as_ref()?.iter();
            Some(
                errors
                    .map(|error| rounded(value(error), per_unit))
                    .collect(),
            )
        };
        let word = |&number: &u8| Some(State::from_number(number)?.word());
        let states = results.states.as_ref();
        let colors = STATES.map(|(state, color)| (state.word().to_owned(), css(color).into()));
        Ok(json!({
            "map": self.map.map(map_layer).transpose()?,
            "frames": results.frames,
            "times_s": results.recorded_times(),
            "name": if results.refined.is_some() { "refined" } else { "MCL" },
            "color": css(if results.refined.is_some() { REFINED } else { MCL }),
            "poses": flat(best),
            "trusted": results.best_trusted(),
            "truth": results.ground_truth.as_deref().map(flat),
            "truth_color": css(TRUTH),
            "errors_cm": numbers(|error| 100.0 * error.distance_m(), 100.0),
            "heading_errors_deg": numbers(|error| error.turn_rad.abs().to_degrees(), 1e4),
            "sigmas_cm": results.best_covariances().map(axes),
            "agreements": results.agreements,
            "places": results.places,
            "states": states.map(|all| all.iter().map(word).collect::<Vec<_>>()),
            "state_colors": Value::Object(colors.into_iter().collect()),
            "colormap": (0..10).map(|k| css(Colormap::Viridis.at(f64::from(k) / 9.0))).collect::<Vec<_>>(),
            "scans": results.scan_outlines.as_ref().map(encoded).transpose()?,
        }))
    }
}

/// The map as a PNG with its upper left corner and the edge of a pixel [m].
fn map_layer(map: &MapImage) -> Result<Value> {
    let (bitmap, [x_min, y_max, cell_m]) = map.bitmap();
    let png = bitmap.to_png()?;
    Ok(json!({
        "png": format!("data:image/png;base64,{}", STANDARD.encode(png)),
        "x_min": x_min, "y_max": y_max, "cell_m": cell_m,
    }))
}

/// x, y [m], heading [rad] of all poses.
fn flat(poses: &[Pose2]) -> Vec<f64> {
    let row = |pose: &Pose2| {
        let t = pose.translation;
        let heading_rad = rounded(pose.rotation.angle(), 1e5);
        [rounded(t.x, 1e4), rounded(t.y, 1e4), heading_rad]
    };
    poses.iter().flat_map(row).collect()
}

/// Number of points of each outline, and all of them as 16-bit integers, little-endian.
fn encoded(outlines: &RowLog<[i16; 2]>) -> Result<Value> {
    let (mut counts, mut bytes) = (Vec::new(), Vec::new());
    for row in 0..outlines.len() {
        let points = outlines.row(row)?;
        counts.push(points.len());
        bytes.extend((points.as_flattened().iter()).flat_map(|number| number.to_le_bytes()));
    }
    Ok(json!({ "counts": counts, "points": STANDARD.encode(bytes) }))
}

fn rounded(number: f64, per_unit: f64) -> f64 {
    (number * per_unit).round() / per_unit
}

fn css([red, green, blue]: Rgb) -> String {
    format!("#{red:02x}{green:02x}{blue:02x}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_frame_has_its_pose_error_state_and_outline() {
        let estimates: Vec<Pose2> = (0..3)
            .map(|k| Pose2::new([f64::from(k), 0.02].into(), 0.1))
            .collect();
        let truth = estimates
            .iter()
            .map(|pose| Pose2::translation(0.0, -0.02) * pose)
            .collect();
        let mut outlines = RowLog::in_folder(Path::new("."));
        for points in [&[[100, -200]][..], &[], &[[1, 2], [3, 4]]] {
            outlines.push(points).unwrap();
        }
        let results = LocalizationResults {
            frames: vec![4, 5, 6].into(),
            ground_truth: Some(truth),
            states: Some(
                vec![
                    State::Searching as u8,
                    State::Tracking as u8,
                    State::Lost as u8,
                ]
                .into(),
            ),
            scan_outlines: Some(outlines),
            ..LocalizationResults::default()
        };
        let content = InteractivePath {
            results: &results,
            estimates: &estimates,
            map: None,
        };
        let content = content.content().unwrap();
        assert_eq!(content["poses"].as_array().unwrap().len(), 9);
        assert_eq!(content["errors_cm"], json!([2.0, 2.0, 2.0]));
        assert_eq!(content["states"], json!(["searching", "tracking", "lost"]));
        assert_eq!(content["scans"]["counts"], json!([1, 0, 2]));
        let points = STANDARD
            .decode(content["scans"]["points"].as_str().unwrap())
            .unwrap();
        assert_eq!(points.len(), 12);
        assert_eq!(i16::from_le_bytes([points[2], points[3]]), -200);
    }
}
