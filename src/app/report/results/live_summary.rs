//! What a run at the pace of a sensor showed: scans that arrived, latencies, states.

use std::collections::BTreeMap;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::rows::{MetricRow, metrics};
use crate::live::{Latencies, LiveState};

/// Scans, latencies and states of a run of `live`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct LiveSummary {
    /// Number of scans that arrived.
    pub received: u64,
    /// Number of those that were dropped for newer ones.
    pub dropped: u64,
    /// Number of scans that could not be used: damaged, repeated, or of another sensor.
    pub rejected: u64,
    /// Time from the arrival of a scan to its pose; `None` without any.
    pub latency: Option<LatencySummary>,
    /// Number of scans after which the localization was in each state.
    pub states: BTreeMap<LiveState, u64>,
    /// Number of changes of the state.
    pub changes: u64,
}

/// Latencies over all scans.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct LatencySummary {
    /// Median, within 2 % [ms].
    pub p50_ms: f64,
    /// 99th percentile, within 2 % [ms].
    pub p99_ms: f64,
    /// Maximum [ms].
    pub max_ms: f64,
}

impl LatencySummary {
    /// The summary of some latencies; `None` without any.
    pub fn new(latencies: &Latencies) -> Option<Self> {
        let milliseconds = |latency: Duration| 1e3 * latency.as_secs_f64();
        Some(Self {
            p50_ms: milliseconds(latencies.percentile(0.5)?),
            p99_ms: milliseconds(latencies.percentile(0.99)?),
            max_ms: milliseconds(latencies.max()),
        })
    }
}

impl LiveSummary {
    /// Scans and latencies, in a sentence.
    pub fn verdict(&self) -> String {
        let latency = self.latency.as_ref().map(|it| {
            format!(
                "; poses {:.0} ms after their scans (median), {:.0} ms at the 99th percentile, at most {:.0} ms",
                it.p50_ms, it.p99_ms, it.max_ms
            )
        });
        let rejected = match self.rejected {
            0 => String::new(),
            count => format!(", {count} could not be used"),
        };
        format!(
            "{} scans arrived, {} were dropped for newer ones{rejected}{}.",
            self.received,
            self.dropped,
            latency.unwrap_or_default()
        )
    }

    /// Rows of the report.
    pub fn rows(&self) -> Vec<MetricRow> {
        let latency = self.latency.as_ref();
        metrics! {
            "received" [""] self.received as usize, "number of scans that arrived";
            "dropped" [""] self.dropped as usize, "number of scans that were dropped for newer ones; the motion over them is bridged";
            "rejected" [""] self.rejected as usize, "number of scans that could not be used: damaged, repeated, or of another sensor";
            "latency p50" ["ms"] latency.map(|it| it.p50_ms), "median of the time from the arrival of a scan to its pose";
            "latency p99" ["ms"] latency.map(|it| it.p99_ms), "its 99th percentile";
            "latency max" ["ms"] latency.map(|it| it.max_ms), "its maximum";
        }
    }
}
