//! A GNSS receiver on the simulated car: positions with correlated errors, and signals that houses reflect.
//!
//! ```text
//! eₖ₊₁ = a eₖ + σ √(1 − a²) N(0, 1)        a = exp(−Δt / τ)
//! ```
//!
//! A first-order Gauss-Markov process: Brown and Hwang, *Introduction to Random Signals and Applied Kalman Filtering* (2012),
//! section 2.6. Reflections begin at random and move the position to one place while they last.

use std::f64::consts::TAU;
use std::io::{self, Write};

use nalgebra::{Point3, Vector3};
use rand::{Rng, RngExt as _};
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::Pose3;
use crate::georeference::{
    Geodetic, GeodeticFix, Georeference, HeightReference, ProjectionError, UtmZone, Wgs84,
};
use crate::validation::{InvalidValue, Validate, in_range};

/// A receiver on the car.
///
/// Defaults: none; with an interval, one without corrections, among houses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedGnssConfig {
    /// Time between two positions; 0 for no receiver [s].
    pub interval_s: f64,
    /// Latitude of the origin of the street [deg].
    #[default(49.011)]
    pub latitude_deg: f64,
    /// Longitude of the origin of the street [deg].
    #[default(8.417)]
    pub longitude_deg: f64,
    /// Height of the origin of the street above the ellipsoid [m].
    #[default(115.0)]
    pub height_m: f64,
    /// Direction of the x axis of the street from east, counter-clockwise [deg].
    #[default(30.0)]
    pub yaw_deg: f64,
    /// Standard deviation along each horizontal axis [m].
    #[default(1.5)]
    pub horizontal_m: f64,
    /// The same of the height [m].
    #[default(3.0)]
    pub vertical_m: f64,
    /// Time constant of the correlation of the errors (τ) [s].
    #[default(10.0)]
    pub correlation_s: f64,
    /// Fraction of the time during which signals are reflected.
    #[default(0.05)]
    pub reflected_share: f64,
    /// Mean duration of a reflection [s].
    #[default(5.0)]
    pub reflected_s: f64,
    /// Horizontal error of a position by reflected signals [m].
    #[default(20.0)]
    pub reflected_m: f64,
    /// Position x, y, z of the antenna in the lidar frame [m].
    pub antenna_m: [f64; 3],
}

impl Validate for SimulatedGnssConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        let interval_s = self.interval_s;
        if interval_s != 0.0 {
            in_range("interval_s", interval_s, 0.01..=1000.0)?;
        }
        in_range("latitude_deg", self.latitude_deg, -80.0..=84.0)?;
        in_range("longitude_deg", self.longitude_deg, -180.0..=180.0)?;
        in_range("height_m", self.height_m, -1000.0..=10_000.0)?;
        in_range("yaw_deg", self.yaw_deg, -360.0..=360.0)?;
        in_range("horizontal_m", self.horizontal_m, 0.0..=1000.0)?;
        in_range("vertical_m", self.vertical_m, 0.0..=1000.0)?;
        in_range("correlation_s", self.correlation_s, 0.0..=10_000.0)?;
        in_range("reflected_share", self.reflected_share, 0.0..=0.9)?;
        in_range("reflected_s", self.reflected_s, 0.1..=1000.0)?;
        in_range("reflected_m", self.reflected_m, 0.0..=10_000.0)?;
        (self.antenna_m.iter()).try_for_each(|&m| in_range("antenna_m", m, -100.0..=100.0))
    }
}

impl SimulatedGnssConfig {
    /// Whether there is a receiver.
    pub fn is_on(&self) -> bool {
        self.interval_s > 0.0
    }

    /// The place of the street on the Earth.
    fn street(&self) -> Georeference {
        let origin = Geodetic {
            latitude_deg: self.latitude_deg,
            longitude_deg: self.longitude_deg,
            height_m: self.height_m,
        };
        Georeference {
            latitude_deg: self.latitude_deg,
            longitude_deg: self.longitude_deg,
            height_m: self.height_m,
            height_above: HeightReference::Ellipsoid,
            roll_deg: 0.0,
            pitch_deg: 0.0,
            yaw_deg: self.yaw_deg,
            utm: UtmZone::of(&origin),
            horizontal_m: 0.0,
            vertical_m: 0.0,
            heading_deg: 0.0,
        }
    }
}

/// The errors of a receiver, east north up [m].
struct Errors<'a, R> {
    config: &'a SimulatedGnssConfig,
    rng: R,
    slow: Vector3<f64>,
    reflection: Option<Vector3<f64>>,
}

impl<'a, R: Rng> Errors<'a, R> {
    fn new(config: &'a SimulatedGnssConfig, rng: R) -> Self {
        let mut errors = Self {
            config,
            rng,
            slow: Vector3::zeros(),
            reflection: None,
        };
        errors.slow = errors.noise();
        errors
    }

    fn noise(&mut self) -> Vector3<f64> {
        let [horizontal, vertical] = [self.config.horizontal_m, self.config.vertical_m];
        Vector3::new(horizontal, horizontal, vertical)
            .map(|sigma_m| sigma_m * self.rng.sample::<f64, _>(StandardNormal))
    }

    /// The error an interval later.
    fn next(&mut self) -> Vector3<f64> {
        let config = self.config;
        let keep = if config.correlation_s > 0.0 {
            (-config.interval_s / config.correlation_s).exp()
        } else {
            0.0
        };
        let noise = self.noise();
        self.slow = keep * self.slow + (1.0 - keep * keep).sqrt() * noise;
        // Two states: of the time in both, the share is reflected.
        let share = config.reflected_share;
        let ends = 1.0 - (-config.interval_s / config.reflected_s).exp();
        let begins = ends * share / (1.0 - share);
        let (changes, angle) = (self.rng.random::<f64>(), TAU * self.rng.random::<f64>());
        self.reflection = match self.reflection {
            Some(_) if changes < ends => None,
            None if changes < begins => {
                let towards = Vector3::new(angle.cos(), angle.sin(), 1.0);
                Some(config.reflected_m * towards)
            }
            unchanged => unchanged,
        };
        self.slow + self.reflection.unwrap_or_default()
    }
}

/// The positions that a receiver reports until a time, by the clock of the scans.
pub fn fixes(
    config: &SimulatedGnssConfig,
    last_s: f64,
    world_from_lidar: impl Fn(f64) -> Pose3,
    rng: impl Rng,
) -> Result<Vec<GeodeticFix>, ProjectionError> {
    let (street, wgs84) = (config.street().on_earth()?, Wgs84::new()?);
    let mut errors = Errors::new(config, rng);
    let count = (last_s / config.interval_s + 1e-6) as usize + 1;
    let fix = |number: usize| {
        let time_s = config.interval_s * number as f64;
        let antenna = world_from_lidar(time_s) * Point3::from(config.antenna_m);
        let exact = street.geodetic(&antenna.coords)?;
        let ecef = wgs84.ecef_from_enu(&exact)? * Point3::from(errors.next());
        Ok(GeodeticFix {
            time_s,
            position: wgs84.geodetic(&ecef.coords)?,
            horizontal_m: Some(config.horizontal_m).filter(|&m| m > 0.0),
            vertical_m: Some(config.vertical_m).filter(|&m| m > 0.0),
        })
    };
    (0..count).map(fix).collect()
}

/// Writes a table of fixes: time [s], latitude, longitude [deg], height [m] and standard deviations [m].
pub fn write_fixes(mut writer: impl Write, fixes: &[GeodeticFix]) -> io::Result<()> {
    writeln!(
        writer,
        "time_s,latitude_deg,longitude_deg,height_m,horizontal_m,vertical_m"
    )?;
    for fix in fixes {
        let at = fix.position;
        let [horizontal_m, vertical_m] =
            [fix.horizontal_m, fix.vertical_m].map(Option::unwrap_or_default);
        writeln!(
            writer,
            "{:.3},{:.10},{:.10},{:.4},{horizontal_m},{vertical_m}",
            fix.time_s, at.latitude_deg, at.longitude_deg, at.height_m
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::random::{Purpose, stream};
    use super::*;

    #[test]
    fn errors_have_their_standard_deviation_their_correlation_and_their_share_of_reflections() {
        let config = SimulatedGnssConfig {
            interval_s: 0.5,
            reflected_m: 1000.0,
            ..SimulatedGnssConfig::default()
        };
        let mut errors = Errors::new(&config, stream(1, Purpose::Gnss, 1));
        let mut east = vec![];
        let (mut reflected, count) = (0.0, 40_000);
        for _ in 0..count {
            errors.next();
            east.push(errors.slow.x);
            reflected += if errors.reflection.is_some() {
                1.0
            } else {
                0.0
            };
        }
        let mean_of = |lag: usize| -> f64 {
            let products = east.iter().zip(&east[lag..]).map(|(a, b)| a * b);
            products.sum::<f64>() / (east.len() - lag) as f64
        };
        // 20,000 s are 1000 independent errors: 4.5 % of a variance is a standard error.
        assert!((mean_of(0) / 2.25 - 1.0).abs() < 0.18, "{}", mean_of(0));
        let after_10_s = mean_of(20) / mean_of(0);
        assert!((after_10_s - (-1.0_f64).exp()).abs() < 0.1, "{after_10_s}");
        let share = reflected / f64::from(count);
        assert!((share - 0.05).abs() < 0.015, "{share}");
    }
}
