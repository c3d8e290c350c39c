//! Search of the pose of a scan where no prediction is good enough: several starts, coarse to fine.

use nalgebra::Vector3;

use super::alignment::{Alignment, Problem};
use crate::geometry::Pose3;

/// The alignment with the least cost from starts around the prediction: shifts along both horizontal axes up to
/// `reach_m`, in steps of `step_m`.
pub fn search(problem: &Problem, step_m: f64, reach_m: f64) -> Option<Alignment> {
    /// Points that take part in the comparison of starts.
    const POINTS: usize = 800;
    const STARTS: usize = 200;
    let stride = problem.points.len().div_ceil(POINTS).max(1);
    let points: Vec<_> = problem.points.iter().copied().step_by(stride).collect();
    let coarse = Problem {
        points: &points,
        ..*problem
    };
    let steps = ((reach_m / step_m).ceil() as usize).clamp(1, STARTS / 4);
    let shifts = (0..=steps).flat_map(|step| {
        let shift_m = step as f64 * step_m;
        let directions = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)];
        let count = if step == 0 { 1 } else { 4 };
        (directions.into_iter().take(count)).map(move |(x, y)| Vector3::new(x, y, 0.0) * shift_m)
    });
    let mut best: Option<Alignment> = None;
    for shift in shifts {
        let start = problem.predicted * Pose3::from_parts(shift.into(), nalgebra::one());
        let Some(found) = coarse.align(&start, step_m) else {
            continue;
        };
        if best.as_ref().is_none_or(|best| found.cost < best.cost) {
            best = Some(found);
        }
    }
    problem.align(&best?.odom_from_lidar, step_m / 4.0)
}
