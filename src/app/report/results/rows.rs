//! The metrics of a trajectory as rows of a table: name, value, unit and definition.

use std::fmt;

use crate::evaluation::{Consistency, SpatialMetrics, Summary, TrajectoryMetrics};

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
    if length_m < 1.0 {
        format!("{:.1} cm", 100.0 * length_m)
    } else {
        format!("{length_m:.1} m")
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
    /// A row of the refined trajectory alone: without a value of the estimates, and that of the refined trajectory.
    pub fn of_refined(self) -> (Self, Option<Value>) {
        let empty = Self {
            value: Value::Absent,
            ..self
        };
        (empty, Some(self.value))
    }
}

/// A row per metric: name, unit, value and definition.
macro_rules! metrics {
    ($($name:literal [$unit:literal] $value:expr, $definition:literal;)*) => {
        vec![$(MetricRow { name: $name, value: $value.into(), unit: $unit, definition: $definition }),*]
    };
}
pub(super) use metrics;

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

/// The rows of errors against their covariances; the same rows where these are not known.
pub fn consistency_rows(found: Option<&Consistency>) -> Vec<MetricRow> {
    let mean = |number: fn(&Consistency) -> f64| found.map(number);
    metrics! {
        "normalized squared error" [""] mean(|it| it.squared_error), "mean of eᵀ Σ⁻¹ e, e: error of x, y and heading, Σ: its covariance; 3 where the errors are as large as the covariances say, more where they are larger";
        "normalized squared error, long axis" [""] mean(|it| it.squared_error_long), "the same along the long axis of the covariance of the position; 1 is expected";
        "normalized squared error, short axis" [""] mean(|it| it.squared_error_short), "the same along the short axis; 1 is expected";
        "inside the 95 % region" ["%"] mean(|it| 100.0 * it.inside), "share of the frames with eᵀ Σ⁻¹ e of at most 7.815, the 95 % quantile of χ² with 3 degrees of freedom";
    }
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
    metrics! {
        "position in space RMSE" ["m"] position.rmse, "root mean square of the distance to the true position (APE, Sturm et al. 2012, as evo)";
        "position in space mean" ["m"] position.mean, "mean of the distance";
        "position in space median" ["m"] position.median, "half of the frames are nearer";
        "position in space max" ["m"] position.max, "the worst frame";
        "height RMSE" ["m"] metrics.height_m.rmse, "root mean square of the height difference";
        "height bias" ["m"] metrics.height_bias_m, "mean of the height difference; positive is above the truth";
        "rotation RMSE" ["deg"] rotation.rmse.to_degrees(), "root mean square of the angle between the orientations";
        "rotation max" ["deg"] rotation.max.to_degrees(), "the worst frame";
        "position at the end" ["m"] metrics.end_position_m, "distance of the last position to the true one";
        "rotation at the end" ["deg"] metrics.end_rotation_rad.to_degrees(), "angle between the last orientations";
        "distance in space" ["m"] metrics.distance_m, "distance driven by the truth, with heights";
    }
}

fn aligned_rows(metrics: &SpatialMetrics) -> Vec<MetricRow> {
    let position = |number: fn(&Summary) -> f64| metrics.aligned_position_m.as_ref().map(number);
    let rotation = metrics.aligned_rotation_rad.as_ref();
    metrics! {
        "aligned position RMSE" ["m"] position(|it| it.rmse), "root mean square of the distance after rigid alignment, no scale (Umeyama 1991)";
        "aligned position mean" ["m"] position(|it| it.mean), "mean of this distance";
        "aligned position median" ["m"] position(|it| it.median), "half of the frames are nearer";
        "aligned position max" ["m"] position(|it| it.max), "the worst frame";
        "aligned rotation RMSE" ["deg"] rotation.map(|it| it.rmse.to_degrees()), "root mean square of the angle after this alignment";
    }
}

fn segment_rows(metrics: &SpatialMetrics) -> Vec<MetricRow> {
    let of_length = |length_m| metrics.of_length(length_m).map(|it| it.translation_percent);
    let (kitti, short) = (metrics.kitti_segments, metrics.short_segments);
    metrics! {
        "segments 100-800 m, translation" ["%"] kitti.map(|it| it.translation_percent), "mean error over segments of 100, 200, ..., 800 m from every tenth frame, per length, in space (Geiger et al. 2012)";
        "segments 100-800 m, rotation" ["deg/100 m"] kitti.map(|it| it.rotation_deg_per_100_m()), "the same for rotation";
        "segments 100-800 m" [""] kitti.map(|it| it.segments), "their number";
        "segments 5-50 m, translation" ["%"] short.map(|it| it.translation_percent), "mean error over segments of 5, 10, 20 and 50 m from every frame, per length, in space";
        "segments 5-50 m, rotation" ["deg/100 m"] short.map(|it| it.rotation_deg_per_100_m()), "the same for rotation";
        "segments 5-50 m" [""] short.map(|it| it.segments), "their number";
        "segments 5 m, translation" ["%"] of_length(5.0), "those of 5 m alone";
        "segments 10 m, translation" ["%"] of_length(10.0), "those of 10 m alone";
        "segments 20 m, translation" ["%"] of_length(20.0), "those of 20 m alone";
        "segments 50 m, translation" ["%"] of_length(50.0), "those of 50 m alone";
    }
}

fn position_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let position = &metrics.position_m;
    let (along, across) = (&metrics.along, &metrics.across);
    metrics! {
        "position RMSE" ["m"] position.rmse, "root mean square of the planar distance to the true position";
        "position mean" ["m"] position.mean, "mean of the planar distance (average positional error)";
        "position median" ["m"] position.median, "half of the frames are nearer";
        "position p95" ["m"] position.p95, "95 % of the frames are nearer";
        "position max" ["m"] position.max, "the worst frame";
        "evaluated frames" [""] metrics.frames, "number of frames that the errors are of: those after the first ten, or after the first half of a short run, in which the filter was tracking, or whose refined pose is trusted";
        "x RMSE" ["m"] metrics.x_rmse_m, "root mean square of the x difference in the map frame";
        "y RMSE" ["m"] metrics.y_rmse_m, "root mean square of the y difference in the map frame";
        "along RMSE" ["m"] along.rmse_m, "root mean square of the error along the true heading";
        "along bias" ["m"] along.bias_m, "mean error along the true heading; positive is ahead";
        "across RMSE" ["m"] across.rmse_m, "root mean square of the error across the true heading";
        "across bias" ["m"] across.bias_m, "mean error across the true heading; positive is left";
    }
}

fn heading_rows(heading: &Summary) -> Vec<MetricRow> {
    metrics! {
        "heading RMSE" ["deg"] heading.rmse.to_degrees(), "root mean square of the wrapped heading difference";
        "heading mean" ["deg"] heading.mean.to_degrees(), "mean magnitude of the wrapped heading difference";
        "heading median" ["deg"] heading.median.to_degrees(), "half of the frames are nearer";
        "heading p95" ["deg"] heading.p95.to_degrees(), "95 % of the frames are nearer";
        "heading max" ["deg"] heading.max.to_degrees(), "the worst frame";
    }
}

fn success_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let found = metrics.convergence;
    metrics! {
        "strict success" [""] found.is_some_and(|found| found.kept), "converged, and every frame from there to the end is within the limits (default 0.5 m and 2 deg)";
        "time to convergence" ["frames"] found.map(|found| found.row), "frames before the first of ten good frames in a row";
        "time to convergence" ["m"] found.map(|found| found.distance_m), "distance driven until then";
        "time to convergence" ["s"] found.and_then(|found| found.time_s), "time passed until then";
    }
}

fn smoothness_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let smoothness = &metrics.smoothness;
    metrics! {
        "jitter" ["m"] smoothness.jitter_m, "root mean square difference of consecutive planar error vectors";
        "log dimensionless jerk" [""] smoothness.log_jerk, "-ln(T³ / v²peak · ∫|jerk|² dt); nearer to zero is smoother (Hogan and Sternad 2009)";
        "log dimensionless jerk of truth" [""] smoothness.log_jerk_of_truth, "the same of the ground truth";
        "drift" ["mm/m"] metrics.drift.map(|drift| 1e3 * drift), "slope of the position error against the distance driven (least squares)";
        "drift over time" ["mm/s"] metrics.drift_m_per_s.map(|drift| 1e3 * drift), "slope of the position error against time (least squares)";
        "mean pose change" ["m"] smoothness.mean_step_m, "mean length of a step from frame to frame";
        "mean pose change of truth" ["m"] smoothness.mean_step_of_truth_m, "the same of the ground truth";
        "mean heading change" ["deg"] smoothness.mean_turn_rad.map(f64::to_degrees), "mean magnitude of the turn from frame to frame";
    }
}

fn relative_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let segments = metrics.segments;
    metrics! {
        "RPE translation RMSE" ["m"] metrics.rpe_translation_m.map(|rpe| rpe.rmse), "relative pose error from frame to frame, translation (Sturm et al. 2012, as evo)";
        "RPE rotation RMSE" ["deg"] metrics.rpe_rotation_rad.map(|rpe| rpe.rmse.to_degrees()), "relative pose error from frame to frame, rotation";
        "KITTI segments, translation" ["%"] segments.map(|segments| segments.translation_percent), "mean error over segments of 100 to 800 m per distance, in the plane (Geiger et al. 2012)";
        "KITTI segments, rotation" ["deg/100 m"] segments.map(|segments| segments.rotation_deg_per_100_m()), "the same for rotation";
    }
}

fn runtime_rows(metrics: &TrajectoryMetrics) -> Vec<MetricRow> {
    let runtime_ms =
        |number: fn(&Summary) -> f64| metrics.runtime_s.as_ref().map(|time| 1e3 * number(time));
    metrics! {
        "runtime p50" ["ms"] runtime_ms(|time| time.median), "time per counted frame: half are faster";
        "runtime p95" ["ms"] runtime_ms(|time| time.p95), "time per counted frame: 95 % are faster";
        "runtime max" ["ms"] runtime_ms(|time| time.max), "the slowest counted frame";
        "runtime of first frame" ["ms"] metrics.first_runtime_s.map(|time_s| 1e3 * time_s), "the first frame of the run, with the start in it";
        "evaluated frames" [""] metrics.frames, "frames that count";
        "distance" ["m"] metrics.distance_m, "distance driven in them, by the truth";
    }
}
