//! Search of the pose of a scan where no prediction is good enough: several starts, coarse to fine.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::alignment::{Alignment, Problem, best};
use super::residuals::Observation;
use crate::geometry::Pose3;

/// The alignment with the least cost from starts around the prediction and around the previous pose, turned as was measured, where it was: shifts along
/// both horizontal axes up to `reach_m`, in steps of `step_m`, and turns about all axes.
pub fn search(problem: &Problem, step_m: f64, reach_m: f64) -> Option<Alignment> {
    /// Starts that are aligned.
    const ALIGNED: usize = 8;
    best_of(problem, starts(problem, step_m, reach_m), step_m, ALIGNED)
}

/// The alignment with the least cost from a pose, and from starts all around the previous pose: shifts up to `reach_m`
/// and turns up to 43 degrees about the vertical.
pub fn search_widely(
    problem: &Problem,
    from: Option<Pose3>,
    step_m: f64,
    reach_m: f64,
) -> Option<Alignment> {
    /// Starts that are aligned.
    const ALIGNED: usize = 40;
    let mut starts = wide_starts(problem, step_m, reach_m);
    starts.extend(from);
    best_of(problem, starts, step_m, ALIGNED)
}

/// The alignment with the least cost from those of some starts that cost least.
fn best_of(
    problem: &Problem,
    starts: Vec<Pose3>,
    step_m: f64,
    most_aligned: usize,
) -> Option<Alignment> {
    /// Points that take part in the comparison of starts.
    const POINTS: usize = 400;
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
    let mut starts: Vec<(f64, Pose3)> = (starts.into_par_iter())
        .map(|start| {
            let (cost, _) = coarse.judge(&start, step_m, &mut observation.unmatched());
            (cost, start)
        })
        .collect();
    starts.sort_by(|a, b| a.0.total_cmp(&b.0));
    starts.truncate(most_aligned);
    let aligned: Vec<Alignment> = (starts.par_iter())
        .filter_map(|(_, start)| coarse.align(start, step_m))
        .collect();
    problem.align(&best(aligned)?.odom_from_lidar, step_m / 4.0)
}

/// Turn between starts [rad].
const TURN: f64 = 0.12;
/// Most steps of a search.
const MAX_STEPS: usize = 20;

/// Shifts in a disc around the previous pose, each with turns about the vertical.
fn wide_starts(problem: &Problem, step_m: f64, reach_m: f64) -> Vec<Pose3> {
    const TURNS: i32 = 6;
    let steps = steps(step_m, reach_m);
    let shifts = (-steps..=steps)
        .flat_map(|x| (-steps..=steps).map(move |y| (x, y)))
        .filter(|(x, y)| x * x + y * y <= steps * steps);
    shifts
        .flat_map(|(x, y)| {
            let shift = Vector3::new(f64::from(x), f64::from(y), 0.0) * step_m;
            (-TURNS..=TURNS).map(move |turn| (shift, Vector3::z() * f64::from(turn) * TURN))
        })
        .map(|(shift, turn)| problem.unmoved * Pose3::new(shift, turn))
        .collect()
}

/// Number of steps up to the reach.
fn steps(step_m: f64, reach_m: f64) -> i32 {
    ((reach_m / step_m).ceil() as usize).clamp(1, MAX_STEPS) as i32
}

/// Starts around the prediction and around the previous pose: shifts with turns about the vertical, and turns about
/// all axes.
fn starts(problem: &Problem, step_m: f64, reach_m: f64) -> Vec<Pose3> {
    let turns = || [0.0, TURN, -TURN].into_iter();
    let shifts = (1..=steps(step_m, reach_m)).flat_map(|step| {
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
    [problem.predicted, problem.unmoved]
        .iter()
        .flat_map(|middle| moves.iter().map(move |start| middle * start))
        .collect()
}
