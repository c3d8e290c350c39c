//! The frames before the first tracked one, filled back from it: by the odometry, where the scan agrees with the map.

use anyhow::Result;

use super::opened::Opened;
use crate::app::report::LocalizationResults;
use crate::app::settings::OdometrySource;
use crate::geometry::{Pose2, Pose3};
use crate::localization::State;
use crate::recording::Frame;
use crate::refinement::{InitialEstimate, TrajectoryRefiner};

/// Rows and poses in space of the frames that can be placed in the map, of those up to the first tracked one; `None` without
/// odometry, and where no scan can be read again. `frames` begin with these frames.
pub fn fill_back(
    opened: &Opened,
    frames: &[Frame],
    searched: &LocalizationResults,
) -> Result<Option<Vec<(usize, Pose3)>>> {
    let (Some(states), Some(estimates), Some(odometry), Some(sensor)) = (
        &searched.states,
        &searched.estimates,
        &searched.odometry,
        &opened.sensor,
    ) else {
        return Ok(None);
    };
    let config = &opened.config;
    if config.motion.odometry == OdometrySource::None {
        return Ok(None);
    }
    let states = states.iter();
    let states = states.map(|&it| State::from_number(it).unwrap_or(State::Searching));
    let increments: Vec<Option<Pose2>> = odometry.iter().copied().map(Some).collect();
    let starts = InitialEstimate::from_filter(
        estimates,
        searched.estimates_in_space.as_deref(),
        searched.covariances.as_deref(),
        &states.collect::<Vec<_>>(),
        &increments,
        searched.times_s.as_deref(),
    );
    let seed = config.tracker.seed;
    let mut refiner = TrajectoryRefiner::new(&opened.map, sensor, config.refiner(), seed)?;
    for (frame, start) in frames.iter().zip(&starts) {
        refiner.add(&frame.read()?, start)?;
    }
    refiner.place_backwards(&starts, &increments, |row| anyhow::Ok(frames[row].read()?))?;
    let found = refiner.finish(None)?;
    let rows = (0..starts.len() - 1).filter(|&row| found.states[row] == State::Tracking);
    Ok(Some(
        rows.map(|row| (row, found.map_from_lidar[row])).collect(),
    ))
}
