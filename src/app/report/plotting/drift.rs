//! Errors of trajectories in space against the distance driven, and over segments of each length.

use super::chart::{LineChart, Panel, Series};
use super::color::Rgb;
use super::view::Mark;
use crate::evaluation::{
    DriftPoint, LengthErrors, SpatialMetrics, aligned, drift, rigid_alignment,
};
use crate::geometry::Pose3;

/// A chart of trajectories, each with name, color and a pose per true pose, where it has any: position, height and heading
/// error against the distance, dashed after rigid alignment, and relative errors against the length of segments.
pub fn drift_chart(truth: &[Pose3], trajectories: &[(&str, Rgb, Option<&[Pose3]>)]) -> LineChart {
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
        let estimates = estimates.unwrap_or_default();
        let moved = rigid_alignment(estimates, truth).map(|it| aligned(&it, estimates));
        let label = format!("{name}, rigidly aligned");
        for (name, mark, poses) in [
            (name, Mark::Line, estimates),
            (&label, Mark::Dashes, moved.as_deref().unwrap_or_default()),
        ] {
            let points = drift(poses, truth);
            let values: [fn(&DriftPoint) -> f64; 2] =
                [|it| it.position_m, |it| it.heading_rad.to_degrees()];
            for (panel, value) in panels.iter_mut().zip(values).filter(|_| !points.is_empty()) {
                let points = points.iter().map(|it| (it.distance_m, value(it)));
                panel.series.push(Series {
                    mark,
                    ..Series::line(name, color, points)
                });
            }
        }
        let by_length = SpatialMetrics::new(estimates, truth, 0).map(|it| it.by_length);
        let by_length = by_length.unwrap_or_default();
        let values: [fn(&LengthErrors) -> f64; 2] = [
            |it| it.errors.translation_percent,
            |it| it.errors.rotation_deg_per_100_m(),
        ];
        for (panel, value) in panels[2..].iter_mut().zip(values) {
            let points = by_length.iter().map(|it| (it.length_m, value(it)));
            panel.series.push(Series::line(name, color, points));
            panel.own_x_name = Some("length of the segments [m]".to_owned());
        }
    }
    let title = "Error against the distance driven, and over segments";
    LineChart::new(title, "distance [m]", panels)
}
