//! The metrics as rows of a table: a name, a number, its unit and what it means.

use super::metrics::TrajectoryMetrics;

/// What stands in a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// A number in the unit of its row.
    Number(f64),
    /// A count.
    Count(usize),
    /// Yes or no.
    Flag(bool),
    /// Not measured, or not defined for this run.
    Absent,
}

/// One line of a table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MetricRow {
    /// What is measured.
    pub name: &'static str,
    /// For this trajectory.
    pub value: Value,
    /// Unit of the value; empty for flags and plain numbers.
    pub unit: &'static str,
    /// What the number is, in a sentence.
    pub definition: &'static str,
}

impl std::fmt::Display for Value {
    /// With four significant digits and at most four decimals.
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match *self {
            Self::Number(number) => {
                let digits = number.abs().max(1e-9).log10().floor() as i32;
                let decimals = (3 - digits).clamp(0, 4) as usize;
                formatter.pad(&format!("{number:.decimals$}"))
            }
            Self::Count(count) => formatter.pad(&count.to_string()),
            Self::Flag(true) => formatter.pad("yes"),
            Self::Flag(false) => formatter.pad("no"),
            Self::Absent => formatter.pad("-"),
        }
    }
}

impl From<Option<f64>> for Value {
    fn from(number: Option<f64>) -> Self {
        number.map_or(Self::Absent, Self::Number)
    }
}

impl TrajectoryMetrics {
    /// The table, most important first; the same rows in the same order for every trajectory.
    pub fn rows(&self) -> Vec<MetricRow> {
        [
            self.position_rows(),
            self.heading_rows(),
            self.success_rows(),
            self.smoothness_rows(),
            self.relative_rows(),
            self.runtime_rows(),
        ]
        .concat()
    }

    fn position_rows(&self) -> Vec<MetricRow> {
        let position = &self.position_m;
        vec![
            row(
                "position RMSE",
                position.rmse,
                "m",
                "root mean square of the planar distance to the true position",
            ),
            row(
                "position mean",
                position.mean,
                "m",
                "mean of the planar distance (average positional error)",
            ),
            row(
                "position median",
                position.median,
                "m",
                "half of the frames are nearer",
            ),
            row(
                "position p95",
                position.p95,
                "m",
                "95 % of the frames are nearer",
            ),
            row("position max", position.max, "m", "the worst frame"),
            row(
                "x RMSE",
                self.x_rmse_m,
                "m",
                "root mean square of the x difference in the map frame",
            ),
            row(
                "y RMSE",
                self.y_rmse_m,
                "m",
                "root mean square of the y difference in the map frame",
            ),
            row(
                "along RMSE",
                self.along.rmse_m,
                "m",
                "root mean square of the error along the true heading",
            ),
            row(
                "along bias",
                self.along.bias_m,
                "m",
                "mean error along the true heading; positive is ahead",
            ),
            row(
                "across RMSE",
                self.across.rmse_m,
                "m",
                "root mean square of the error across the true heading",
            ),
            row(
                "across bias",
                self.across.bias_m,
                "m",
                "mean error across the true heading; positive is left",
            ),
        ]
    }

    fn heading_rows(&self) -> Vec<MetricRow> {
        let heading = &self.heading_rad;
        vec![
            row(
                "heading RMSE",
                heading.rmse.to_degrees(),
                "deg",
                "root mean square of the wrapped heading difference",
            ),
            row(
                "heading mean",
                heading.mean.to_degrees(),
                "deg",
                "mean magnitude of the wrapped heading difference",
            ),
            row(
                "heading median",
                heading.median.to_degrees(),
                "deg",
                "half of the frames are nearer",
            ),
            row(
                "heading p95",
                heading.p95.to_degrees(),
                "deg",
                "95 % of the frames are nearer",
            ),
            row(
                "heading max",
                heading.max.to_degrees(),
                "deg",
                "the worst frame",
            ),
        ]
    }

    fn success_rows(&self) -> Vec<MetricRow> {
        let found = self.convergence;
        let time = |number: Option<f64>, unit, definition| {
            row("time to convergence", number, unit, definition)
        };
        vec![
            row(
                "strict success",
                Value::Flag(found.is_some_and(|found| found.kept)),
                "",
                "converged, and every frame from there to the end is within the limits (default 0.5 m and 2 deg)",
            ),
            row(
                "time to convergence",
                found.map_or(Value::Absent, |found| Value::Count(found.row)),
                "frames",
                "frames before the first of ten good frames in a row",
            ),
            time(
                found.map(|found| found.distance_m),
                "m",
                "distance driven until then",
            ),
            time(
                found.and_then(|found| found.time_s),
                "s",
                "time passed until then",
            ),
        ]
    }

    fn smoothness_rows(&self) -> Vec<MetricRow> {
        let smoothness = &self.smoothness;
        vec![
            row(
                "jitter",
                smoothness.jitter_m,
                "m",
                "root mean square difference of consecutive planar error vectors",
            ),
            row(
                "log dimensionless jerk",
                smoothness.log_jerk,
                "",
                "-ln(T³ / v²peak · ∫|jerk|² dt); nearer to zero is smoother (Hogan and Sternad 2009)",
            ),
            row(
                "log dimensionless jerk of truth",
                smoothness.log_jerk_of_truth,
                "",
                "the same of the ground truth",
            ),
            row(
                "drift",
                self.drift.map(|drift| 1e3 * drift),
                "mm/m",
                "slope of the position error against the distance driven (least squares)",
            ),
            row(
                "drift over time",
                self.drift_m_per_s.map(|drift| 1e3 * drift),
                "mm/s",
                "slope of the position error against time (least squares)",
            ),
            row(
                "mean pose change",
                smoothness.mean_step_m,
                "m",
                "mean length of a step from frame to frame",
            ),
            row(
                "mean pose change of truth",
                smoothness.mean_step_of_truth_m,
                "m",
                "the same of the ground truth",
            ),
            row(
                "mean heading change",
                smoothness.mean_turn_rad.map(f64::to_degrees),
                "deg",
                "mean magnitude of the turn from frame to frame",
            ),
        ]
    }

    fn relative_rows(&self) -> Vec<MetricRow> {
        let segments = self.segments;
        vec![
            row(
                "RPE translation RMSE",
                self.rpe_translation_m.map(|rpe| rpe.rmse),
                "m",
                "relative pose error from frame to frame, translation (Sturm et al. 2012, as evo)",
            ),
            row(
                "RPE rotation RMSE",
                self.rpe_rotation_rad.map(|rpe| rpe.rmse.to_degrees()),
                "deg",
                "relative pose error from frame to frame, rotation",
            ),
            row(
                "KITTI segments, translation",
                segments.map(|s| s.translation_percent),
                "%",
                "mean error over segments of 100 to 800 m per distance (Geiger et al. 2012)",
            ),
            row(
                "KITTI segments, rotation",
                segments.map(|s| s.rotation_deg_per_m),
                "deg/m",
                "the same for rotation",
            ),
        ]
    }

    fn runtime_rows(&self) -> Vec<MetricRow> {
        let runtime = |number: fn(&super::Summary) -> f64| {
            self.runtime_s.as_ref().map(|runtime| 1e3 * number(runtime))
        };
        vec![
            row(
                "runtime p50",
                runtime(|runtime| runtime.median),
                "ms",
                "time per counted frame: half are faster",
            ),
            row(
                "runtime p95",
                runtime(|runtime| runtime.p95),
                "ms",
                "time per counted frame: 95 % are faster",
            ),
            row(
                "runtime max",
                runtime(|runtime| runtime.max),
                "ms",
                "the slowest counted frame",
            ),
            row(
                "runtime of first frame",
                self.first_runtime_s.map(|time_s| 1e3 * time_s),
                "ms",
                "the first frame of the run, with the start in it",
            ),
            row("frames", Value::Count(self.frames), "", "frames that count"),
            row(
                "distance",
                self.distance_m,
                "m",
                "distance driven in them, by the truth",
            ),
        ]
    }
}

fn row(
    name: &'static str,
    value: impl Into<Value>,
    unit: &'static str,
    definition: &'static str,
) -> MetricRow {
    MetricRow {
        name,
        value: value.into(),
        unit,
        definition,
    }
}

impl From<f64> for Value {
    fn from(number: f64) -> Self {
        Self::Number(number)
    }
}
