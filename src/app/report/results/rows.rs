//! The metrics of a trajectory as rows of a table: name, value, unit and definition.

use std::fmt;

use crate::evaluation::{SpatialMetrics, Summary, TrajectoryMetrics};

/// The value of a metric.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// A number in the unit of its row.
    Number(f64),
    /// A count.
    Count(usize),
    /// Yes or no.
    Flag(bool),
    /// A condition that no frame could be checked for.
    NotChecked,
    /// Not measured, or not defined for this run.
    Absent,
}

impl fmt::Display for Value {
    /// With four significant digits and at most four decimals.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Number(number) => {
                let digits = number.abs().max(1e-9).log10().floor() as i32;
                let decimals = (3 - digits).clamp(0, 4) as usize;
                formatter.pad(&format!("{number:.decimals$}"))
            }
            Self::Count(count) => formatter.pad(&count.to_string()),
            Self::Flag(true) => formatter.pad("yes"),
            Self::Flag(false) => formatter.pad("no"),
            Self::NotChecked => formatter.pad("not checked"),
            Self::Absent => formatter.pad("-"),
        }
    }
}

impl From<f64> for Value {
    fn from(number: f64) -> Self {
        Self::Number(number)
    }
}

impl From<usize> for Value {
    fn from(count: usize) -> Self {
        Self::Count(count)
    }
}

impl From<bool> for Value {
    fn from(flag: bool) -> Self {
        Self::Flag(flag)
    }
}

impl<T: Into<Value>> From<Option<T>> for Value {
    fn from(value: Option<T>) -> Self {
        value.map_or(Self::Absent, Into::into)
    }
}

/// A length in centimetres, from a metre on in metres.
pub fn length(length_m: f64) -> String {
    match length_m < 1.0 {
        true => format!("{:.1} cm", 100.0 * length_m),
        false => format!("{length_m:.1} m"),
    }
}

/// One row of a table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MetricRow {
    /// Name of the metric.
    pub name: &'static str,
    /// Value for this trajectory.
    pub value: Value,
    /// Unit of the value; empty for flags, counts and unitless numbers.
    pub unit: &'static str,
    /// What the number is, in a sentence.
    pub definition: &'static str,
}

impl MetricRow {
    /// A row described by `name [unit]: definition`; the unit may be left out.
    pub fn new(description: &'static str, value: impl Into<Value>) -> Self {
        let (head, definition) = description.split_once(": ").unwrap_or((description, ""));
        let (name, unit) = head.split_once(" [").unwrap_or((head, ""));
        Self {
            name,
            value: value.into(),
            unit: unit.trim_end_matches(']'),
            definition,
        }
    }
}

/// The rows, most important first; the same rows in the same order for every trajectory.
pub fn metric_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    [
        position_rows(metrics),
        heading_rows(&metrics.heading_rad),
        success_rows(metrics),
        smoothness_rows(metrics),
        relative_rows(metrics),
        runtime_rows(metrics),
    ]
    .concat()
}

/// The rows of the errors in six degrees of freedom.
pub fn spatial_rows(metrics: &SpatialMetrics) -> Vec<MetricRow> {
    [
        absolute_rows(metrics),
        aligned_rows(metrics),
        segment_rows(metrics),
    ]
    .concat()
}

fn absolute_rows(metrics: &SpatialMetrics) -> Vec<MetricRow> {
    let (position, rotation) = (&metrics.position_m, &metrics.rotation_rad);
    vec![
        MetricRow::new(
            "position in space RMSE [m]: root mean square of the distance to the true position (APE, Sturm et al. 2012, as evo)",
            position.rmse,
        ),
        MetricRow::new(
            "position in space mean [m]: mean of the distance",
            position.mean,
        ),
        MetricRow::new(
            "position in space median [m]: half of the frames are nearer",
            position.median,
        ),
        MetricRow::new("position in space max [m]: the worst frame", position.max),
        MetricRow::new(
            "height RMSE [m]: root mean square of the height difference",
            metrics.height_m.rmse,
        ),
        MetricRow::new(
            "height bias [m]: mean of the height difference; positive is above the truth",
            metrics.height_bias_m,
        ),
        MetricRow::new(
            "rotation RMSE [deg]: root mean square of the angle between the orientations",
            rotation.rmse.to_degrees(),
        ),
        MetricRow::new(
            "rotation max [deg]: the worst frame",
            rotation.max.to_degrees(),
        ),
        MetricRow::new(
            "position at the end [m]: distance of the last position to the true one",
            metrics.end_position_m,
        ),
        MetricRow::new(
            "rotation at the end [deg]: angle between the last orientations",
            metrics.end_rotation_rad.to_degrees(),
        ),
        MetricRow::new(
            "distance in space [m]: distance driven by the truth, with heights",
            metrics.distance_m,
        ),
    ]
}

fn aligned_rows(metrics: &SpatialMetrics) -> Vec<MetricRow> {
    let position = |number: fn(&Summary) -> f64| metrics.aligned_position_m.as_ref().map(number);
    let rotation = metrics.aligned_rotation_rad.as_ref();
    vec![
        MetricRow::new(
            "aligned position RMSE [m]: root mean square of the distance after rigid alignment, no scale (Umeyama 1991)",
            position(|it| it.rmse),
        ),
        MetricRow::new(
            "aligned position mean [m]: mean of this distance",
            position(|it| it.mean),
        ),
        MetricRow::new(
            "aligned position median [m]: half of the frames are nearer",
            position(|it| it.median),
        ),
        MetricRow::new(
            "aligned position max [m]: the worst frame",
            position(|it| it.max),
        ),
        MetricRow::new(
            "aligned rotation RMSE [deg]: root mean square of the angle after this alignment",
            rotation.map(|it| it.rmse.to_degrees()),
        ),
    ]
}

fn segment_rows(metrics: &SpatialMetrics) -> Vec<MetricRow> {
    let of_length = |description, length_m| {
        let errors = metrics.of_length(length_m);
        MetricRow::new(description, errors.map(|it| it.translation_percent))
    };
    let (kitti, short) = (metrics.kitti_segments, metrics.short_segments);
    vec![
        MetricRow::new(
            "segments 100-800 m, translation [%]: mean error over segments of 100, 200, ..., 800 m from every tenth frame, per length, in space (Geiger et al. 2012)",
            kitti.map(|it| it.translation_percent),
        ),
        MetricRow::new(
            "segments 100-800 m, rotation [deg/100 m]: the same for rotation",
            kitti.map(|it| it.rotation_deg_per_100_m()),
        ),
        MetricRow::new(
            "segments 100-800 m: their number",
            kitti.map(|it| it.segments),
        ),
        MetricRow::new(
            "segments 5-50 m, translation [%]: mean error over segments of 5, 10, 20 and 50 m from every frame, per length, in space",
            short.map(|it| it.translation_percent),
        ),
        MetricRow::new(
            "segments 5-50 m, rotation [deg/100 m]: the same for rotation",
            short.map(|it| it.rotation_deg_per_100_m()),
        ),
        MetricRow::new("segments 5-50 m: their number", short.map(|it| it.segments)),
        of_length("segments 5 m, translation [%]: those of 5 m alone", 5.0),
        of_length("segments 10 m, translation [%]: those of 10 m alone", 10.0),
        of_length("segments 20 m, translation [%]: those of 20 m alone", 20.0),
        of_length("segments 50 m, translation [%]: those of 50 m alone", 50.0),
    ]
}

fn position_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let position = &metrics.position_m;
    let (along, across) = (&metrics.along, &metrics.across);
    vec![
        MetricRow::new(
            "position RMSE [m]: root mean square of the planar distance to the true position",
            position.rmse,
        ),
        MetricRow::new(
            "position mean [m]: mean of the planar distance (average positional error)",
            position.mean,
        ),
        MetricRow::new(
            "position median [m]: half of the frames are nearer",
            position.median,
        ),
        MetricRow::new(
            "position p95 [m]: 95 % of the frames are nearer",
            position.p95,
        ),
        MetricRow::new("position max [m]: the worst frame", position.max),
        MetricRow::new(
            "x RMSE [m]: root mean square of the x difference in the map frame",
            metrics.x_rmse_m,
        ),
        MetricRow::new(
            "y RMSE [m]: root mean square of the y difference in the map frame",
            metrics.y_rmse_m,
        ),
        MetricRow::new(
            "along RMSE [m]: root mean square of the error along the true heading",
            along.rmse_m,
        ),
        MetricRow::new(
            "along bias [m]: mean error along the true heading; positive is ahead",
            along.bias_m,
        ),
        MetricRow::new(
            "across RMSE [m]: root mean square of the error across the true heading",
            across.rmse_m,
        ),
        MetricRow::new(
            "across bias [m]: mean error across the true heading; positive is left",
            across.bias_m,
        ),
    ]
}

fn heading_rows(heading: &Summary) -> Vec<MetricRow> {
    vec![
        MetricRow::new(
            "heading RMSE [deg]: root mean square of the wrapped heading difference",
            heading.rmse.to_degrees(),
        ),
        MetricRow::new(
            "heading mean [deg]: mean magnitude of the wrapped heading difference",
            heading.mean.to_degrees(),
        ),
        MetricRow::new(
            "heading median [deg]: half of the frames are nearer",
            heading.median.to_degrees(),
        ),
        MetricRow::new(
            "heading p95 [deg]: 95 % of the frames are nearer",
            heading.p95.to_degrees(),
        ),
        MetricRow::new(
            "heading max [deg]: the worst frame",
            heading.max.to_degrees(),
        ),
    ]
}

fn success_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let found = metrics.convergence;
    vec![
        MetricRow::new(
            "strict success: converged, and every frame from there to the end is within the limits (default 0.5 m and 2 deg)",
            found.is_some_and(|found| found.kept),
        ),
        MetricRow::new(
            "time to convergence [frames]: frames before the first of ten good frames in a row",
            found.map(|found| found.row),
        ),
        MetricRow::new(
            "time to convergence [m]: distance driven until then",
            found.map(|found| found.distance_m),
        ),
        MetricRow::new(
            "time to convergence [s]: time passed until then",
            found.and_then(|found| found.time_s),
        ),
    ]
}

fn smoothness_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let smoothness = &metrics.smoothness;
    vec![
        MetricRow::new(
            "jitter [m]: root mean square difference of consecutive planar error vectors",
            smoothness.jitter_m,
        ),
        MetricRow::new(
            "log dimensionless jerk: -ln(T³ / v²peak · ∫|jerk|² dt); nearer to zero is smoother (Hogan and Sternad 2009)",
            smoothness.log_jerk,
        ),
        MetricRow::new(
            "log dimensionless jerk of truth: the same of the ground truth",
            smoothness.log_jerk_of_truth,
        ),
        MetricRow::new(
            "drift [mm/m]: slope of the position error against the distance driven (least squares)",
            metrics.drift.map(|drift| 1e3 * drift),
        ),
        MetricRow::new(
            "drift over time [mm/s]: slope of the position error against time (least squares)",
            metrics.drift_m_per_s.map(|drift| 1e3 * drift),
        ),
        MetricRow::new(
            "mean pose change [m]: mean length of a step from frame to frame",
            smoothness.mean_step_m,
        ),
        MetricRow::new(
            "mean pose change of truth [m]: the same of the ground truth",
            smoothness.mean_step_of_truth_m,
        ),
        MetricRow::new(
            "mean heading change [deg]: mean magnitude of the turn from frame to frame",
            smoothness.mean_turn_rad.map(f64::to_degrees),
        ),
    ]
}

fn relative_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let segments = metrics.segments;
    vec![
        MetricRow::new(
            "RPE translation RMSE [m]: relative pose error from frame to frame, translation (Sturm et al. 2012, as evo)",
            metrics.rpe_translation_m.map(|rpe| rpe.rmse),
        ),
        MetricRow::new(
            "RPE rotation RMSE [deg]: relative pose error from frame to frame, rotation",
            metrics.rpe_rotation_rad.map(|rpe| rpe.rmse.to_degrees()),
        ),
        MetricRow::new(
            "KITTI segments, translation [%]: mean error over segments of 100 to 800 m per distance, in the plane (Geiger et al. 2012)",
            segments.map(|segments| segments.translation_percent),
        ),
        MetricRow::new(
            "KITTI segments, rotation [deg/100 m]: the same for rotation",
            segments.map(|segments| segments.rotation_deg_per_100_m()),
        ),
    ]
}

fn runtime_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let runtime_ms =
        |number: fn(&Summary) -> f64| metrics.runtime_s.as_ref().map(|time| 1e3 * number(time));
    vec![
        MetricRow::new(
            "runtime p50 [ms]: time per counted frame: half are faster",
            runtime_ms(|time| time.median),
        ),
        MetricRow::new(
            "runtime p95 [ms]: time per counted frame: 95 % are faster",
            runtime_ms(|time| time.p95),
        ),
        MetricRow::new(
            "runtime max [ms]: the slowest counted frame",
            runtime_ms(|time| time.max),
        ),
        MetricRow::new(
            "runtime of first frame [ms]: the first frame of the run, with the start in it",
            metrics.first_runtime_s.map(|time_s| 1e3 * time_s),
        ),
        MetricRow::new("evaluated frames: frames that count", metrics.frames),
        MetricRow::new(
            "distance [m]: distance driven in them, by the truth",
            metrics.distance_m,
        ),
    ]
}
