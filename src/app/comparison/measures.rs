//! Measures of a run, each with unit and definition.
//!
//! Tables 1 and 2 have the columns of the report that this project implements; where the report
//! gives no definition, that of the literature is used. All values are over the frames that
//! [`MetricsConfig`](crate::evaluation::MetricsConfig) selects, without alignment.

use crate::evaluation::TrajectoryMetrics;

/// One measure of a run.
#[derive(Clone, Copy, Debug)]
pub struct Measure {
    /// Name in tables.
    pub name: &'static str,
    /// Unit; empty if dimensionless.
    pub unit: &'static str,
    /// Definition in one sentence.
    pub definition: &'static str,
    /// Value for a run; `None` where undefined.
    pub value: fn(&TrajectoryMetrics) -> Option<f64>,
}

/// Columns of table 1: average positional error, smoothness, drift, runtime.
pub const TABLE_1: [Measure; 6] = [
    Measure {
        name: "average positional error",
        unit: "m",
        definition: "mean planar distance to the true position",
        value: |run| Some(run.position_m.mean),
    },
    Measure {
        name: "smoothness",
        unit: "",
        definition: "log dimensionless jerk, -ln(T³ / v²peak · ∫|jerk|² dt); nearer to zero is smoother (Hogan and Sternad 2009)",
        value: |run| run.smoothness.log_jerk,
    },
    Measure {
        name: "jitter",
        unit: "m",
        definition: "root mean square difference of consecutive planar error vectors",
        value: |run| run.smoothness.jitter_m,
    },
    Measure {
        name: "drift over distance",
        unit: "mm/m",
        definition: "slope of the position error against the distance driven (least squares)",
        value: |run| run.drift.map(|drift| 1e3 * drift),
    },
    Measure {
        name: "drift over time",
        unit: "mm/s",
        definition: "slope of the position error against time (least squares)",
        value: |run| run.drift_m_per_s.map(|drift| 1e3 * drift),
    },
    Measure {
        name: "runtime per frame",
        unit: "ms",
        definition: "mean wall time of filter and refinement per evaluated frame, without reading files",
        value: |run| run.runtime_s.map(|runtime| 1e3 * runtime.mean),
    },
];

/// Columns of table 2: RMSE of x, y and heading, mean pose change.
pub const TABLE_2: [Measure; 6] = [
    Measure {
        name: "RMSE x",
        unit: "m",
        definition: "root mean square of the x difference in the map frame",
        value: |run| Some(run.x_rmse_m),
    },
    Measure {
        name: "RMSE y",
        unit: "m",
        definition: "root mean square of the y difference in the map frame",
        value: |run| Some(run.y_rmse_m),
    },
    Measure {
        name: "RMSE heading",
        unit: "deg",
        definition: "root mean square of the wrapped heading difference",
        value: |run| Some(run.heading_rad.rmse.to_degrees()),
    },
    Measure {
        name: "mean pose change",
        unit: "m",
        definition: "mean length of a step from frame to frame",
        value: |run| run.smoothness.mean_step_m,
    },
    Measure {
        name: "mean pose change of truth",
        unit: "m",
        definition: "mean pose change of the ground truth",
        value: |run| run.smoothness.mean_step_of_truth_m,
    },
    Measure {
        name: "mean heading change",
        unit: "deg",
        definition: "mean magnitude of the turn from frame to frame",
        value: |run| run.smoothness.mean_turn_rad.map(f64::to_degrees),
    },
];

/// Measures of the tables by sequence and of the paired differences.
pub const SELECTED: [Measure; 6] = [
    TABLE_1[0], TABLE_2[0], TABLE_2[1], TABLE_2[2], TABLE_1[2], TABLE_1[5],
];
