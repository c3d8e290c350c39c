//! Search of the pose of a scan where no prediction is good enough: several starts, coarse to fine.

use nalgebra::Vector3;

use super::alignment::{Alignment, Problem};
use super::residuals::Observation;
use crate::geometry::Pose3;

/// The alignment with the least cost from starts around the prediction and around the previous pose: shifts along
/// both horizontal axes up to `reach_m`, in steps of `step_m`, and turns about all axes.
pub fn search(problem: &Problem, step_m: f64, reach_m: f64) -> Option<Alignment> {
    /// Points that take part in the comparison of starts.
    const POINTS: usize = 400;
    /// Starts that are aligned.
    const ALIGNED: usize = 8;
    let stride = problem.observation.points.len().div_ceil(POINTS).max(1);
    let points: Vec<_> = (problem.observation.points.iter().copied().step_by(stride)).collect();
    let observation = Observation {
        points: &points,
        ..problem.observation
    };
    let coarse = Problem {
        observation,
        ..*problem
    };
    let mut starts: Vec<(f64, Pose3)> = (starts(problem, step_m, reach_m).into_iter())
        .map(|start| {
            let cost = coarse.cost(&start, step_m, &mut observation.unmatched());
            (cost, start)
        })
        .collect();
    starts.sort_by(|a, b| a.0.total_cmp(&b.0));
    let aligned =
        (starts.iter().take(ALIGNED)).filter_map(|(_, start)| coarse.align(start, step_m));
    let best = aligned.min_by(|a, b| a.cost.total_cmp(&b.cost))?;
    problem.align(&best.odom_from_lidar, step_m / 4.0)
}

/// Starts around the prediction and around the previous pose: shifts with turns about the vertical, and turns about
/// all axes.
fn starts(problem: &Problem, step_m: f64, reach_m: f64) -> Vec<Pose3> {
    const MAX_STEPS: usize = 20;
    const TURN: f64 = 0.12;
    let steps = ((reach_m / step_m).ceil() as usize).clamp(1, MAX_STEPS) as i32;
    let turns = || [0.0, TURN, -TURN].into_iter();
    let shifts = (1..=steps).flat_map(|step| {
        let shift_m = f64::from(step) * step_m;
        [Vector3::x(), -Vector3::x(), Vector3::y(), -Vector3::y()].map(|axis| axis * shift_m)
    });
    let driving = shifts.flat_map(|shift| turns().map(move |yaw| (shift, Vector3::z() * yaw)));
    let turning = turns().flat_map(|roll| {
        turns().flat_map(move |pitch| {
            turns().map(move |yaw| (Vector3::zeros(), Vector3::new(roll, pitch, yaw)))
        })
    });
    let moves: Vec<Pose3> = (turning.chain(driving))
        .map(|(shift, turn)| Pose3::new(shift, turn))
        .collect();
    [problem.predicted, problem.observation.odom_from_previous]
        .iter()
        .flat_map(|middle| moves.iter().map(move |start| middle * start))
        .collect()
}
