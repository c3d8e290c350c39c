//! Errors of trajectories in space against the distance driven, and over segments of each length.

use super::chart::{LineChart, Panel, Series};
use super::color::Rgb;
use super::view::Mark;
use crate::evaluation::{
    DriftPoint, LengthErrors, SpatialMetrics, aligned, drift, rigid_alignment,
};
use crate::geometry::Pose3;

/// A chart of trajectories, each with name, color and a pose per true pose: position, height and heading error against
/// the distance, dashed after rigid alignment, and relative errors against the length of segments.
pub fn drift_chart(truth: &[Pose3], trajectories: &[(&str, Rgb, &[Pose3])]) -> LineChart {
    let mut panels = [
        "position error [m]",
        "heading error [deg]",
        "translation error [%]",
        "rotation error [deg/100 m]",
    ]
    .map(|y_name| Panel {
        y_name: y_name.to_owned(),
        ..Panel::default()
    });
    for &(name, color, estimates) in trajectories {
        let alignment = rigid_alignment(estimates, truth);
        let moved = alignment.map(|transform| aligned(&transform, estimates));
        let label = format!("{name}, rigidly aligned");
        let variants = [
            (name, Mark::Line, Some(estimates)),
            (label.as_str(), Mark::Dashes, moved.as_deref()),
        ];
        for (name, mark, poses) in variants {
            let points = drift(poses.unwrap_or_default(), truth);
            let series = |value: fn(&DriftPoint) -> f64| Series {
                mark,
                ..Series::line(
                    name,
                    color,
                    points.iter().map(|it| (it.distance_m, value(it))),
                )
            };
            if !points.is_empty() {
                panels[0].series.push(series(|it| it.position_m));
                panels[1]
                    .series
                    .push(series(|it| it.heading_rad.to_degrees()));
            }
        }
        let by_length = SpatialMetrics::new(estimates, truth, 0).map(|it| it.by_length);
        let by_length = by_length.unwrap_or_default();
        let series = |value: fn(&LengthErrors) -> f64| {
            let points = by_length.iter().map(|it| (it.length_m, value(it)));
            Series::line(name, color, points)
        };
        panels[2]
            .series
            .push(series(|it| it.errors.translation_percent));
        panels[3]
            .series
            .push(series(|it| it.errors.rotation_deg_per_100_m()));
    }
    for panel in &mut panels[2..] {
        panel.own_x_name = Some("length of the segments [m]".to_owned());
    }
    let title = "Error against the distance driven, and over segments";
    LineChart::new(title, "distance [m]", panels)
}
