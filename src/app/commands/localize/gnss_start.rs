//! A start from the first position of a GNSS receiver: some metres around it, in every heading.

use std::f64::consts::PI;

use anyhow::{Context as _, Result};
use nalgebra::Vector3;

use crate::app::settings::LocalizationConfig;
use crate::localization::{StartDistribution, StartSpread};
use crate::map::Map;
use crate::recording::Recording;

/// Sets the start of a configuration with positions of a receiver and without a start.
pub fn resolve(config: &mut LocalizationConfig, map: &Map, recording: &Recording) -> Result<()> {
    /// Longest time between the first scan and the position [s].
    const WITHIN_S: f64 = 5.0;
    /// Standard deviations within which the start is.
    const SIGMAS: f64 = 3.0;
    let is_wanted = config.initial_pose.is_none() && config.initialization.is_none();
    let Some(gnss) = config.gnss.read(recording)?.filter(|_| is_wanted) else {
        return Ok(());
    };
    let name = gnss.fixes.path.display();
    let georeference = map.path.georeference.as_ref().with_context(|| {
        format!(
            "gnss_file is {name}, but the place of the map on the Earth is not known; build it with gnss_file, or set initial_pose"
        )
    })?;
    let first_s = recording.frames.first().map_or(0.0, |frame| frame.time_s);
    let first_fix_s = gnss.fixes.fixes.first().map_or(0.0, |fix| fix.time_s);
    let of_fixes_s = first_s - gnss.config.clock_offset_s;
    let fix = gnss.fixes.near(of_fixes_s, WITHIN_S).with_context(|| {
        format!(
            "{name} has no position within {WITHIN_S} s of the first scan at {first_s:.3} s, the first is at {first_fix_s:.3} s; set clock_offset_s to the difference of the clocks, or initial_pose"
        )
    })?;
    let point = georeference.on_earth()?.point_in_map(&fix.position)?;
    let arm = gnss.config.antenna_m.or(gnss.fixes.antenna_m);
    let arm_m = Vector3::from(arm.unwrap_or_default()).xy().norm();
    let horizontal_m = fix.horizontal_m.unwrap_or(gnss.config.horizontal_m);
    let sigma_m = horizontal_m.hypot(georeference.horizontal_m);
    config.start = StartSpread {
        distribution: StartDistribution::Uniform,
        position_m: SIGMAS * sigma_m + arm_m,
        heading_rad: PI,
    };
    config.initial_pose = Some([point.x, point.y, 0.0]);
    tracing::info!(
        "start by {name}: ({:.1}, {:.1}) m in the map, within {:.1} m, in any heading",
        point.x,
        point.y,
        config.start.position_m
    );
    Ok(())
}
