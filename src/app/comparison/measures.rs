//! The numbers that a comparison is about, each with its unit and its definition.
//!
//! Table 1 and table 2 have the columns of the report that this project implements. Where the
//! report gives no definition, the literature's is taken. All numbers are of the frames that
//! [`MetricsConfig`](crate::evaluation::MetricsConfig) counts, without alignment.

use crate::app::results::TrajectoryReport;

/// One number of a run.
#[derive(Clone, Copy, Debug)]
pub struct Measure {
    /// What it is called.
    pub name: &'static str,
    /// Its unit; empty for plain numbers.
    pub unit: &'static str,
    /// What it is, in a sentence.
    pub definition: &'static str,
    /// The number of a run; `None` where it is not defined.
    pub of: fn(&TrajectoryReport) -> Option<f64>,
}

/// Average positional error, smoothness, drift, runtime.
pub const TABLE_1: [Measure; 6] = [
    Measure {
        name: "average positional error",
        unit: "m",
        definition: "mean planar distance to the true position",
        of: |run| Some(run.metrics.position_m.mean),
    },
    Measure {
        name: "smoothness",
        unit: "",
        definition: "log dimensionless jerk, -ln(T³ / v²peak · ∫|jerk|² dt); nearer to zero is smoother (Hogan and Sternad 2009)",
        of: |run| run.metrics.smoothness.log_jerk,
    },
    Measure {
        name: "jitter",
        unit: "m",
        definition: "root mean square difference of consecutive planar error vectors",
        of: |run| run.metrics.smoothness.jitter_m,
    },
    Measure {
        name: "drift over distance",
        unit: "mm/m",
        definition: "slope of the position error against the distance driven (least squares)",
        of: |run| run.metrics.drift.map(|drift| 1e3 * drift),
    },
    Measure {
        name: "drift over time",
        unit: "mm/s",
        definition: "slope of the position error against time (least squares)",
        of: |run| run.metrics.drift_m_per_s.map(|drift| 1e3 * drift),
    },
    Measure {
        name: "runtime per frame",
        unit: "ms",
        definition: "mean wall time of filter and refinement per counted frame; reading files is not in it",
        of: |run| run.metrics.runtime_s.map(|runtime| 1e3 * runtime.mean),
    },
];

/// RMSE of x, y and heading apart, and the mean pose change.
pub const TABLE_2: [Measure; 6] = [
    Measure {
        name: "RMSE x",
        unit: "m",
        definition: "root mean square of the x difference in the map frame",
        of: |run| Some(run.metrics.x_rmse_m),
    },
    Measure {
        name: "RMSE y",
        unit: "m",
        definition: "root mean square of the y difference in the map frame",
        of: |run| Some(run.metrics.y_rmse_m),
    },
    Measure {
        name: "RMSE heading",
        unit: "deg",
        definition: "root mean square of the wrapped heading difference",
        of: |run| Some(run.metrics.heading_rad.rmse.to_degrees()),
    },
    Measure {
        name: "mean pose change",
        unit: "m",
        definition: "mean length of a step from frame to frame",
        of: |run| run.metrics.smoothness.mean_step_m,
    },
    Measure {
        name: "mean pose change of truth",
        unit: "m",
        definition: "the same of the ground truth",
        of: |run| run.metrics.smoothness.mean_step_of_truth_m,
    },
    Measure {
        name: "mean heading change",
        unit: "deg",
        definition: "mean magnitude of the turn from frame to frame",
        of: |run| run.metrics.smoothness.mean_turn_rad.map(f64::to_degrees),
    },
];

/// What two configurations are asked to differ in.
pub const CONTRASTED: [Measure; 6] = [
    TABLE_1[0], TABLE_2[0], TABLE_2[1], TABLE_2[2], TABLE_1[2], TABLE_1[5],
];
