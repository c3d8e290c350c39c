//! Content of the interactive path of a page: the map from above and, for each frame, its pose, state, numbers
//! and the outline of its scan. `interactive.js` of the page draws it.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context as _, Result};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::ser::SerializeMap as _;
use serde::{Serialize, Serializer};
use serde_json::{Value, json};

use super::color::{Colormap, MCL, REFINED, Rgb, STATES, TRUTH};
use super::map_image::MapImage;
use crate::app::report::results::{LocalizationResults, RowLog};
use crate::app::run::output;
use crate::evaluation::PlanarError;
use crate::evaluation::trust::Axes;
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

    fn content(&self) -> Result<Content<'_>> {
        let outlines = self.results.scan_outlines.as_ref();
        Ok(Content {
            path: self,
            map: self.map.map(map_layer).transpose()?,
            scans: outlines.map(encoded).transpose()?,
        })
    }
}

/// The content, whose values per frame are computed while they are written.
struct Content<'a> {
    path: &'a InteractivePath<'a>,
    map: Option<Value>,
    scans: Option<Value>,
}

impl Serialize for Content<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let results = self.path.results;
        let refined = results.refined.as_deref();
        let best = refined.unwrap_or(self.path.estimates);
        let errors = || {
            let pairs = best.iter().zip(results.ground_truth.as_deref()?);
            Some(pairs.map(|(pose, truth)| PlanarError::between(pose, truth)))
        };
        let error_cm = |it: PlanarError| rounded(100.0 * it.distance_m(), 100.0);
        let heading_error_deg = |it: PlanarError| rounded(it.turn_rad.abs().to_degrees(), 1e4);
        let sigmas_cm = (results.best_covariances()).map(|all| {
            let pairs = all.iter().zip(best);
            pairs.map(|(covariance, pose)| {
                rounded(100.0 * Axes::new(covariance, pose).long_m, 100.0)
            })
        });
        let word = |&number: &u8| Some(State::from_number(number)?.word());
        let colors = STATES.map(|(state, color)| (state.word(), css(color)));
        let (name, color) = if refined.is_some() {
            ("refined", REFINED)
        } else {
            ("MCL", MCL)
        };
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("agreements", &results.agreements)?;
        map.serialize_entry("color", &css(color))?;
        let colormap = (0..10).map(|k| css(Colormap::Viridis.at(f64::from(k) / 9.0)));
        map.serialize_entry("colormap", &colormap.collect::<Vec<_>>())?;
        map.serialize_entry("errors_cm", &errors().map(|all| Items(all.map(error_cm))))?;
        map.serialize_entry("frames", &results.frames)?;
        let heading_errors_deg = errors().map(|all| Items(all.map(heading_error_deg)));
        map.serialize_entry("heading_errors_deg", &heading_errors_deg)?;
        map.serialize_entry("map", &self.map)?;
        map.serialize_entry("name", name)?;
        map.serialize_entry("places", &results.places)?;
        map.serialize_entry("poses", &flat(best))?;
        map.serialize_entry("scans", &self.scans)?;
        map.serialize_entry("sigmas_cm", &sigmas_cm.map(Items))?;
        map.serialize_entry("state_colors", &BTreeMap::from(colors))?;
        let states = results.states.as_ref();
        map.serialize_entry("states", &states.map(|all| Items(all.iter().map(word))))?;
        map.serialize_entry("times_s", &results.recorded_times())?;
        map.serialize_entry("trusted", &results.best_trusted())?;
        map.serialize_entry("truth", &results.ground_truth.as_deref().map(flat))?;
        map.serialize_entry("truth_color", &css(TRUTH))?;
        map.end()
    }
}

/// A sequence of items that are made when they are written.
struct Items<I>(I);

impl<I: Iterator<Item: Serialize> + Clone> Serialize for Items<I> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.clone())
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
fn flat(poses: &[Pose2]) -> impl Serialize {
    let row = |pose: &Pose2| {
        let t = pose.translation;
        let heading_rad = rounded(pose.rotation.angle(), 1e5);
        [rounded(t.x, 1e4), rounded(t.y, 1e4), heading_rad]
    };
    Items(poses.iter().flat_map(row))
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
        let content = serde_json::to_value(content.content().unwrap()).unwrap();
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
