//! LiDAR scan simulation: beams of a spinning sensor, range noise, dropout and intensities.
//!
//! A surface of reflectance ρ that a beam hits at an angle α to its normal is detected up to
//!
//! ```text
//! r_max = reach · √(ρ |cos α|^¼ / 0.8)        P(return at r) = 1 / (1 + exp((r − r_max) / 0.05 r_max))
//! ```
//!
//! The square root is the radar equation of an extended target; the weak power of the cosine
//! stands for rough surfaces (asphalt at 60 m is hit at 2 degrees and still returns). Beam
//! elevations: Velodyne, *HDL-64E S2 user's manual*: 32 lasers in steps of 1/3 degree from +2
//! to -8.33, 32 in steps of 1/2 degree from -8.83 to -24.33.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};
use rand::{Rng, RngExt as _};
use rand_distr::{Distribution as _, StandardNormal};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::builder::{LabelledMesh, Material};
use super::classes;
use super::ego_motion::SCAN_PERIOD_S;
use crate::geometry::{Pose3, Rigid3f};
use crate::lidar::{LidarModel, Scan};
use crate::raycasting::{Hit, Scene};
use crate::validation::{
    InvalidValue, Validate, fraction, in_range, not_negative, positive, require,
};

/// Azimuth steps that share one sensor pose under a rolling shutter.
const STEPS_PER_POSE: usize = 8;

/// The sensor.
///
/// Defaults: a Velodyne HDL-64E at 10 revolutions per second.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ScannerConfig {
    /// Number of beams of the HDL-64E that are used, evenly chosen: 64, 32, 16, ...
    #[default(64)]
    pub beams: usize,
    /// Elevations of the beams from the top, instead of those of the HDL-64E; empty for
    /// those [deg].
    pub elevations_deg: Vec<f64>,
    /// Measurements of each beam per revolution.
    #[default(1900)]
    pub azimuth_steps: usize,
    /// Least measured range [m].
    #[default(2.0)]
    pub min_range_m: f64,
    /// Greatest measured range [m].
    #[default(90.0)]
    pub max_range_m: f64,
    /// Range at which half the beams return from a surface of reflectance 0.8 at normal
    /// incidence [m].
    #[default(140.0)]
    pub reach_m: f64,
    /// Standard deviation of a range [m].
    #[default(0.02)]
    pub range_noise_m: f64,
    /// Share of all returns that is lost at random, 0 to 1.
    #[default(0.02)]
    pub dropout_share: f64,
    /// Share of the beams that return from a drop of rain before they reach a surface, 0 to 1.
    pub false_return_share: f64,
    /// Whether the sensor moves during a revolution; `false` gives motion-compensated scans.
    pub rolling_shutter: bool,
}

impl Validate for ScannerConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("beams", self.beams, 1..=4096)?;
        in_range("azimuth_steps", self.azimuth_steps, 1..=65_536)?;
        require(
            self.beams.max(self.elevations_deg.len()) * self.azimuth_steps
                <= LidarModel::MAX_PIXELS,
            "azimuth_steps",
            self.azimuth_steps,
            format!(
                "a scan has up to {} beams, beams times azimuth_steps",
                LidarModel::MAX_PIXELS
            ),
        )?;
        not_negative("min_range_m", self.min_range_m)?;
        positive("max_range_m", self.max_range_m)?;
        require(
            self.min_range_m < self.max_range_m,
            "min_range_m",
            self.min_range_m,
            format!(
                "it must be less than max_range_m, which is {}",
                self.max_range_m
            ),
        )?;
        in_range("reach_m", self.reach_m, 1.0..=10_000.0)?;
        not_negative("range_noise_m", self.range_noise_m)?;
        fraction("dropout_share", self.dropout_share)?;
        fraction("false_return_share", self.false_return_share)
    }
}

/// A scan with the SemanticKITTI class of every point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LabelledScan {
    /// The points, beam by beam from the top, each counter-clockwise from straight back.
    pub scan: Scan,
    /// Class of each point.
    pub classes: Vec<u16>,
}

/// A labelled mesh prepared for ray casting.
pub struct ScanTarget {
    scene: Scene,
    surface: LabelledMesh,
}

impl ScanTarget {
    /// Builds the acceleration structure.
    pub fn new(surface: LabelledMesh) -> Self {
        Self {
            scene: Scene::new(&surface.mesh),
            surface,
        }
    }
}

/// The hit of a beam.
#[derive(Clone, Copy, Debug)]
struct Echo {
    range_m: f32,
    material: Material,
    /// |cos α|.
    incidence: f32,
}

/// Simulates one revolution. `world_from_lidar` gives the pose at a time relative to that of the
/// scan [s]: the sensor faces backwards half a revolution before, to the right a quarter before,
/// and forwards at that time, as KITTI's does.
pub fn simulate_scan(
    config: &ScannerConfig,
    targets: &[&ScanTarget],
    world_from_lidar: impl Fn(f64) -> Pose3,
    rng: &mut impl Rng,
) -> LabelledScan {
    let steps = config.azimuth_steps;
    let steps_per_pose = if config.rolling_shutter {
        STEPS_PER_POSE
    } else {
        steps.max(1)
    };
    let elevations_rad = elevations_rad(config);
    let directions = directions(&elevations_rad, steps);
    let mut echoes = vec![None; directions.len()];
    for first in (0..steps).step_by(steps_per_pose) {
        let columns = first..(first + steps_per_pose).min(steps);
        let turn = 0.5 * (columns.start + columns.end) as f64 / steps as f64 - 0.5;
        let world_from_lidar = Rigid3f::from(&world_from_lidar(turn * SCAN_PERIOD_S));
        let indices: Vec<usize> = (0..elevations_rad.len())
            .flat_map(|beam| columns.clone().map(move |column| beam * steps + column))
            .collect();
        let rays: Vec<Vec3> = indices
            .iter()
            .map(|&index| world_from_lidar.rotate(directions[index]))
            .collect();
        let nearest = nearest_echoes(targets, world_from_lidar.translation, &rays);
        for (index, echo) in indices.into_iter().zip(nearest) {
            echoes[index] = echo;
        }
    }
    measure(config, &directions, &echoes, rng)
}

/// Elevations of the beams, from the top [rad].
fn elevations_rad(config: &ScannerConfig) -> Vec<f32> {
    let elevations_deg = if config.elevations_deg.is_empty() {
        hdl64_elevations_deg(config.beams)
    } else {
        config.elevations_deg.clone()
    };
    let elevations_rad = elevations_deg.iter().map(|deg| deg.to_radians() as f32);
    elevations_rad.collect()
}

/// `count` of the elevations of the HDL-64E, evenly chosen, from the top [deg].
fn hdl64_elevations_deg(count: usize) -> Vec<f64> {
    let count = count.clamp(1, 64);
    (0..count)
        .map(|beam| match (beam * 64 / count) as u8 {
            laser @ 0..32 => 2.0 - f64::from(laser) / 3.0,
            laser => -8.83 - 0.5 * f64::from(laser - 32),
        })
        .collect()
}

/// Unit directions in the lidar frame, beam by beam.
fn directions(elevations_rad: &[f32], steps: usize) -> Vec<Vec3> {
    let azimuths: Vec<Vec2> = (0..steps)
        .map(|step| {
            let turn = (step as f32 + 0.5) / steps as f32 - 0.5;
            Vec2::from_angle(TAU * turn)
        })
        .collect();
    let rows = elevations_rad.iter().flat_map(|elevation_rad| {
        let (sin, cos) = elevation_rad.sin_cos();
        let row = azimuths.iter();
        row.map(move |azimuth| Vec3::new(cos * azimuth.x, cos * azimuth.y, sin))
    });
    rows.collect()
}

/// Measurements of the echoes, with dropout and range noise.
fn measure(
    config: &ScannerConfig,
    directions: &[Vec3],
    echoes: &[Option<Echo>],
    rng: &mut impl Rng,
) -> LabelledScan {
    let limits_m = config.min_range_m as f32..config.max_range_m as f32;
    let mut labelled = LabelledScan::default();
    for (&direction, echo) in directions.iter().zip(echoes) {
        if let Some(range_m) = rain_return_m(config, echo.as_ref(), rng) {
            labelled.scan.points.push(direction * range_m);
            labelled.scan.intensities.push(0.02);
            labelled.classes.push(classes::OUTLIER);
            continue;
        }
        let Some(echo) = echo else { continue };
        let dropout: f64 = rng.random();
        let detection: f32 = rng.random();
        let deviate: f32 = StandardNormal.sample(rng);
        let r_max = detectable_up_to_m(config, echo);
        let probability = 1.0 / (1.0 + ((echo.range_m - r_max) / (0.05 * r_max)).exp());
        let range_m = echo.range_m + config.range_noise_m as f32 * deviate;
        let is_lost = dropout < config.dropout_share || detection > probability;
        if is_lost || !limits_m.contains(&range_m) {
            continue;
        }
        let brightness = echo.material.reflectance * echo.incidence.sqrt();
        let intensity = (brightness * (1.0 + 0.1 * deviate)).clamp(0.0, 1.0);
        labelled.scan.points.push(direction * range_m);
        labelled.scan.intensities.push(intensity);
        labelled.classes.push(echo.material.class);
    }
    labelled
}

/// Range of a return from rain [m]: exponentially distributed, since near drops hide those behind them.
fn rain_return_m(config: &ScannerConfig, echo: Option<&Echo>, rng: &mut impl Rng) -> Option<f32> {
    /// Mean range beyond the least one [m].
    const MEAN_M: f32 = 5.0;
    // Without rain no numbers are drawn: those of the surfaces are the same.
    if config.false_return_share == 0.0 || !rng.random_bool(config.false_return_share) {
        return None;
    }
    let range_m = config.min_range_m as f32 - MEAN_M * (1.0 - rng.random::<f32>()).ln();
    let limit_m = echo.map_or(f32::INFINITY, |echo| echo.range_m);
    (range_m < limit_m.min(config.max_range_m as f32)).then_some(range_m)
}

/// r_max of a surface [m].
fn detectable_up_to_m(config: &ScannerConfig, echo: &Echo) -> f32 {
    const REFERENCE_REFLECTANCE: f32 = 0.8;
    let power = echo.material.reflectance * echo.incidence.powf(0.25) / REFERENCE_REFLECTANCE;
    // Even the darkest surface is detected up to two metres.
    (config.reach_m as f32 * power.sqrt()).max(2.0)
}

fn nearest_echoes(targets: &[&ScanTarget], origin: Vec3, rays: &[Vec3]) -> Vec<Option<Echo>> {
    let mut nearest: Vec<Option<Echo>> = vec![None; rays.len()];
    let mut hits = vec![Hit::MISS; rays.len()];
    for ScanTarget { scene, surface } in targets {
        if surface.mesh.triangles.is_empty() {
            continue;
        }
        scene.cast(origin, rays, &mut hits);
        for ((hit, ray), best) in hits.iter().zip(rays).zip(&mut nearest) {
            let is_nearer = hit.range_m < best.map_or(f32::INFINITY, |echo| echo.range_m);
            if hit.triangle != Hit::NO_TRIANGLE && is_nearer {
                let triangle = hit.triangle as usize;
                let normal = surface.mesh.scaled_normal(triangle).normalize_or_zero();
                *best = Some(Echo {
                    range_m: hit.range_m,
                    material: surface.materials[triangle],
                    incidence: normal.dot(*ray).abs(),
                });
            }
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::super::builder::MeshBuilder;
    use super::*;

    /// A bright box with its extents along x, y and z.
    fn bright_box(class: u16, x: [f32; 2], y: [f32; 2], z: [f32; 2]) -> ScanTarget {
        let mut surface = LabelledMesh::default();
        let identity = Rigid3f::from(&Pose3::identity());
        let mut builder = MeshBuilder::new(&mut surface, identity);
        builder.set_material(class, 1.0);
        builder.cuboid(x, y, z);
        ScanTarget::new(surface)
    }

    /// A room of 20 m with the sensor in its middle.
    fn room() -> ScanTarget {
        bright_box(50, [-10.0, 10.0], [-10.0, 10.0], [-10.0, 10.0])
    }

    fn scan(config: &ScannerConfig, world_from_lidar: impl Fn(f64) -> Pose3) -> LabelledScan {
        let mut rng = StdRng::seed_from_u64(5);
        simulate_scan(config, &[&room()], world_from_lidar, &mut rng)
    }

    const EXACT: ScannerConfig = ScannerConfig {
        beams: 64,
        elevations_deg: Vec::new(),
        azimuth_steps: 360,
        min_range_m: 0.5,
        max_range_m: 100.0,
        reach_m: 1e4,
        range_noise_m: 0.0,
        dropout_share: 0.0,
        false_return_share: 0.0,
        rolling_shutter: false,
    };

    #[test]
    fn without_noise_every_beam_ends_on_a_wall() {
        let labelled = scan(&EXACT, |_| Pose3::identity());
        assert_eq!(labelled.scan.len(), 64 * 360);
        for point in &labelled.scan.points {
            assert_relative_eq!(point.abs().max_element(), 10.0, epsilon = 1e-4);
        }
        assert!(labelled.classes.iter().all(|&class| class == 50));
    }

    #[test]
    fn beams_have_the_elevations_of_the_sensor() {
        for beams in [64, 32, 16] {
            let config = ScannerConfig { beams, ..EXACT };
            let labelled = scan(&config, |_| Pose3::identity());
            for (beam, row) in labelled.scan.points.chunks(360).enumerate() {
                let laser = beam * 64 / beams;
                let expected_deg = if laser < 32 {
                    2.0 - laser as f32 / 3.0
                } else {
                    -8.83 - 0.5 * (laser - 32) as f32
                };
                for point in row {
                    let elevation_deg = (point.z / point.length()).asin().to_degrees();
                    assert_relative_eq!(elevation_deg, expected_deg, epsilon = 1e-3);
                }
            }
        }
        let config = ScannerConfig {
            elevations_deg: vec![10.0, -10.0],
            ..EXACT
        };
        assert_eq!(scan(&config, |_| Pose3::identity()).scan.len(), 720);
    }

    #[test]
    fn ranges_have_the_configured_noise() {
        let exact = scan(&EXACT, |_| Pose3::identity());
        let config = ScannerConfig {
            range_noise_m: 0.02,
            ..EXACT
        };
        let noisy = scan(&config, |_| Pose3::identity());
        let errors: Vec<f64> = exact
            .scan
            .points
            .iter()
            .zip(&noisy.scan.points)
            .map(|(a, b)| f64::from(b.length() - a.length()))
            .collect();
        let n = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / n;
        let sigma = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
        // Four standard errors.
        assert_relative_eq!(mean, 0.0, epsilon = 4.0 * 0.02 / n.sqrt());
        assert_relative_eq!(sigma, 0.02, epsilon = 4.0 * 0.02 / (2.0 * n).sqrt());
    }

    #[test]
    fn the_configured_share_of_returns_is_lost() {
        let config = ScannerConfig {
            dropout_share: 0.1,
            ..EXACT
        };
        let n = (64 * 360) as f64;
        let kept = scan(&config, |_| Pose3::identity()).scan.len() as f64 / n;
        // Four standard errors of a share.
        assert_relative_eq!(kept, 0.9, epsilon = 4.0 * (0.09 / n).sqrt());
    }

    #[test]
    fn the_configured_share_of_beams_returns_from_rain_before_the_walls() {
        let config = ScannerConfig {
            false_return_share: 0.1,
            ..EXACT
        };
        let labelled = scan(&config, |_| Pose3::identity());
        let is_rain = |class: &&u16| **class == classes::OUTLIER;
        let n = (64 * 360) as f64;
        let share = labelled.classes.iter().filter(is_rain).count() as f64 / n;
        // A tenth, without the drops behind the walls at 10 to 15 m: e^(-9.5/5) to e^(-13.6/5) of them.
        assert!((0.08..0.097).contains(&share), "{share}");
        for (point, class) in labelled.scan.points.iter().zip(&labelled.classes) {
            let reach = point.abs().max_element();
            assert!(reach < 10.001 && (*class == classes::OUTLIER || reach > 9.999));
        }
        assert_eq!(labelled.scan.len(), 64 * 360);
    }

    #[test]
    fn half_of_the_returns_are_lost_at_the_reach_of_the_sensor() {
        // Normal incidence, reflectance 1 instead of 0.8: r_max = reach · √(1 / 0.8) = 10 m.
        let config = ScannerConfig {
            elevations_deg: vec![0.0; 4000],
            azimuth_steps: 4,
            reach_m: 10.0 * 0.8_f64.sqrt(),
            ..EXACT
        };
        let towards_walls =
            |_| Pose3::rotation(nalgebra::Vector3::z() * std::f64::consts::FRAC_PI_4);
        let share = scan(&config, towards_walls).scan.len() as f64 / 16_000.0;
        assert_relative_eq!(share, 0.5, epsilon = 4.0 * (0.25_f64 / 16_000.0).sqrt());
    }

    #[test]
    fn nothing_is_measured_beyond_the_range_limits() {
        for (min_range_m, max_range_m) in [(0.5, 9.9), (18.0, 100.0)] {
            let config = ScannerConfig {
                min_range_m,
                max_range_m,
                ..EXACT
            };
            assert!(scan(&config, |_| Pose3::identity()).scan.is_empty());
        }
    }

    #[test]
    fn a_revolution_of_a_moving_sensor_is_distorted_by_half_its_motion_before_and_after() {
        let config = ScannerConfig {
            rolling_shutter: true,
            elevations_deg: vec![0.0],
            azimuth_steps: 3600,
            ..EXACT
        };
        let moving = |delay_s: f64| Pose3::translation(10.0 * delay_s, 0.0, 0.0);
        let labelled = scan(&config, moving);
        let points = &labelled.scan.points;
        // Straight back half a revolution early: half a metre behind, half a metre nearer.
        assert_relative_eq!(points[0].x, -9.5, epsilon = 0.02);
        assert_relative_eq!(points[1800].x, 10.0, epsilon = 0.02);
        assert_relative_eq!(points[3599].x, -10.5, epsilon = 0.02);

        let standing = scan(&config, |_| Pose3::identity());
        let compensated = ScannerConfig {
            rolling_shutter: false,
            ..config
        };
        assert_eq!(standing, scan(&compensated, |_| Pose3::identity()));
    }

    #[test]
    fn the_nearer_of_two_targets_is_measured() {
        let car = bright_box(252, [4.0, 5.0], [-5.0, 5.0], [-5.0, 5.0]);
        for targets in [[&room(), &car], [&car, &room()]] {
            let mut rng = StdRng::seed_from_u64(5);
            let labelled = simulate_scan(&EXACT, &targets, |_| Pose3::identity(), &mut rng);
            for (point, &class) in labelled.scan.points.iter().zip(&labelled.classes) {
                let is_on_car = (point.x - 4.0).abs() < 0.01 && point.y.abs() <= 5.0;
                assert_eq!(class == 252, is_on_car, "{point} {class}");
            }
        }
    }
}
