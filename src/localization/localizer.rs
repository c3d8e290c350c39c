//! Localization of a car in a map, scan by scan.

use super::config::LocalizerConfig;
use super::estimate::Estimate;
use super::filter::ParticleFilter;
use super::initialization::{StartDistribution, StartSpread, around, from_panoramas};
use super::odometry::Odometry;
use super::particles::{Particle, ParticleSet};
use super::preparation::ScanPreparation;
use super::sweep::SweepMotion;
use super::tracking_loss::State;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Beam, Motion, RangeImage, Scan};
use crate::map::{Map, PanoramaRequest, SearchRegion, SensorAttitude};
use crate::random::{Generator, stream};
use crate::registration::measured_range_factor;
use crate::rendering::RenderError;
use crate::sensor::{Sensor, SensorError};
use crate::validation::{InvalidValue, Validate as _, nested};

/// Random streams: of the initial particles, and of the first frame; those of the other frames follow.
const INITIALIZATION_STREAM: u64 = 0;
const FIRST_FRAME_STREAM: u64 = 2;

/// Where the car starts.
#[derive(Clone, Debug, PartialEq)]
pub enum Start {
    /// Near a known pose.
    Pose {
        /// The pose, map frame.
        map_from_lidar: Pose2,
        /// Height of the sensor in the map frame [m], which selects among levels of ground; `None` for
        /// the lowest.
        height_m: Option<f64>,
        /// How far from it the car may be.
        spread: StartSpread,
    },
    /// Anywhere on the road along which the map was built.
    Road,
    /// Anywhere on the ground of the map.
    Anywhere,
}

impl Start {
    /// Without knowledge: anywhere on the ground, or, in a map of more than 1 km² that has a path, on its road. All ground
    /// of a city has too many places for panoramas of each.
    pub fn unknown(map: &Map) -> Self {
        const LARGE_M2: f64 = 1e6;
        let area_m2 = map.tiles.len() as f64 * map.tiles.side_m.powi(2);
        if area_m2 > LARGE_M2 && !map.path.map_from_lidar.is_empty() {
            Self::Road
        } else {
            Self::Anywhere
        }
    }

    /// Near a known pose in space.
    pub fn near(map_from_lidar: &Pose3, spread: StartSpread) -> Self {
        Self::Pose {
            map_from_lidar: pose2_from_pose3(map_from_lidar),
            height_m: Some(map_from_lidar.translation.z),
            spread,
        }
    }
}

/// Why a scan cannot be localized.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum LocalizerError {
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    #[error(transparent)]
    Render(#[from] RenderError),
    #[error(transparent)]
    Sensor(#[from] SensorError),
    #[error(
        "the odometry {0:?} is not finite or farther than any place on Earth; correct the odometry of this frame"
    )]
    ImpossibleOdometry(Odometry),
    #[error("the map has no ground where the search could start; build the map again")]
    NoGround,
    #[error(
        "the start at x {x:.1} m, y {y:.1} m is outside the mapped area; check that the start is given in the frame of the map"
    )]
    StartOutside { x: f64, y: f64 },
}

/// Estimates the pose of a car in a map from its scans.
pub struct Localizer {
    map: Map,
    config: LocalizerConfig,
    start: Start,
    seed: u64,
    preparation: ScanPreparation,
    /// Attitude of the sensor with which the last frame began.
    attitude: SensorAttitude,
    sweep: SweepMotion,
    frames: u64,
    /// Whether the factor of the ranges is measured in each scan.
    measures_each_factor: bool,
    /// Height of the sensor in the panoramas [m]; `None`: that of the scans.
    panorama_height_m: Option<f64>,
    /// Number of scans in which a pose was tracked.
    tracked: usize,
    /// Factor of the ranges of the last scan, if a pose is tracked and it was measured.
    range_factor: Option<f64>,
    /// `None` before the first frame.
    filter: Option<ParticleFilter>,
}

impl Localizer {
    /// Prepares the localization of a drive with a sensor. The same seed gives the same estimates.
    ///
    /// # Errors
    /// The configuration, or the spread of the start, is out of its range.
    pub fn new(
        map: &Map,
        sensor: &Sensor,
        config: LocalizerConfig,
        start: Start,
        seed: u64,
    ) -> Result<Self, LocalizerError> {
        config.validate()?;
        if let Start::Pose { spread, .. } = &start {
            nested("start", spread)?;
        }
        let preparation = ScanPreparation::new(sensor, &config.ground)?;
        Ok(Self {
            map: map.clone(),
            attitude: preparation.assumed_attitude(),
            preparation,
            sweep: SweepMotion::default(),
            config,
            start,
            seed,
            frames: 0,
            measures_each_factor: false,
            panorama_height_m: None,
            tracked: 0,
            range_factor: None,
            filter: None,
        })
    }

    /// Sets the rectangle of the own car, x_min, x_max, y_min, y_max [m], once the scans show it.
    pub(super) fn set_own_car(&mut self, own_car_m: [f32; 4]) {
        self.preparation.sensor.own_car_m = own_car_m;
    }

    /// Renders the panoramas that the start needs, for the height of the sensor in a scan.
    pub(super) fn prepare_start(&mut self, scan: &Scan) -> Result<(), LocalizerError> {
        if let Start::Pose { .. } = self.start {
            return Ok(());
        }
        let image = self.preparation.range_image(scan, None);
        if let Some(attitude) = self.preparation.attitude(&image) {
            self.attitude = attitude;
        }
        self.map.panoramas(&self.panorama_request())?;
        Ok(())
    }

    /// Estimates `map_from_lidar` at the moment of the next scan, given the motion since the previous one.
    ///
    /// # Errors
    /// The motion is impossible, the points do not fit the sensor, the start is outside of the map, or the map cannot be
    /// rendered.
    pub fn step(&mut self, scan: &Scan, odometry: Odometry) -> Result<Estimate, LocalizerError> {
        if !odometry.is_possible() {
            return Err(LocalizerError::ImpossibleOdometry(odometry));
        }
        let duration_s = self.sweep.duration_s(scan);
        let mut rng = stream(self.seed, FIRST_FRAME_STREAM + self.frames);
        self.frames += 1;
        let known = match &mut self.filter {
            Some(filter) => filter.predict(odometry)?,
            None => None,
        };
        let predicted = self.sweep.predict(odometry, duration_s);
        let start = self.registered(scan, odometry, known, predicted.as_ref(), &mut rng)?;
        let found = start.and_then(|pose| self.sweep.around(&pose, duration_s));
        let motion = found.or(predicted);
        let image = self.preparation.range_image(scan, motion.as_ref());
        if let Some(attitude) = known.or_else(|| self.preparation.attitude(&image)) {
            self.attitude = attitude;
        }
        let filter = match self.filter.take() {
            Some(filter) => filter,
            None => {
                self.preparation.sensor.require_fit(scan)?;
                self.initialize(&image)?
            }
        };
        let filter = self.filter.insert(filter);
        filter.set_duration_s(duration_s);
        filter.set_registration_start(start);
        let mut estimate = filter.step(odometry, &image, &self.attitude, &mut rng)?;
        self.range_factor = None;
        if estimate.state == State::Tracking {
            self.tracked += 1;
            if self.measures_each_factor || self.is_range_factor_due() {
                let factor = self.measured_range_factor(&image, &estimate.map_from_lidar);
                // A tile that cannot be read is an error of the scan that needs it.
                self.range_factor = factor.ok().flatten();
            }
        }
        let pose = Some(estimate.map_from_lidar).filter(|_| estimate.state == State::Tracking);
        let found = pose.and_then(|pose| self.sweep.around(&pose, duration_s));
        self.sweep.update(pose, scan, duration_s);
        estimate.motion = found.or(motion);
        Ok(estimate)
    }

    /// The factor of the ranges of the last scan with which they fit the map best at the pose that is tracked; `None` where it was not
    /// measured.
    pub(super) fn range_factor(&self) -> Option<f64> {
        self.range_factor
    }

    /// Whether the factor is measured in the scan of a drive that may be distorted: in the first tracked ones, and then now and then.
    fn is_range_factor_due(&self) -> bool {
        const FIRST: usize = 10;
        const STEP: usize = 10;
        let is_start_known = matches!(self.start, Start::Pose { .. });
        !is_start_known && (self.tracked <= FIRST || self.tracked.is_multiple_of(STEP))
    }

    /// Whether one pose is followed, also where it is not certain.
    pub(super) fn follows_a_pose(&self) -> bool {
        (self.filter.as_ref()).is_some_and(ParticleFilter::follows_a_pose)
    }

    fn measured_range_factor(
        &self,
        image: &RangeImage,
        map_from_lidar: &Pose3,
    ) -> Result<Option<f64>, RenderError> {
        /// Number of beams.
        const COUNT: usize = 800;
        // Odd: rows have an even number of columns, most of which would be left out else.
        let step = image.beams().count().div_ceil(COUNT) | 1;
        let beams: Vec<Beam> = image.beams().step_by(step).collect();
        let config = &self.config.proposal.registration;
        measured_range_factor(&*self.map.renderer, &beams, map_from_lidar, config)
    }

    /// A localizer of the same drive for scans without a distortion, near a pose, or else with the same start.
    pub(super) fn begin_undistorted(&self, pose: Option<Pose3>) -> Option<Self> {
        /// Spread around a pose to which ranges have led that are off by a few per cent.
        const SPREAD: StartSpread = StartSpread {
            distribution: StartDistribution::Gaussian,
            position_m: 0.5,
            heading_rad: 0.05,
        };
        let start = match pose {
            Some(pose) => Start::near(&pose, SPREAD),
            None => self.start.clone(),
        };
        let (sensor, config) = (&self.preparation.sensor, self.config.clone());
        let localizer = Self::new(&self.map, sensor, config, start, self.seed).ok()?;
        Some(Self {
            measures_each_factor: true,
            panorama_height_m: Some(self.panorama_request().sensor_height_m),
            ..localizer
        })
    }

    /// Pose of a scan whose points have times, by a registration of some of them with the predicted motion during the sweep;
    /// `None` without times, while the filter is not tracking, and where registration fails.
    fn registered(
        &self,
        scan: &Scan,
        odometry: Odometry,
        attitude: Option<SensorAttitude>,
        predicted: Option<&Motion>,
        rng: &mut Generator,
    ) -> Result<Option<Pose3>, LocalizerError> {
        /// Every n-th point is registered; beams are not numbered in multiples of it.
        const STEP: usize = 3;
        let filter = self.filter.as_ref().filter(|_| !scan.times_s.is_empty());
        let Some((filter, attitude)) = filter.zip(attitude) else {
            return Ok(None);
        };
        let some = scan.every(STEP);
        let image = self.preparation.range_image(&some, predicted);
        Ok(filter.registered(odometry, &image, &attitude, rng)?)
    }

    /// The filter with its initial particles.
    fn initialize(&self, image: &RangeImage) -> Result<ParticleFilter, LocalizerError> {
        let mut rng = stream(self.seed, INITIALIZATION_STREAM);
        let request = self.panorama_request();
        let count = self.config.num_particles;
        let particles = match &self.start {
            Start::Pose {
                map_from_lidar,
                height_m,
                spread,
            } => {
                let level_m = height_m.map(|height_m| height_m - self.attitude.height_m);
                around(map_from_lidar, level_m, count, spread, &mut rng)
            }
            Start::Road | Start::Anywhere => {
                let index = self.map.panoramas(&request)?;
                from_panoramas(
                    &index,
                    image,
                    &self.attitude,
                    count,
                    &self.config.places,
                    &mut rng,
                )?
            }
        };
        let Some(first) = particles.first() else {
            return Err(LocalizerError::NoGround);
        };
        let tiles = &self.map.tiles;
        let is_on_map = |p: &Particle| tiles.valid_tile_of(&p.map_from_lidar).is_some();
        if !particles.iter().any(is_on_map) {
            let t = first.map_from_lidar.translation;
            return Err(LocalizerError::StartOutside { x: t.x, y: t.y });
        }
        let particles = ParticleSet::uniform(particles);
        let (config, map) = (self.config.clone(), self.map.clone());
        let filter = ParticleFilter::new(config, map, Some(request), particles)?;
        Ok(match self.start {
            Start::Pose { .. } => filter,
            Start::Road | Start::Anywhere => filter.searching_anywhere(),
        })
    }

    /// The panoramas for a start without a pose and for a restart after a loss.
    fn panorama_request(&self) -> PanoramaRequest {
        /// Heights that are not configured are rounded, so that drives of one car share the panoramas [m].
        const HEIGHT_STEP_M: f64 = 0.25;
        let region = match self.start {
            Start::Pose { .. } | Start::Road => SearchRegion::Road,
            Start::Anywhere => SearchRegion::Anywhere,
        };
        let rounded_m = (self.attitude.height_m / HEIGHT_STEP_M).round() * HEIGHT_STEP_M;
        PanoramaRequest {
            region,
            lidar: self.preparation.sensor.range_image.clone(),
            sensor_height_m: (self.panorama_height_m)
                .or(self.preparation.sensor.sensor_height_m)
                .unwrap_or(rounded_m),
            config: self.config.panorama.clone(),
        }
    }
}

#[cfg(test)]
#[path = "localizer_tests.rs"]
mod tests;
