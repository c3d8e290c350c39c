//! Refinement of a whole trajectory: every frame by itself, then all of them with the odometry.
//!
//! ```text
//! frame by frame    swarm, Gauss-Newton                                  refiner
//! not tracked       from the frame before by the odometry, else from the frame after
//! all frames        min  frames (robust) + odometry between neighbours   smoothing
//! ```
//!
//! The trajectory is split where tracking was lost and where the odometry contradicts the frames, because it
//! may not describe how the car came from before the loss to after it; frames without an estimate are
//! bridged by the odometry.

use std::cell::RefCell;
use std::ops::Range;
use std::sync::{Arc, Weak};

use glam::DVec3;
use nalgebra::{Matrix3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::objective::FrameObjective;
use super::refiner::{Distance, FrameRefinementConfig, Method, refine_frame};
use super::smoothing::{self, FramePrior, smooth};
use super::upright::UprightSurfaces;
use crate::geometry::{Pose2, Pose3, TriangleMesh, pose3_from_pose2};
use crate::ground::GroundConfig;
use crate::lidar::{Beam, Motion, RangeImage, Scan};
use crate::localization::observation::{
    ClassifiedReturns, ObservationConfig, agreement, ranges_along,
};
use crate::localization::{Estimate, ScanPreparation, State, TrackingLossConfig};
use crate::map::{GroundPatch, Map, MapError, SensorAttitude};
use crate::random::{Generator, stream};
use crate::rendering::{RangeRenderer, RenderError};
use crate::sensor::{Sensor, SensorError};
use crate::validation::{InvalidValue, Validate, nested};

/// Configuration of the refinement of a trajectory.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RefinerConfig {
    /// Ground segmentation of the scans.
    pub ground: GroundConfig,
    /// Selection of beams and cost of differences.
    pub observation: ObservationConfig,
    /// Swarm, Gauss-Newton and smoothing.
    pub refinement: FrameRefinementConfig,
}

impl Validate for RefinerConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("ground", &self.ground)?;
        nested("observation", &self.observation)?;
        nested("refinement", &self.refinement)
    }
}

/// An estimate to refine.
#[derive(Clone, Debug, PartialEq)]
pub struct InitialEstimate {
    /// `map_from_lidar` seen from above.
    pub pose: Pose2,
    /// `map_from_lidar` in space, from which a tracked frame has the height and the attitude of the sensor; `None` for those
    /// of the frame before, else of the ground in the scan.
    pub map_from_lidar: Option<Pose3>,
    /// Covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²]; `None` for standard
    /// deviations of 0.2 m and 0.6 degrees.
    pub covariance: Option<Matrix3<f64>>,
    /// State of the filter. Frames that were not tracked are placed from their neighbours.
    pub state: State,
    /// Motion of the sensor, by which the scan is deskewed.
    pub motion: Option<Motion>,
    /// Motion `previous_from_current` since the frame before, which predicts the pose where the frame was not tracked or
    /// the estimate is too uncertain for Gauss-Newton.
    pub increment: Option<Pose2>,
}

impl InitialEstimate {
    /// A pose whose frame was tracked, without a covariance.
    pub fn tracked(pose: Pose2) -> Self {
        Self {
            pose,
            map_from_lidar: None,
            covariance: None,
            state: State::Tracking,
            motion: None,
            increment: None,
        }
    }

    /// The poses of a rough trajectory with standard deviations of position [m] and heading [rad], and the increments
    /// of its odometry `previous_from_current`, of which the first is ignored. Scans are deskewed by the odometry, if all
    /// of it and the times of the poses [s] are known.
    pub fn from_rough(
        poses: &[Pose2],
        [position_m, heading_rad]: [f64; 2],
        increments: &[Option<Pose2>],
        times_s: Option<&[f64]>,
    ) -> Vec<Self> {
        let variances = [position_m, position_m, heading_rad].map(|deviation| deviation.powi(2));
        let driven = Self::driven(increments);
        let motion = |row: usize| Motion::along(driven.as_ref()?, times_s?, row);
        let rough = |(row, pose): (usize, &Pose2)| Self {
            pose: *pose,
            map_from_lidar: None,
            covariance: Some(Matrix3::from_diagonal(&variances.into())),
            state: State::Tracking,
            motion: motion(row),
            increment: increments[row].filter(|_| row > 0),
        };
        poses.iter().enumerate().map(rough).collect()
    }

    /// The estimates of a filter, seen from above and, where known, in space, with their covariances and states, and the
    /// increments of the odometry `previous_from_current`, of which the first is ignored. Where the times [s] are known, scans
    /// are deskewed by the estimates around them, if these were tracked, else by the odometry.
    pub fn from_filter(
        estimates: &[Pose2],
        map_from_lidar: Option<&[Pose3]>,
        covariances: Option<&[Matrix3<f64>]>,
        states: &[State],
        increments: &[Option<Pose2>],
        times_s: Option<&[f64]>,
    ) -> Vec<Self> {
        let level = estimates.iter().map(|pose| pose3_from_pose2(pose, 0.0));
        let in_space = map_from_lidar.map_or_else(|| level.collect(), <[Pose3]>::to_vec);
        let driven = Self::driven(increments);
        let motion = |row: usize| {
            let around = &states[Motion::rows_along(estimates.len(), row)];
            let is_known = around.iter().all(|it| *it == State::Tracking);
            let poses = if is_known {
                Some(&in_space)
            } else {
                driven.as_ref()
            };
            Motion::along(poses?, times_s?, row)
        };
        let initial = |(row, pose): (usize, &Pose2)| Self {
            pose: *pose,
            map_from_lidar: map_from_lidar.map(|all| all[row]),
            covariance: covariances.map(|all| all[row]),
            state: states[row],
            motion: motion(row),
            increment: increments[row].filter(|_| row > 0),
        };
        estimates.iter().enumerate().map(initial).collect()
    }

    /// Poses to which increments `previous_from_current` lead from the first one; the first increment is ignored. `None` if one is
    /// missing.
    pub(crate) fn driven(increments: &[Option<Pose2>]) -> Option<Vec<Pose3>> {
        let mut pose = Pose2::identity();
        let after = |increment: &Option<Pose2>| {
            pose *= (*increment)?;
            Some(pose3_from_pose2(&pose, 0.0))
        };
        let start = increments.first().map(|_| Some(Pose3::identity()));
        let rest = increments.iter().skip(1).map(after);
        start.into_iter().chain(rest).collect()
    }
}

impl From<&Estimate> for InitialEstimate {
    fn from(estimate: &Estimate) -> Self {
        Self {
            pose: estimate.pose,
            map_from_lidar: Some(estimate.map_from_lidar),
            covariance: Some(estimate.covariance),
            state: estimate.state,
            motion: estimate.motion,
            increment: None,
        }
    }
}

impl InitialEstimate {
    /// Pose in space of a tracked frame, where it is known.
    fn tracked_in_space(&self) -> Option<Pose3> {
        (self.map_from_lidar).filter(|_| self.state == State::Tracking)
    }

    fn covariance(&self) -> Matrix3<f64> {
        let default = || Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 1e-4));
        self.covariance.unwrap_or_else(default)
    }
}

/// A refined frame, before smoothing.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameResult {
    /// `map_from_lidar` seen from above.
    pub pose: Pose2,
    /// `map_from_lidar` in space; `None` where the frame was not refined.
    pub map_from_lidar: Option<Pose3>,
    /// Covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
    /// State of the filter; `Tracking` where a frame was placed from its neighbours, and `Searching` where a tracked one was
    /// refused.
    pub state: State,
    /// What the refinement changed; `None` where the frame was not refined.
    pub change: Option<FrameChange>,
    /// Above `ground`, or above the mapped ground at about `level_m`.
    attitude: SensorAttitude,
    ground: Option<GroundPatch>,
    /// Height of the ground below the sensor [m], if known.
    level_m: Option<f64>,
}

/// How well a frame fits the map before and after its refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameChange {
    /// Mean cost of the differences [m].
    pub cost_m: [f64; 2],
    /// Share of the compared beams that end on a surface of the map; `None` for too few beams.
    pub agreement: [Option<f64>; 2],
}

/// A refined trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct RefinedTrajectory {
    /// `map_from_lidar` seen from above.
    pub poses: Vec<Pose2>,
    /// `map_from_lidar` in space; not refined ones are above the ground of the map.
    pub map_from_lidar: Vec<Pose3>,
    /// Covariances of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    pub covariances: Vec<Matrix3<f64>>,
    /// Frames that the filter did not track and that could not be placed from their neighbours.
    pub untracked: usize,
    /// Tracked frames that were not refined because there is no mapped ground under the car, and without it their scans do not
    /// determine the pose, or no beam is in the scan.
    pub unmapped: usize,
    /// Whether the trajectory was smoothed.
    pub is_smoothed: bool,
    /// State of each frame: `Searching` where its estimate was uncertain and it could not be placed.
    pub states: Vec<State>,
    /// What the refinement changed in each frame, before smoothing; `None` where the frame was not refined.
    pub changes: Vec<Option<FrameChange>>,
}

/// Why a trajectory cannot be refined.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum RefinerError {
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    #[error(transparent)]
    Render(#[from] RenderError),
    #[error(transparent)]
    Map(#[from] MapError),
    #[error(transparent)]
    Sensor(#[from] SensorError),
    #[error(
        "there are {increments} odometry increments for {frames} frames; give one per frame, the first of which is ignored"
    )]
    IncrementCount { frames: usize, increments: usize },
}

/// Upright surfaces around a square.
struct NearbySurfaces {
    square: Vector2<i64>,
    /// The mesh from which they come.
    mesh: Weak<TriangleMesh>,
    surfaces: Arc<UprightSurfaces>,
}

/// Refines a trajectory: [`add`](Self::add) every frame in order, then [`finish`](Self::finish).
pub struct TrajectoryRefiner {
    map: Map,
    config: RefinerConfig,
    seed: u64,
    preparation: ScanPreparation,
    /// The refined frames, without the first ones that were [forgotten](Self::forget).
    frames: Vec<FrameResult>,
    forgotten: usize,
    /// Upright surfaces of the map around the last wide search.
    surfaces: RefCell<Option<NearbySurfaces>>,
    /// `refined * estimate⁻¹` of the last frame that was placed.
    correction: Option<Pose2>,
}

/// The beams of a scan, and the signed ranges of the map along them from a pose.
struct Comparison {
    beams: Vec<Beam>,
    rendered_m: Vec<f32>,
    config: TrackingLossConfig,
}

impl Comparison {
    fn new(
        renderer: &dyn RangeRenderer,
        map_from_lidar: &Pose3,
        beams: Vec<Beam>,
    ) -> Result<Self, RefinerError> {
        let config = TrackingLossConfig::default();
        Ok(Self {
            rendered_m: ranges_along(renderer, map_from_lidar, &beams, config.tolerance_m)?,
            beams,
            config,
        })
    }

    /// Share of the compared beams that end on a surface of the map; `None` for too few beams.
    fn agreement(&self) -> Option<f64> {
        agreement(&self.beams, &self.rendered_m, self.config.tolerance_m)
    }

    /// Whether most of the beams end on the surfaces of the map, and few behind them.
    fn agrees(&self) -> bool {
        /// Least share of agreeing beams among all.
        const MIN_SHARE: f64 = 0.4;
        let is_hit = |(beam, rendered_m): &(&Beam, &f32)| {
            (beam.range_m - rendered_m.abs()).abs() <= self.config.tolerance_m
        };
        let hits = self
            .beams
            .iter()
            .zip(&self.rendered_m)
            .filter(is_hit)
            .count();
        let is_sure = |share: f64| share >= self.config.sure_agreement;
        self.agreement().is_some_and(is_sure) && hits as f64 >= MIN_SHARE * self.beams.len() as f64
    }
}

impl TrajectoryRefiner {
    /// Prepares the refinement of the scans of a sensor in a map. The same seed gives the same trajectory.
    ///
    /// # Errors
    /// The configuration is out of its range.
    pub fn new(
        map: &Map,
        sensor: &Sensor,
        config: RefinerConfig,
        seed: u64,
    ) -> Result<Self, RefinerError> {
        config.validate()?;
        Ok(Self {
            map: map.clone(),
            preparation: ScanPreparation::new(sensor, &config.ground)?,
            config,
            seed,
            frames: Vec::new(),
            forgotten: 0,
            surfaces: RefCell::default(),
            correction: None,
        })
    }

    /// Refines the next frame. One whose estimate is uncertain, or whose state is not `Tracking`, is placed from the
    /// frame before by the odometry; where the scan does not agree with the map there, it keeps its estimate, and a
    /// tracked one gets the state `Searching`.
    ///
    /// # Errors
    /// The points do not fit the sensor, or the map cannot be rendered.
    pub fn add(
        &mut self,
        scan: &Scan,
        estimate: &InitialEstimate,
    ) -> Result<&FrameResult, RefinerError> {
        if self.frames.is_empty() {
            self.preparation.sensor.require_fit(scan)?;
        }
        let mut rng = stream(self.seed, (self.forgotten + self.frames.len()) as u64);
        let image = self.preparation.range_image(scan, estimate.motion.as_ref());
        let previous = self.frames.last();
        let mapped = self.mapped_ground_of(estimate)?;
        let known = estimate.tracked_in_space().map(|map_from_lidar| {
            let ground = mapped.unwrap_or_else(|| self.assumed_ground(&map_from_lidar));
            (ground, ground.attitude_of(&map_from_lidar))
        });
        let level_before_m = previous
            .filter(|_| estimate.state != State::Lost)
            .and_then(|previous| previous.level_m);
        let mut frame = FrameResult {
            pose: estimate.pose,
            map_from_lidar: None,
            covariance: estimate.covariance(),
            state: estimate.state,
            change: None,
            attitude: known.map_or_else(|| self.initial_attitude(&image), |(_, attitude)| attitude),
            ground: known.map(|(ground, _)| ground),
            level_m: mapped.map(|ground| ground.height_m).or(level_before_m),
        };
        let is_tracked = frame.is_tracked();
        if is_tracked && !self.config.refinement.is_wide(&frame.covariance) {
            self.refine(&image, &mut frame, Distance::InBasin, &mut rng)?;
        } else {
            let previous = previous.filter(|previous| previous.is_tracked());
            let predicted = (previous.zip(estimate.increment))
                .map(|(previous, increment)| previous.pose * increment);
            let corrected = self.correction.map(|correction| correction * estimate.pose);
            let near = (predicted.into_iter()).chain(corrected.filter(|_| is_tracked));
            // What the uncertainty says, then twice as far.
            let far = [1.0, 4.0].map(|factor| FrameResult {
                covariance: factor * frame.covariance,
                ground: None,
                level_m: None,
                ..frame.clone()
            });
            let far = far.into_iter().filter(|_| is_tracked);
            let starts = near.map(|pose| frame.near(pose)).chain(far);
            let placed = self.place(&image, starts, &mut rng)?;
            if let Some(placed) = &placed
                && is_tracked
            {
                self.correction = Some(placed.pose * estimate.pose.inverse());
            }
            let unplaced = FrameResult {
                state: if is_tracked {
                    State::Searching
                } else {
                    frame.state
                },
                ..frame
            };
            frame = placed.unwrap_or(unplaced);
        }
        self.frames.push(frame);
        Ok(&self.frames[self.frames.len() - 1])
    }

    /// Forgets the frames before the last one, which those that follow do not need: a drive that is refined frame by frame
    /// takes no more memory the longer it is.
    pub(crate) fn forget(&mut self) {
        let before = self.frames.len().saturating_sub(1);
        self.frames.drain(..before);
        self.forgotten += before;
    }

    /// Places frames before those that have poses in the map, from the last to the first, by the odometry into each
    /// frame, whose first entry is ignored; `read` reads the scan of a row.
    ///
    /// # Errors
    /// That of `read`, or as [`add`](Self::add).
    pub fn place_backwards<E: From<RefinerError>>(
        &mut self,
        starts: &[InitialEstimate],
        increments: &[Option<Pose2>],
        mut read: impl FnMut(usize) -> Result<Scan, E>,
    ) -> Result<(), E> {
        for row in (0..self.frames.len()).rev() {
            if self.is_before_tracked(row)
                && let Some(increment) = &increments[row + 1]
            {
                let scan = read(row)?;
                self.place_before(row, &scan, starts[row].motion.as_ref(), increment)?;
            }
        }
        Ok(())
    }

    /// Whether a frame has no pose in the map, and the one after it has.
    fn is_before_tracked(&self, row: usize) -> bool {
        let is_tracked = |row: usize| self.frames.get(row).map(FrameResult::is_tracked);
        is_tracked(row) == Some(false) && is_tracked(row + 1) == Some(true)
    }

    /// Places a frame before one that has a pose in the map, by the odometry `row_from_next`; where its scan does not
    /// agree with the map there, it stays as it is.
    fn place_before(
        &mut self,
        row: usize,
        scan: &Scan,
        motion: Option<&Motion>,
        row_from_next: &Pose2,
    ) -> Result<(), RefinerError> {
        let mut rng = stream(self.seed, row as u64);
        let image = self.preparation.range_image(scan, motion);
        let next = &self.frames[row + 1];
        let start = next.near(next.pose * row_from_next.inverse());
        if let Some(placed) = self.place(&image, [start], &mut rng)? {
            self.frames[row] = placed;
        }
        Ok(())
    }

    /// The mapped ground below the estimate of a tracked frame that is known in space; `None` for other frames and where the map has
    /// none.
    fn mapped_ground_of(
        &self,
        estimate: &InitialEstimate,
    ) -> Result<Option<GroundPatch>, RenderError> {
        let Some(map_from_lidar) = estimate.tracked_in_space() else {
            return Ok(None);
        };
        let place = map_from_lidar.translation;
        let levels = self.map.ground.levels_at(place.x, place.y)?;
        let below = levels.iter().rfind(|patch| patch.height_m < place.z);
        Ok(below.or(levels.first()).copied())
    }

    /// A level ground, as far below a pose as the ground of the frame before was.
    fn assumed_ground(&self, map_from_lidar: &Pose3) -> GroundPatch {
        let before = self.frames.last().map(|frame| frame.attitude);
        let attitude = before.unwrap_or_else(|| self.preparation.assumed_attitude());
        GroundPatch {
            height_m: map_from_lidar.translation.z - attitude.height_m,
            ..GroundPatch::default()
        }
    }

    /// Attitude of the sensor in the next frame. That of a registered frame is more accurate than the
    /// ground plane of a scan.
    fn initial_attitude(&self, image: &RangeImage) -> SensorAttitude {
        let previous = self.frames.last();
        previous
            .filter(|previous| previous.is_refined())
            .map(|previous| previous.attitude)
            .or_else(|| self.preparation.attitude(image))
            .or(previous.map(|previous| previous.attitude))
            .unwrap_or_else(|| self.preparation.assumed_attitude())
    }

    /// Refines a frame from each start until it agrees with the map.
    fn place(
        &self,
        image: &RangeImage,
        starts: impl IntoIterator<Item = FrameResult>,
        rng: &mut Generator,
    ) -> Result<Option<FrameResult>, RefinerError> {
        for mut start in starts {
            let compared = self.refine(image, &mut start, Distance::Near, rng)?;
            if compared.is_some_and(|compared| compared.agrees()) {
                return Ok(Some(start));
            }
        }
        Ok(None)
    }

    /// Refines a frame that is `distance` off, or farther if its covariance says so; the comparison with the map at the
    /// refined pose, or `None` where it cannot be refined.
    fn refine(
        &self,
        image: &RangeImage,
        frame: &mut FrameResult,
        distance: Distance<'_>,
        rng: &mut Generator,
    ) -> Result<Option<Comparison>, RefinerError> {
        let observation = &self.config.observation;
        let attitude = &frame.attitude;
        let returns = ClassifiedReturns::new(image, attitude);
        let mut choose = |count| returns.choose(count, observation.road_share, rng);
        let beams = choose(observation.beams);
        let registered = choose(self.config.refinement.registered_beams);
        let mut objective = FrameObjective {
            renderer: &*self.map.renderer,
            ground: &self.map.ground,
            beams: &beams,
            registered: &registered,
            level_m: frame.level_m,
            attitude: frame.attitude,
            // A swarm follows the mapped ground.
            known_ground: (frame.ground).filter(|_| self.config.refinement.method != Method::Swarm),
            difference: observation.difference(),
        };
        if frame.level_m.is_none() && frame.ground.is_none() {
            objective = objective.on_best_level(&frame.pose)?;
        }
        let config = &self.config.refinement;
        let (pose, covariance) = (&frame.pose, &frame.covariance);
        let surfaces = if config.is_wide(covariance) {
            Some(self.surfaces_near(pose)?)
        } else {
            None
        };
        let distance = surfaces.as_deref().map_or(distance, Distance::Far);
        let Some(refined) = refine_frame(&objective, pose, covariance, distance, config, rng)?
        else {
            return Ok(None);
        };
        let renderer = &*self.map.renderer;
        let before = Comparison::new(renderer, &refined.start_in_space, beams)?;
        let agreement_before = before.agreement();
        let after = Comparison::new(renderer, &refined.map_from_lidar, before.beams)?;
        frame.change = Some(FrameChange {
            cost_m: [refined.cost_before_m, refined.cost_after_m],
            agreement: [agreement_before, after.agreement()],
        });
        frame.pose = refined.pose;
        frame.map_from_lidar = Some(refined.map_from_lidar);
        frame.covariance = refined.covariance;
        frame.attitude = refined.attitude;
        // An assumed ground is at no level of the map.
        if frame.ground.is_none() || frame.level_m.is_some() {
            let level_m = refined.ground.map(|ground| ground.height_m);
            frame.level_m = level_m.or(frame.level_m);
        }
        frame.ground = refined.ground;
        Ok(Some(after))
    }

    /// Upright surfaces of the map, at least as far from a pose as a wide search looks.
    fn surfaces_near(&self, pose: &Pose2) -> Result<Arc<UprightSurfaces>, RefinerError> {
        /// The surfaces are those around the middle of a square of this edge, and serve all poses in it [m].
        const SQUARE_M: f64 = 50.0;
        let square = (pose.translation.vector / SQUARE_M).map(|along| along.floor() as i64);
        let mut last = self.surfaces.borrow_mut();
        if let Some(last) = &*last
            && last.square == square
        {
            return Ok(last.surfaces.clone());
        }
        let config = &self.config.refinement;
        let middle = square.map(|number| (number as f64 + 0.5) * SQUARE_M);
        let radius_m = SQUARE_M + config.wide_search.range_m + config.max_reach_m;
        let mesh = self
            .map
            .mesh_near(&[middle.into()], radius_m, DVec3::ZERO, u64::MAX)?;
        let surfaces = match &*last {
            // Of a map in memory there is one mesh only.
            Some(last) if last.mesh.upgrade().is_some() => last.surfaces.clone(),
            _ => Arc::new(UprightSurfaces::new(&mesh)),
        };
        *last = Some(NearbySurfaces {
            square,
            mesh: Arc::downgrade(&mesh),
            surfaces: surfaces.clone(),
        });
        Ok(surfaces)
    }

    /// Smooths the trajectory with the odometry `previous_from_current` into each frame (the first is
    /// ignored), or leaves every frame as its scan determines it where there is none.
    ///
    /// # Errors
    /// There are increments, but not one per frame, or the ground of the map cannot be read.
    pub fn finish(self, increments: Option<&[Pose2]>) -> Result<RefinedTrajectory, RefinerError> {
        let frames = &self.frames;
        let mut poses: Vec<Pose2> = frames.iter().map(|frame| frame.pose).collect();
        let mut covariances: Vec<_> = frames.iter().map(|frame| frame.covariance).collect();
        let is_measured = frames.iter().any(FrameResult::is_tracked);
        if let Some(increments) = increments.filter(|_| is_measured) {
            if increments.len() != frames.len() {
                return Err(RefinerError::IncrementCount {
                    frames: frames.len(),
                    increments: increments.len(),
                });
            }
            for rows in self.tracked_stretches(increments) {
                self.smooth_stretch(rows, increments, &mut poses, &mut covariances);
            }
        }
        let untracked = frames.iter().filter(|frame| !frame.is_tracked()).count();
        let refined = frames.iter().filter(|frame| frame.is_refined()).count();
        Ok(RefinedTrajectory {
            map_from_lidar: self.lift(&poses)?,
            poses,
            covariances,
            untracked,
            unmapped: frames.len() - untracked - refined,
            is_smoothed: increments.is_some() && is_measured,
            states: frames.iter().map(|frame| frame.state).collect(),
            changes: frames.iter().map(|frame| frame.change).collect(),
        })
    }

    /// The stretches, of which a frame is measured, between frames in which tracking was lost, and between neighbours
    /// whose poses the odometry contradicts.
    fn tracked_stretches(&self, increments: &[Pose2]) -> Vec<Range<usize>> {
        /// What is no error of an odometry: share of the way, distance [m] and turn [rad].
        const SHARE: f64 = 0.2;
        const DISTANCE_M: f64 = 1.0;
        const TURN_RAD: f64 = 0.2;
        let frames = &self.frames;
        let contradicts = |row: usize| {
            let (a, b) = (&frames[row - 1], &frames[row]);
            let moved = a.pose.inverse() * b.pose;
            let off = increments[row].inverse() * moved;
            let limit_m = DISTANCE_M + SHARE * moved.translation.vector.norm();
            (a.is_tracked() && b.is_tracked())
                && (off.translation.vector.norm() > limit_m
                    || off.rotation.angle().abs() > TURN_RAD)
        };
        let is_lost = |row: usize| frames[row].state == State::Lost;
        let rows: Vec<usize> = (0..frames.len()).collect();
        rows.chunk_by(|&a, &b| is_lost(a) == is_lost(b) && !contradicts(b))
            .map(|stretch| stretch[0]..stretch[0] + stretch.len())
            .filter(|rows| {
                !is_lost(rows.start) && frames[rows.clone()].iter().any(FrameResult::is_tracked)
            })
            .collect()
    }

    fn smooth_stretch(
        &self,
        rows: Range<usize>,
        increments: &[Pose2],
        poses: &mut [Pose2],
        covariances: &mut [Matrix3<f64>],
    ) {
        let config = &self.config.refinement;
        let frames = &self.frames[rows.clone()];
        let of_map = config.gauss_newton.of_map();
        let prior = |frame: &FrameResult| frame.prior(&of_map);
        let priors: Vec<Option<FramePrior>> = frames.iter().map(prior).collect();
        let increments = &increments[rows.clone()];
        let smoothed = smooth(&poses[rows.clone()], &priors, increments, &config.smoothing);
        let marginals = smoothing::covariances(&smoothed, &priors, increments, &config.smoothing);
        if let Some(mut marginals) = marginals {
            // Smoothing cannot reduce the error that the map has in all frames.
            marginals
                .iter_mut()
                .for_each(|covariance| *covariance += of_map);
            covariances[rows.clone()].copy_from_slice(&marginals);
        }
        poses[rows].copy_from_slice(&smoothed);
    }

    /// The poses in space, above the ground of their frames, else above that of the map, or the last known ground.
    fn lift(&self, poses: &[Pose2]) -> Result<Vec<Pose3>, RenderError> {
        let mut patch = None;
        let lift = |(pose, frame): (&Pose2, &FrameResult)| {
            let shift = pose.translation.vector - frame.pose.translation.vector;
            let found = match &frame.ground {
                Some(ground) if frame.is_refined() => Some(ground.shifted(&shift)),
                _ => self.map.ground.patch_under(pose, frame.level_m)?,
            };
            patch = found.or(patch);
            Ok(match &patch {
                Some(patch) => patch.lift(pose, &frame.attitude),
                None => pose3_from_pose2(pose, 0.0),
            })
        };
        poses.iter().zip(&self.frames).map(lift).collect()
    }
}

impl FrameResult {
    /// The same frame at a pose that the odometry predicts.
    fn near(&self, pose: Pose2) -> Self {
        Self {
            pose,
            covariance: Matrix3::zeros(),
            state: State::Tracking,
            ground: None,
            ..self.clone()
        }
    }

    fn is_tracked(&self) -> bool {
        self.state == State::Tracking
    }

    /// Measured pose for smoothing, without the error that the map has in all frames where the covariance contains it.
    fn prior(&self, of_map: &Matrix3<f64>) -> Option<FramePrior> {
        let own = self.is_refined().then_some(self.covariance - of_map);
        let own = own.filter(|own| own.cholesky().is_some());
        self.is_tracked().then_some(FramePrior {
            pose: self.pose,
            covariance: own.unwrap_or(self.covariance),
        })
    }

    fn is_refined(&self) -> bool {
        self.map_from_lidar.is_some()
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::geometry::pose2_from_pose3;
    use crate::lidar::LidarModel;
    use crate::map::world_for_tests::TestWorld;
    use crate::map::{GroundMap, MapCache, MapOptions, MappingPath};
    use crate::rendering::Backend;

    fn sensor() -> Sensor {
        Sensor::new(LidarModel::default())
    }

    /// A frame that was refined where the estimate was tracked.
    fn refined_frame(pose: Pose2, covariance: Matrix3<f64>, state: State) -> FrameResult {
        let in_space = pose3_from_pose2(&pose, 0.0);
        FrameResult {
            pose,
            map_from_lidar: (state == State::Tracking).then_some(in_space),
            covariance,
            state,
            change: None,
            attitude: SensorAttitude::default(),
            ground: None,
            level_m: None,
        }
    }

    #[test]
    fn a_jump_where_tracking_was_lost_does_not_affect_its_neighbors() {
        let map = TestWorld::street().map();
        let mut refiner =
            TrajectoryRefiner::new(&map, &sensor(), RefinerConfig::default(), 0).unwrap();
        for row in 0..20 {
            let is_lost = row == 10;
            let jump_m = if row > 10 { 50.0 } else { 0.0 };
            let pose = Pose2::translation(f64::from(row) + jump_m, 0.0);
            let covariance = Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 1e-6));
            let state = if is_lost {
                State::Lost
            } else {
                State::Tracking
            };
            refiner.frames.push(refined_frame(pose, covariance, state));
        }
        let before: Vec<Pose2> = refiner.frames.iter().map(|frame| frame.pose).collect();
        let increments = vec![Pose2::translation(1.0, 0.0); 20];
        let refined = refiner.finish(Some(&increments)).unwrap();
        assert!(refined.is_smoothed);
        assert_eq!((refined.untracked, refined.unmapped), (1, 0));
        for (before, after) in before.iter().zip(&refined.poses) {
            let off_m = (after.translation.vector - before.translation.vector).norm();
            assert!(off_m < 1e-6, "{off_m}");
        }
    }

    #[test]
    fn a_rough_trajectory_is_deskewed_by_all_of_its_odometry() {
        let step = Pose2::new(Vector2::new(1.0, 0.1), 0.05);
        let poses = [0.0, 1.0, 2.5, 4.0].map(|x| Pose2::translation(x, 0.0));
        // The first increment leads to no frame.
        let elsewhere = Pose2::translation(9.0, 9.0);
        let increments = [elsewhere, step, step, step * step].map(Some);
        let path = [
            Pose2::identity(),
            step,
            step * step,
            step * step * step * step,
        ];
        let path = path.map(|pose| pose3_from_pose2(&pose, 0.0));
        let driven = InitialEstimate::driven(&increments).unwrap();
        assert_eq!(driven.len(), path.len());
        for (driven, expected) in driven.iter().zip(&path) {
            assert_relative_eq!(driven, expected, epsilon = 1e-12);
        }
        assert_eq!(InitialEstimate::driven(&[]), Some(vec![]));
        let times_s = [0.0, 0.1, 0.2, 0.4];
        let rough = |increments: &[Option<Pose2>], times_s: Option<&[f64]>| {
            InitialEstimate::from_rough(&poses, [0.5, 0.25], increments, times_s)
        };
        let found = rough(&increments, Some(&times_s));
        assert_eq!(found.len(), poses.len());
        for (row, found) in found.into_iter().enumerate() {
            let covariance = Matrix3::from_diagonal(&Vector3::new(0.25, 0.25, 0.0625));
            let expected = InitialEstimate {
                pose: poses[row],
                map_from_lidar: None,
                covariance: Some(covariance),
                state: State::Tracking,
                motion: Motion::along(&driven, &times_s, row),
                increment: increments[row].filter(|_| row > 0),
            };
            assert!(expected.motion.is_some());
            assert_eq!(found, expected);
        }
        let missing = [Some(elsewhere), Some(step), None, Some(step)];
        assert_eq!(InitialEstimate::driven(&missing), None);
        for found in [rough(&missing, Some(&times_s)), rough(&increments, None)] {
            assert!(found.iter().all(|estimate| estimate.motion.is_none()));
            assert_eq!(found[1].increment, Some(step));
        }
    }

    #[test]
    fn scans_of_a_filter_are_deskewed_by_the_estimates_if_those_around_them_were_tracked() {
        let step = Pose2::new(Vector2::new(1.0, 0.1), 0.05);
        let poses: Vec<Pose2> = (0..7)
            .map(|row| Pose2::translation(1.2 * f64::from(row), 0.0))
            .collect();
        let states = [0, 0, 1, 0, 0, 0, 0].map(|it| [State::Tracking, State::Searching][it]);
        let times_s: Vec<f64> = (0..7).map(|row| 0.1 * f64::from(row)).collect();
        let increments = [Some(step); 7];
        let covariances: Vec<Matrix3<f64>> = (1..8)
            .map(|row| Matrix3::identity() * f64::from(row))
            .collect();
        let driven = InitialEstimate::driven(&increments).unwrap();
        let estimated: Vec<Pose3> = (poses.iter())
            .map(|pose| pose3_from_pose2(pose, 0.0))
            .collect();
        let (given, times) = (Some(&covariances[..]), Some(&times_s[..]));
        let found = InitialEstimate::from_filter(&poses, None, given, &states, &increments, times);
        assert_eq!(found.len(), poses.len());
        for (row, found) in found.into_iter().enumerate() {
            let is_known = row > 3;
            let path = if is_known { &estimated } else { &driven };
            let expected = InitialEstimate {
                pose: poses[row],
                map_from_lidar: None,
                covariance: Some(covariances[row]),
                state: states[row],
                motion: Motion::along(path, &times_s, row),
                increment: (row > 0).then_some(step),
            };
            assert_eq!(found, expected, "{row}");
        }
        // Tilted, and rolling on the way.
        let roll = |row: usize| UnitQuaternion::from_euler_angles(0.01 * row as f64, 0.2, 0.0);
        let in_space = poses
            .iter()
            .enumerate()
            .map(|(row, pose)| pose3_from_pose2(pose, 1.7) * UnitQuaternion::from(roll(row)));
        let in_space: Vec<Pose3> = in_space.collect();
        let found = InitialEstimate::from_filter(
            &poses,
            Some(&in_space),
            given,
            &states,
            &increments,
            times,
        );
        for (row, found) in found.iter().enumerate() {
            assert_eq!(found.map_from_lidar, Some(in_space[row]));
            let path = if row > 3 { &in_space } else { &driven };
            assert_eq!(found.motion, Motion::along(path, &times_s, row), "{row}");
        }
    }

    #[test]
    fn upright_surfaces_are_those_of_the_one_mesh_of_a_map_in_memory() {
        let map = TestWorld::street().map();
        let refiner = TrajectoryRefiner::new(&map, &sensor(), RefinerConfig::default(), 0).unwrap();
        let near = |x: f64| refiner.surfaces_near(&Pose2::translation(x, 0.0)).unwrap();
        let (first, same, other) = (near(10.0), near(40.0), near(60.0));
        assert!(Arc::ptr_eq(&first, &same) && Arc::ptr_eq(&first, &other));
    }

    #[test]
    fn upright_surfaces_of_a_map_on_disk_are_those_as_far_as_a_search_looks() {
        // A road of 600 m with the end of a wall next to it every 10 m.
        let mut mesh = TriangleMesh::default();
        let mut quad = |corners: [[f32; 3]; 4], color: [u8; 3]| {
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend(corners.map(glam::Vec3::from));
            mesh.colors.extend([color; 4]);
            for [b, c] in [[1, 2], [2, 3]] {
                mesh.triangles.push([first, first + b, first + c]);
            }
        };
        let wall_x = |number: u8| 10.0 * f32::from(number) + 5.0;
        for x in (0..60).map(wall_x) {
            let road = [[-5.0, -9.0], [5.0, -9.0], [5.0, 9.0], [-5.0, 9.0]];
            quad(road.map(|[dx, y]| [x + dx, y, 0.0]), [255, 0, 0]);
            let wall = [[6.0, 0.0], [8.0, 0.0], [8.0, 4.0], [6.0, 4.0]];
            quad(wall.map(|[y, z]| [x, y, z]), [0, 0, 255]);
        }
        let path = MappingPath {
            map_from_lidar: (0..600)
                .map(|x| Pose3::translation(f64::from(x), 0.0, 1.7))
                .collect(),
            ..MappingPath::default()
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("map.ply");
        let options = MapOptions {
            backend: Backend::Cpu,
            cache: MapCache::NextToMap,
            ..MapOptions::default()
        };
        Map::new(mesh, path, &options).unwrap().save(&file).unwrap();
        let map = Map::load(&file, &options).unwrap();
        let config = RefinerConfig::default();
        let reach_m = config.refinement.wide_search.range_m + config.refinement.max_reach_m;
        let refiner = TrajectoryRefiner::new(&map, &sensor(), config, 0).unwrap();
        let level = GroundPatch {
            height_m: 0.0,
            normal: Vector3::z(),
        };
        // Back and forth, twice to the same square.
        for pose_m in [30.0, 330.0, 345.0, 30.0] {
            let surfaces = refiner
                .surfaces_near(&Pose2::translation(pose_m, 0.0))
                .unwrap();
            for x in (0..60).map(wall_x).map(f64::from) {
                let field = surfaces.distances(Vector2::new(x, 7.0), &level, 2.0, 1.5);
                let off_m = (x - pose_m).abs();
                if off_m < reach_m {
                    assert!(field.at(x, 7.0) < 0.5, "{pose_m} {x}");
                }
                // Beyond tiles of 100 m that the search reaches no surface is in memory.
                if off_m > 300.0 {
                    assert_eq!(field.at(x, 7.0), 1.5, "{pose_m} {x}");
                }
            }
        }
    }

    #[test]
    fn a_frame_begins_at_the_height_and_attitude_of_its_estimate_not_of_the_frame_before() {
        let world = TestWorld::street();
        let held = |x: f64, attitude: SensorAttitude| {
            let lifted = world.ground.lift(&world.pose_at(x, 0.0, 0.0), &attitude);
            lifted.unwrap().unwrap()
        };
        let tilted = SensorAttitude {
            height_m: 1.2,
            roll_rad: 0.3,
            pitch_rad: -0.25,
        };
        let truth = [
            held(10.0, SensorAttitude::default()),
            held(11.0, tilted),
            held(12.0, SensorAttitude::default()),
        ];
        let agreements = |is_known: bool| {
            let mut refiner =
                TrajectoryRefiner::new(&world.map(), &sensor(), RefinerConfig::default(), 0)
                    .unwrap();
            truth.map(|pose| {
                let scan = Scan {
                    points: world.scan_in_space(&pose).points,
                    ..Scan::default()
                };
                let estimate = InitialEstimate {
                    map_from_lidar: is_known.then_some(pose),
                    ..InitialEstimate::tracked(pose2_from_pose3(&pose))
                };
                let frame = refiner.add(&scan, &estimate).unwrap();
                frame.change.and_then(|change| change.agreement[0])
            })
        };
        let found = agreements(true).map(Option::unwrap);
        assert!(found.iter().all(|&share| share > 0.95), "{found:?}");
        let found = agreements(false).map(Option::unwrap);
        assert!(found[1] < 0.8, "{found:?}");
    }

    #[test]
    fn a_trajectory_over_a_step_of_the_ground_keeps_its_height_also_where_none_is_mapped() {
        let (mut world, truth) = TestWorld::carried_over_a_step();
        for has_ground in [true, false] {
            if !has_ground {
                world.ground = GroundMap::from_mesh(&TriangleMesh::default(), |_| true, 0.25);
            }
            let (map, config) = (world.map(), RefinerConfig::default());
            let mut refiner = TrajectoryRefiner::new(&map, &sensor(), config, 0).unwrap();
            for pose in &truth {
                let scan = Scan {
                    points: world.scan_in_space(pose).points,
                    ..Scan::default()
                };
                let off = Pose3::translation(0.01, -0.01, 0.01) * pose;
                let estimate = InitialEstimate {
                    map_from_lidar: Some(off),
                    covariance: Some(Matrix3::identity() * 1e-4),
                    ..InitialEstimate::tracked(pose2_from_pose3(&off))
                };
                refiner.add(&scan, &estimate).unwrap();
            }
            let refined = refiner.finish(None).unwrap();
            assert_eq!((refined.untracked, refined.unmapped), (0, 0));
            for (found, truth) in refined.map_from_lidar.iter().zip(&truth) {
                let off_m = (found.translation.vector - truth.translation.vector).norm();
                assert!(off_m < 0.005, "{off_m}");
            }
        }
    }

    #[test]
    fn the_ground_of_a_sensor_is_the_highest_level_below_it() {
        let mut mesh = TriangleMesh::default();
        for height_m in [0.0, 6.0] {
            let corners = [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)];
            mesh.append(&TriangleMesh {
                vertices: corners.map(|(x, y)| glam::Vec3::new(x, y, height_m)).into(),
                triangles: vec![[0, 1, 2], [0, 2, 3]],
                colors: vec![[255, 0, 0]; 4],
                ..TriangleMesh::default()
            });
        }
        let at = |z: f64| Pose3::translation(1.0, 2.0, z);
        let path = MappingPath {
            map_from_lidar: vec![at(1.0)],
            ..MappingPath::default()
        };
        let map = Map::new(mesh, path, &MapOptions::default()).unwrap();
        let refiner = TrajectoryRefiner::new(&map, &sensor(), RefinerConfig::default(), 0).unwrap();
        for (z, expected_m) in [(-0.5, 0.0), (0.5, 0.0), (5.5, 0.0), (6.5, 6.0), (9.0, 6.0)] {
            let estimate = InitialEstimate {
                map_from_lidar: Some(at(z)),
                ..InitialEstimate::tracked(pose2_from_pose3(&at(z)))
            };
            let ground = |estimate: &InitialEstimate| refiner.mapped_ground_of(estimate).unwrap();
            let found = ground(&estimate).unwrap();
            assert_relative_eq!(found.height_m, expected_m, epsilon = 1e-6);
            // Where the filter is not sure of its pose, its height is not used either.
            let state = State::Searching;
            assert!(ground(&InitialEstimate { state, ..estimate }).is_none());
        }
    }

    #[test]
    fn a_frame_has_the_covariance_of_its_refinement() {
        let world = TestWorld::street();
        let truth = world.pose_at(10.0, 0.0, 0.0);
        let points = world.scan(&truth).points;
        let scan = Scan {
            points,
            ..Scan::default()
        };
        let given = Matrix3::from_diagonal(&Vector3::new(0.01, 0.02, 1e-4));
        let covariance = |method: Method| {
            let mut config = RefinerConfig::default();
            config.refinement.method = method;
            let mut refiner = TrajectoryRefiner::new(&world.map(), &sensor(), config, 0).unwrap();
            let estimate = InitialEstimate {
                covariance: Some(given),
                ..InitialEstimate::tracked(truth)
            };
            refiner.add(&scan, &estimate).unwrap().covariance
        };
        // A refinement without a step keeps that of the estimate; the map is exact to centimetres.
        assert_eq!(covariance(Method::None), given);
        let registered = covariance(Method::GaussNewton);
        assert!(registered.trace() < 0.1 * given.trace(), "{registered}");
    }

    #[test]
    fn stretches_end_where_tracking_is_lost_and_where_the_odometry_contradicts_tracked_poses() {
        use State::{Lost, Searching, Tracking};
        let map = TestWorld::street().map();
        let stretches = |frames: &[(f64, State)], increment: Pose2| {
            let mut refiner =
                TrajectoryRefiner::new(&map, &sensor(), RefinerConfig::default(), 0).unwrap();
            for &(x, state) in frames {
                let pose = Pose2::translation(x, 0.0);
                refiner
                    .frames
                    .push(refined_frame(pose, Matrix3::identity(), state));
            }
            refiner.tracked_stretches(&vec![increment; frames.len()])
        };
        let metre = Pose2::translation(1.0, 0.0);
        let drive = |states: &[State]| {
            let frames: Vec<_> = (states.iter().enumerate())
                .map(|(row, &state)| (row as f64, state))
                .collect();
            stretches(&frames, metre)
        };
        assert_eq!(drive(&[Tracking; 5]), std::slice::from_ref(&(0..5)));
        let lost = [Tracking, Tracking, Lost, Lost, Tracking, Searching];
        assert_eq!(drive(&lost), [0..2, 4..6]);
        // Stretches without a measured frame are not smoothed.
        let found = drive(&[Searching, Searching, Lost, Tracking]);
        assert_eq!(found, std::slice::from_ref(&(3..4)));
        assert!(drive(&[Lost, Lost]).is_empty());
        // A metre and a fifth of the way is no contradiction: 1.4 m of 2.4 m, but not 1.6 m of 2.6 m, either way.
        let step = |way_m: f64, increment: Pose2, state: State| {
            let frames = [(0.0, Tracking), (way_m, state)];
            stretches(&frames, increment).len()
        };
        for (way_m, expected) in [(2.4, 1), (2.6, 2), (-0.2, 2), (-0.1, 2), (0.1, 1)] {
            assert_eq!(step(way_m, metre, Tracking), expected, "{way_m}");
            assert_eq!(step(way_m, metre, Searching), 1);
        }
        for (turn_rad, expected) in [(0.19, 1), (0.21, 2), (-0.19, 1), (-0.21, 2)] {
            assert_eq!(step(0.0, Pose2::rotation(turn_rad), Tracking), expected);
        }
    }

    #[test]
    fn smoothing_does_not_reduce_the_error_that_the_map_has_in_all_frames() {
        let map = TestWorld::street().map();
        let covariances = |map_error_m: f64| {
            let mut config = RefinerConfig::default();
            config.refinement.gauss_newton.map_error_m = map_error_m;
            let of_map = config.refinement.gauss_newton.of_map();
            let own = Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 1e-6));
            let mut refiner = TrajectoryRefiner::new(&map, &sensor(), config, 0).unwrap();
            for row in 0..20 {
                let pose = Pose2::translation(f64::from(row), 0.0);
                refiner
                    .frames
                    .push(refined_frame(pose, own + of_map, State::Tracking));
            }
            let increments = vec![Pose2::translation(1.0, 0.0); 20];
            refiner.finish(Some(&increments)).unwrap().covariances
        };
        let [small, large] = [0.01, 0.03].map(covariances);
        let expected = Matrix3::from_diagonal(&Vector3::new(8e-4, 8e-4, 8e-4 / 900.0));
        for (small, large) in small.iter().zip(&large) {
            assert_relative_eq!(large - small, expected, epsilon = 1e-12);
        }
    }

    #[test]
    fn frames_that_were_not_tracked_are_placed_from_their_neighbours_or_stay() {
        let world = TestWorld::street();
        // Steps of different lengths.
        let truth = [10.0, 13.0, 15.5, 16.5, 17.0, 19.0].map(|x| world.pose_at(x, 0.0, 0.0));
        let increments: Vec<Pose2> = (0..6_usize)
            .map(|row| truth[row.saturating_sub(1)].inverse() * truth[row])
            .collect();
        let scans: Vec<Scan> = (truth.iter())
            .map(|pose| Scan {
                points: world.scan(pose).points,
                ..Scan::default()
            })
            .collect();
        let wrong = Pose2::translation(8.0, 0.5);
        let places = |elsewhere: Option<usize>| {
            let mut refiner =
                TrajectoryRefiner::new(&world.map(), &sensor(), RefinerConfig::default(), 0)
                    .unwrap();
            let mut starts = Vec::new();
            // The filter knows its pose in frames 2 and 3 only.
            for row in 0..6 {
                let (pose, state) = match row {
                    2 | 3 => (truth[row], State::Tracking),
                    _ => (truth[row] * wrong, State::Searching),
                };
                let estimate = InitialEstimate {
                    state,
                    increment: (row > 0).then_some(increments[row]),
                    ..InitialEstimate::tracked(pose)
                };
                let seen = elsewhere
                    .filter(|&of| of == row)
                    .map_or(row, |_| (row + 4) % 6);
                refiner.add(&scans[seen], &estimate).unwrap();
                starts.push(estimate);
            }
            let back: Vec<Option<Pose2>> = increments.iter().copied().map(Some).collect();
            let read = |row: usize| Ok::<_, RefinerError>(scans[row].clone());
            refiner.place_backwards(&starts, &back, read).unwrap();
            refiner.finish(None).unwrap()
        };
        let off_m = |refined: &RefinedTrajectory, row: usize| {
            (refined.poses[row].translation.vector - truth[row].translation.vector).norm()
        };
        let refined = places(None);
        assert_eq!(refined.untracked, 0);
        for row in 0..6 {
            assert!(
                off_m(&refined, row) < 0.02,
                "{row}: {}",
                off_m(&refined, row)
            );
        }
        // A scan that was taken elsewhere does not agree with the map where the odometry leads.
        let refined = places(Some(5));
        assert_eq!(refined.untracked, 1);
        assert!(off_m(&refined, 4) < 0.02 && off_m(&refined, 5) > 5.0);
    }

    #[test]
    fn frames_that_are_forgotten_change_none_of_those_that_follow() {
        let world = TestWorld::street();
        let refine = |forgets: bool| {
            let mut refiner =
                TrajectoryRefiner::new(&world.map(), &sensor(), RefinerConfig::default(), 0)
                    .unwrap();
            let mut add = |row: u8| {
                if forgets {
                    refiner.forget();
                }
                let truth = world.pose_at(10.0 + f64::from(row), 0.0, 0.0);
                let scan = Scan {
                    points: world.scan(&truth).points,
                    ..Scan::default()
                };
                let estimate = InitialEstimate::tracked(truth * Pose2::translation(0.05, 0.05));
                refiner.add(&scan, &estimate).unwrap().clone()
            };
            let frames: Vec<FrameResult> = (0..4).map(&mut add).collect();
            (frames, refiner.frames.len())
        };
        let ((all, kept), (same, fewer)) = (refine(false), refine(true));
        assert_eq!((kept, fewer), (4, 2));
        assert_eq!(all, same);
    }

    #[test]
    fn an_uncertain_frame_whose_scan_fits_nowhere_is_no_longer_tracked_and_keeps_its_estimate() {
        let world = TestWorld::street();
        let mut config = RefinerConfig::default();
        config.refinement.max_reach_m = 0.4;
        config.refinement.wide_search.swarms = 1;
        let estimate = InitialEstimate {
            covariance: Some(Matrix3::from_diagonal(&Vector3::new(0.25, 0.25, 1e-4))),
            ..InitialEstimate::tracked(world.pose_at(10.0, 0.0, 0.0))
        };
        for (scan_from_m, state) in [(10.0, State::Tracking), (47.0, State::Searching)] {
            let points = world.scan(&world.pose_at(scan_from_m, 0.0, 0.0)).points;
            let scan = Scan {
                points,
                ..Scan::default()
            };
            let mut refiner =
                TrajectoryRefiner::new(&world.map(), &sensor(), config.clone(), 0).unwrap();
            let frame = refiner.add(&scan, &estimate).unwrap();
            assert_eq!(frame.state, state);
            assert!(state == State::Tracking || frame.pose == estimate.pose);
            let untracked = usize::from(state != State::Tracking);
            assert_eq!(refiner.finish(None).unwrap().untracked, untracked);
        }
    }

    #[test]
    fn an_odometry_that_contradicts_the_frames_does_not_bend_them() {
        let map = TestWorld::street().map();
        let mut refiner =
            TrajectoryRefiner::new(&map, &sensor(), RefinerConfig::default(), 0).unwrap();
        for row in 0..20 {
            let jump_m = if row > 10 { 50.0 } else { 0.0 };
            let pose = Pose2::translation(f64::from(row) + jump_m, 0.0);
            let covariance = Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 1e-6));
            refiner
                .frames
                .push(refined_frame(pose, covariance, State::Tracking));
        }
        let before: Vec<Pose2> = refiner.frames.iter().map(|frame| frame.pose).collect();
        let increments = vec![Pose2::translation(1.0, 0.0); 20];
        let refined = refiner.finish(Some(&increments)).unwrap();
        for (before, after) in before.iter().zip(&refined.poses) {
            let off_m = (after.translation.vector - before.translation.vector).norm();
            assert!(off_m < 1e-6, "{off_m}");
        }
    }

    #[test]
    fn a_wrong_number_of_increments_is_an_error() {
        let world = TestWorld::street();
        let mut refiner =
            TrajectoryRefiner::new(&world.map(), &sensor(), RefinerConfig::default(), 0).unwrap();
        let truth = world.pose_at(10.0, 0.0, 0.0);
        let points = world.scan(&truth).points;
        let scan = Scan {
            points,
            ..Scan::default()
        };
        let estimate = InitialEstimate::tracked(truth * Pose2::translation(0.05, 0.05));
        let refined = refiner.add(&scan, &estimate).unwrap();
        let off_m = (refined.pose.translation.vector - truth.translation.vector).norm();
        assert!(off_m < 0.01, "{off_m}");
        let error = refiner.finish(Some(&[])).unwrap_err();
        assert!(
            error
                .to_string()
                .contains("0 odometry increments for 1 frames"),
            "{error}"
        );
    }
}
