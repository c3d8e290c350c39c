//! The frames before the first tracked one, filled back from it: by the odometry, where the scan agrees with the map.

use anyhow::Result;

use super::opened::Opened;
use crate::app::report::LocalizationResults;
use crate::app::run::Context;
use crate::app::settings::OdometrySource;
use crate::geometry::{Pose2, Pose3};
use crate::localization::State;
use crate::refinement::{InitialEstimate, TrajectoryRefiner};

/// The trajectory in space and the states of its poses; `None` where there is nothing to fill, or no odometry.
pub fn fill_back(
    opened: &Opened,
    results: &LocalizationResults,
    context: &Context,
) -> Result<Option<(Vec<Pose3>, Vec<u8>)>> {
    let (Some(states), Some(estimates), Some(in_space), Some(odometry)) = (
        &results.states,
        &results.estimates,
        &results.estimates_in_space,
        &results.odometry,
    ) else {
        return Ok(None);
    };
    let config = &opened.config;
    let is_tracking = |state: &u8| *state == State::Tracking as u8;
    let first = states.iter().position(is_tracking);
    let Some(first) = first.filter(|&first| {
        first > 0
            && config.motion.odometry != OdometrySource::None
            && !context.interrupt.requested()
    }) else {
        return Ok(None);
    };
    let words = states[..=first].iter();
    let words = words.map(|&it| State::from_number(it).unwrap_or(State::Searching));
    let increments: Vec<Option<Pose2>> = odometry[..=first].iter().copied().map(Some).collect();
    let starts = InitialEstimate::from_filter(
        &estimates[..=first],
        results.covariances.as_deref(),
        &words.collect::<Vec<_>>(),
        &increments,
        results.times_s.as_deref(),
    );
    let frames = &opened.recording.frames;
    let seed = config.tracker.seed;
    let mut refiner = TrajectoryRefiner::new(&opened.map, &opened.sensor, config.refiner(), seed)?;
    for (frame, start) in frames.iter().zip(&starts) {
        refiner.add(&frame.read()?, start)?;
    }
    refiner.place_backwards(&starts, &increments, |row| anyhow::Ok(frames[row].read()?))?;
    let found = refiner.finish(None)?;
    let (mut poses, mut states) = (in_space.clone(), states.clone());
    for row in (0..first).filter(|&row| found.states[row] == State::Tracking) {
        poses[row] = found.map_from_lidar[row];
        states[row] = State::Tracking as u8;
    }
    Ok(Some((poses, states)))
}
