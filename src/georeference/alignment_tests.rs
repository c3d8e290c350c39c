//! Tests of the alignment of a path with fixes.

use approx::assert_abs_diff_eq;
use rand::{RngExt as _, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;

use super::*;
use crate::georeference::{Geodetic, GeodeticFix, HeightReference};

/// A drive around a block, 10 m/s, with a height.
struct Drive {
    times_s: Vec<f64>,
    poses: Vec<Pose3>,
}

impl Drive {
    fn new(seconds: usize) -> Self {
        let times_s: Vec<f64> = (0..10 * seconds).map(|i| 0.1 * i as f64).collect();
        let pose = |time_s: &f64| {
            let angle = time_s / 30.0;
            let position =
                Vector3::new(300.0 * angle.sin(), 200.0 * angle.cos(), 3.0 * angle.sin());
            Pose3::from_parts(
                position.into(),
                UnitQuaternion::from_euler_angles(0.0, 0.0, -angle),
            )
        };
        Self {
            poses: times_s.iter().map(pose).collect(),
            times_s,
        }
    }

    fn path(&self) -> PathOverTime<'_> {
        PathOverTime {
            times_s: &self.times_s,
            map_from_lidar: &self.poses,
        }
    }

    /// Fixes of an antenna at a place of the map, with an error per fix, east north up [m].
    fn fixes(
        &self,
        truth: &Georeference,
        antenna: Vector3<f64>,
        step: usize,
        mut error_m: impl FnMut(usize) -> Vector3<f64>,
    ) -> GeodeticFixes {
        let earth = truth.on_earth().unwrap();
        let wgs84 = Wgs84::new().unwrap();
        let fix = |row: usize| {
            let point = self.poses[row] * nalgebra::Point3::from(antenna);
            let exact = earth.geodetic(&point.coords).unwrap();
            let ecef_from_enu = wgs84.ecef_from_enu(&exact).unwrap();
            let ecef = ecef_from_enu * nalgebra::Point3::from(error_m(row));
            GeodeticFix {
                time_s: self.times_s[row],
                position: wgs84.geodetic(&ecef.coords).unwrap(),
                horizontal_m: None,
                vertical_m: None,
            }
        };
        GeodeticFixes {
            path: "fixes".into(),
            fixes: (0..self.poses.len()).step_by(step).map(fix).collect(),
            height_above: HeightReference::Ellipsoid,
            without_position: 0,
            bad_lines: 0,
            antenna_m: None,
        }
    }
}

fn truth(tilt_deg: f64) -> Georeference {
    let origin = Geodetic {
        latitude_deg: 49.011,
        longitude_deg: 8.417,
        height_m: 115.0,
    };
    Georeference {
        latitude_deg: origin.latitude_deg,
        longitude_deg: origin.longitude_deg,
        height_m: origin.height_m,
        height_above: HeightReference::Ellipsoid,
        roll_deg: tilt_deg,
        pitch_deg: -0.5 * tilt_deg,
        yaw_deg: 130.0,
        utm: UtmZone::of(&origin),
        horizontal_m: 0.0,
        vertical_m: 0.0,
        heading_deg: 0.0,
    }
}

/// Difference of the places of a point of the map, east north up [m].
fn difference(found: &Georeference, truth: &Georeference, point: Vector3<f64>) -> Vector3<f64> {
    let wgs84 = Wgs84::new().unwrap();
    let [found, truth] = [found, truth].map(|it| it.on_earth().unwrap().geodetic(&point).unwrap());
    let enu_from_ecef = wgs84.ecef_from_enu(&truth).unwrap().inverse();
    let ecef = wgs84.ecef(&found).unwrap();
    enu_from_ecef.transform_point(&ecef.into()).coords
}

/// Gauss-Markov errors of a standard deviation [m] and a time constant [s], 10 per second, and reflected signals.
fn correlated(
    seed: u64,
    sigma_m: f64,
    correlation_s: f64,
    has_outliers: bool,
) -> impl FnMut(usize) -> Vector3<f64> {
    let mut rng = StdRng::seed_from_u64(seed);
    let mut deviate = move || -> f64 { rng.sample(StandardNormal) };
    let keep = (-0.1 / correlation_s).exp();
    let mut error = sigma_m * Vector3::new(deviate(), deviate(), 2.0 * deviate());
    let mut last = 0;
    move |row| {
        for _ in last..row {
            let noise = Vector3::new(deviate(), deviate(), 2.0 * deviate());
            error = keep * error + sigma_m * (1.0 - keep * keep).sqrt() * noise;
        }
        last = row;
        // Five of sixty seconds are between houses that reflect.
        let is_reflected = has_outliers && row % 600 > 550;
        error
            + if is_reflected {
                Vector3::new(-18.0, 25.0, 30.0)
            } else {
                Vector3::zeros()
            }
    }
}

#[test]
fn exact_fixes_give_the_georeference_and_a_lever_arm_is_taken_into_account() {
    let drive = Drive::new(120);
    let antenna = Vector3::new(-0.5, 0.3, 1.2);
    let fixes = drive.fixes(&truth(0.0), antenna, 5, |_| Vector3::zeros());
    let config = GnssConfig {
        antenna_m: Some(antenna.into()),
        ..GnssConfig::default()
    };
    let found = align(drive.path(), &fixes, &config).unwrap();
    assert_eq!(found.summary.outliers, 0);
    // Far away, the map would be level where the first fix is, if the heights did not show where.
    let far = Vector3::new(1000.0, -500.0, 10.0);
    for (point, limit_m) in [(Vector3::zeros(), 1e-3), (far, 0.02)] {
        let error = difference(&found.georeference, &truth(0.0), point);
        assert!(error.norm() < limit_m, "{error}");
    }
    assert_abs_diff_eq!(found.georeference.yaw_deg, 130.0, epsilon = 1e-5);
    // Without the lever arm, its height is missing.
    let without = align(drive.path(), &fixes, &GnssConfig::default()).unwrap();
    let error = difference(&without.georeference, &truth(0.0), Vector3::zeros());
    assert!((error.z - 1.2).abs() < 0.1, "{error}");
}

#[test]
fn a_map_that_is_tilted_as_its_first_scan_was_is_levelled_where_the_fixes_show_it() {
    let drive = Drive::new(400);
    let tilted = truth(1.5);
    let fixes = drive.fixes(&tilted, Vector3::zeros(), 10, |_| Vector3::zeros());
    let config = GnssConfig {
        horizontal_m: 0.05,
        vertical_m: 0.1,
        ..GnssConfig::default()
    };
    let found = align(drive.path(), &fixes, &config).unwrap();
    let error = difference(&found.georeference, &tilted, Vector3::new(300.0, 0.0, 0.0));
    assert!(error.norm() < 0.02, "{error}");
}

#[test]
fn reflected_signals_change_almost_nothing() {
    let drive = Drive::new(300);
    let align = |has_outliers| {
        let errors = correlated(1, 1.5, 10.0, has_outliers);
        let fixes = drive.fixes(&truth(0.0), Vector3::zeros(), 2, errors);
        super::align(drive.path(), &fixes, &GnssConfig::default()).unwrap()
    };
    let (with, without) = (align(true), align(false));
    let error = difference(&with.georeference, &without.georeference, Vector3::zeros());
    assert!(error.xy().norm() < 0.25, "{error}");
    // All that are reflected, and no more than a few others.
    assert!(
        (120..160).contains(&with.summary.outliers),
        "{:?}",
        with.summary
    );
    assert!(with.summary.horizontal_rms_m < 3.0, "{:?}", with.summary);
}

#[test]
fn the_standard_deviation_is_that_of_the_errors() {
    let drive = Drive::new(400);
    let config = GnssConfig {
        correlation_s: 10.0,
        ..GnssConfig::default()
    };
    let center: Vector3<f64> = (drive.poses.iter())
        .map(|pose| pose.translation.vector)
        .sum::<Vector3<f64>>()
        / drive.poses.len() as f64;
    const SEEDS: u64 = 60;
    let mut squares = [0.0; 2];
    for seed in 0..SEEDS {
        let fixes = drive.fixes(
            &truth(0.0),
            Vector3::zeros(),
            5,
            correlated(seed, 1.5, 10.0, false),
        );
        let found = align(drive.path(), &fixes, &config).unwrap().georeference;
        let error = difference(&found, &truth(0.0), center);
        squares[0] += error.xy().norm_squared() / found.horizontal_m.powi(2);
        squares[1] += (found.yaw_deg - 130.0).powi(2) / found.heading_deg.powi(2);
    }
    for square in squares {
        // Four standard errors of the mean of 60 squares of normal numbers.
        let mean = square / SEEDS as f64;
        assert!((0.4..1.8).contains(&mean), "{squares:?}");
    }
}

#[test]
fn fixes_that_are_repeated_count_once() {
    let drive = Drive::new(200);
    let deviation = |step| {
        let fixes = drive.fixes(&truth(0.0), Vector3::zeros(), step, |_| Vector3::zeros());
        let found = align(drive.path(), &fixes, &GnssConfig::default()).unwrap();
        found.georeference.horizontal_m
    };
    assert_abs_diff_eq!(deviation(1) / deviation(20), 1.0, epsilon = 0.03);
}

#[test]
fn what_the_fixes_do_not_show_is_an_error() {
    let drive = Drive::new(60);
    let mut fixes = drive.fixes(&truth(0.0), Vector3::zeros(), 10, |_| Vector3::zeros());
    let still = Drive {
        poses: vec![Pose3::identity(); drive.poses.len()],
        times_s: drive.times_s.clone(),
    };
    let align = |drive: &Drive, fixes: &GeodeticFixes, clock_offset_s| {
        let config = GnssConfig {
            clock_offset_s,
            ..GnssConfig::default()
        };
        super::align(drive.path(), fixes, &config)
    };
    let error = align(&still, &fixes, 0.0).unwrap_err().to_string();
    assert!(error.contains("too short"), "{error}");
    for fix in &mut fixes.fixes {
        fix.time_s += 1e9;
    }
    let error = align(&drive, &fixes, 0.0).unwrap_err().to_string();
    assert!(
        error.starts_with("0 of 60 fixes") && error.contains("clock_offset_s"),
        "{error}"
    );
    assert!(align(&drive, &fixes, -1e9).is_ok());
}
