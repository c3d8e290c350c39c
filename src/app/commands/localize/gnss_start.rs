//! A start from the first position of a GNSS receiver: some metres around it, in every heading.

use std::f64::consts::PI;

use anyhow::{Context as _, Result};
use nalgebra::Vector3;

use crate::app::settings::LocalizationConfig;
use crate::georeference::Georeference;
use crate::localization::{StartDistribution, StartSpread};
use crate::map::Map;
use crate::odometry::GnssConstraints;
use crate::recording::Recording;

/// Sets the start of a configuration with positions of a receiver and without a start.
pub fn resolve(config: &mut LocalizationConfig, map: &Map, recording: &Recording) -> Result<()> {
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
    let (pose, spread) = start_at(&gnss, georeference, first_s)?;
    tracing::info!(
        "start by {name}: ({:.1}, {:.1}) m in the map, within {:.1} m, in any heading",
        pose[0],
        pose[1],
        spread.position_m
    );
    config.start = spread;
    config.initial_pose = Some(pose);
    Ok(())
}

/// The position of a receiver at the first scan in a map, and how far the lidar may be from it.
fn start_at(
    gnss: &GnssConstraints,
    georeference: &Georeference,
    first_s: f64,
) -> Result<([f64; 3], StartSpread)> {
    /// Longest time between the first scan and the position [s].
    const WITHIN_S: f64 = 5.0;
    /// Standard deviations within which the start is.
    const SIGMAS: f64 = 3.0;
    let first_fix_s = gnss.fixes.fixes.first().map_or(0.0, |fix| fix.time_s);
    let of_fixes_s = first_s - gnss.config.clock_offset_s;
    let fix = gnss.fixes.near(of_fixes_s, WITHIN_S).with_context(|| {
        format!(
            "{} has no position within {WITHIN_S} s of the first scan at {first_s:.3} s, the first is at {first_fix_s:.3} s; set clock_offset_s to the difference of the clocks, or initial_pose",
            gnss.fixes.path.display()
        )
    })?;
    let point = georeference.on_earth()?.point_in_map(&fix.position)?;
    let arm = gnss.config.antenna_m.or(gnss.fixes.antenna_m);
    let arm_m = Vector3::from(arm.unwrap_or_default()).xy().norm();
    let horizontal_m = fix.horizontal_m.unwrap_or(gnss.config.horizontal_m);
    let sigma_m = horizontal_m.hypot(georeference.horizontal_m);
    let spread = StartSpread {
        distribution: StartDistribution::Uniform,
        position_m: SIGMAS * sigma_m + arm_m,
        heading_rad: PI,
    };
    Ok(([point.x, point.y, 0.0], spread))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::georeference::{
        Geodetic, GeodeticFix, GeodeticFixes, GnssConfig, HeightReference, UtmZone,
    };

    const PLACE: Geodetic = Geodetic {
        latitude_deg: 49.0,
        longitude_deg: 8.4,
        height_m: 110.0,
    };

    fn georeference() -> Georeference {
        Georeference {
            latitude_deg: PLACE.latitude_deg,
            longitude_deg: PLACE.longitude_deg,
            height_m: PLACE.height_m,
            height_above: HeightReference::Ellipsoid,
            roll_deg: 0.0,
            pitch_deg: 0.0,
            yaw_deg: 70.0,
            utm: UtmZone::of(&PLACE),
            horizontal_m: 0.3,
            vertical_m: 0.5,
            heading_deg: 0.1,
        }
    }

    /// A receiver that is 10 m farther along x each second, with an error of 0.4 m.
    fn receiver(clock_offset_s: f64, antenna_m: Option<[f64; 3]>) -> GnssConstraints {
        let earth = georeference().on_earth().unwrap();
        let fix = |number: u32| GeodeticFix {
            time_s: 100.0 + f64::from(number) - clock_offset_s,
            position: (earth.geodetic(&Vector3::new(10.0 * f64::from(number), -20.0, 1.0)))
                .unwrap(),
            horizontal_m: Some(0.4),
            vertical_m: None,
        };
        GnssConstraints {
            fixes: GeodeticFixes {
                path: "fixes.csv".into(),
                fixes: (0..10).map(fix).collect(),
                height_above: HeightReference::Ellipsoid,
                without_position: 0,
                bad_lines: 0,
                antenna_m: None,
            },
            config: GnssConfig {
                clock_offset_s,
                antenna_m,
                ..GnssConfig::default()
            },
        }
    }

    #[test]
    fn the_start_is_around_the_position_at_the_first_scan_in_any_heading() {
        for clock_offset_s in [0.0, 1000.0] {
            let gnss = receiver(clock_offset_s, None);
            let (pose, spread) = start_at(&gnss, &georeference(), 103.2).unwrap();
            assert_relative_eq!(pose[0], 30.0, epsilon = 1e-3);
            assert_relative_eq!(pose[1], -20.0, epsilon = 1e-3);
            // Errors of the position and of the map, 0.5 m together.
            assert_relative_eq!(spread.position_m, 3.0 * 0.5, epsilon = 1e-9);
            assert_eq!(spread.heading_rad, PI);
            assert_eq!(spread.distribution, StartDistribution::Uniform);
        }
    }

    #[test]
    fn an_antenna_away_from_the_lidar_widens_the_circle_by_its_distance() {
        let gnss = receiver(0.0, Some([-3.0, 4.0, 1.0]));
        let (_, spread) = start_at(&gnss, &georeference(), 100.0).unwrap();
        assert_relative_eq!(spread.position_m, 1.5 + 5.0, epsilon = 1e-9);
    }

    #[test]
    fn positions_of_another_time_are_an_error() {
        let gnss = receiver(0.0, None);
        let error = start_at(&gnss, &georeference(), 94.0).unwrap_err();
        let error = error.to_string();
        for part in ["fixes.csv", "94.000", "100.000", "clock_offset_s"] {
            assert!(error.contains(part), "{error}");
        }
    }
}
