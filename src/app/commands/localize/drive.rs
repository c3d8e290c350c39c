//! The filter on its way through the frames.

use std::cell::OnceCell;
use std::time::{Duration, Instant};

use anyhow::Result;
use rand_chacha::ChaCha8Rng;

use super::{FIRST_FRAME_STREAM, INITIALIZATION_STREAM, stream};
use crate::app::commands::stages::{LoadedMap, Observer};
use crate::app::config::{Initialization, LocalizationConfig, MotionModel};
use crate::geometry::{Pose2, pose2_from_pose3};
use crate::lidar::RangeImage;
use crate::localization::initialization::{Cells, ROAD_HALF_WIDTH_M, around};
use crate::localization::motion::VelocityCommand;
use crate::localization::observation::choose_beams;
use crate::localization::odometry::Odometry;
use crate::localization::panorama::{PanoramaIndex, Panoramas};
use crate::localization::particles::Hypothesis;
use crate::localization::{FrameEstimate, Localizer, ParticleSet, State, Surroundings};
use crate::map::Stance;
use crate::recording::{Frame, Sequence};
use crate::refinement::{FrameObjective, RefinedFrame, refine_frame};

/// The filter on its way through the frames.
pub struct Drive<'a> {
    /// What is wanted.
    pub config: &'a LocalizationConfig,
    /// Where.
    pub map: &'a LoadedMap,
    /// Makes scans into observations.
    pub observer: &'a Observer<'a>,
    /// For a start anywhere.
    pub panoramas: &'a Panoramas<'a>,
    /// Rendered already, where the start is not known.
    pub global_start: Option<&'a PanoramaIndex>,
    /// None before the first frame.
    pub localizer: Option<Localizer<'a>>,
    /// The last that was known.
    pub stance: Stance,
}

/// What is known of a frame in the end.
pub struct Said {
    /// By the filter.
    pub estimate: FrameEstimate,
    /// Time that the filter took.
    pub runtime: Duration,
    /// With the time that it took.
    pub refined: Option<(RefinedFrame, Duration)>,
}

impl<'a> Drive<'a> {
    /// Localizes a frame and, where that is wanted, refines it.
    pub fn take_in(&mut self, row: usize, frame: &Frame, moved: Odometry) -> Result<Said> {
        let points = self.observer.read(frame)?;
        let started = Instant::now();
        let image = self.observer.image(points);
        let known = self.localizer.as_ref().and_then(Localizer::stance);
        self.stance = known
            .or_else(|| self.observer.stance(&image))
            .unwrap_or(self.stance);
        let mut rng = stream(self.config.seed, FIRST_FRAME_STREAM + row as u64);
        let stance = self.stance;
        let localizer = match &mut self.localizer {
            Some(localizer) => localizer,
            empty => {
                let begun = begin(
                    self.config,
                    self.map,
                    frame,
                    &image,
                    &stance,
                    self.panoramas,
                    self.global_start,
                )?;
                empty.insert(begun)
            }
        };
        let estimate = localizer.step(moved, &image, &stance, &mut rng)?;
        let runtime = started.elapsed();
        let stance = localizer.stance().unwrap_or(stance);
        let refined = self.refined(&image, &estimate, stance, &mut rng)?;
        let elapsed = started.elapsed() - runtime;
        Ok(Said {
            estimate,
            runtime,
            refined: refined.map(|refined| (refined, elapsed)),
        })
    }

    /// The frame refined, if it shall be and the filter knows where it is.
    fn refined(
        &self,
        image: &RangeImage,
        estimate: &FrameEstimate,
        stance: Stance,
        rng: &mut ChaCha8Rng,
    ) -> Result<Option<RefinedFrame>> {
        if !self.config.refine || estimate.state != State::Tracking {
            return Ok(None);
        }
        let observation = &self.config.observation;
        let (count, road_share) = (observation.beams, observation.road_share);
        let beams = choose_beams(image, count, road_share, &stance, rng);
        let objective = FrameObjective {
            renderer: &*self.map.renderer,
            ground: &self.map.ground,
            beams: &beams,
            level_m: estimate.level_m,
            stance,
            difference: observation.difference(),
        };
        let (pose, covariance) = (&estimate.pose, &estimate.covariance);
        let refined = refine_frame(&objective, pose, covariance, &self.config.refinement, rng)?;
        Ok(refined)
    }
}

/// The filter with its first belief.
fn begin<'a>(
    config: &LocalizationConfig,
    map: &'a LoadedMap,
    first: &Frame,
    scan: &RangeImage,
    stance: &Stance,
    panoramas: &'a Panoramas<'a>,
    global_start: Option<&PanoramaIndex>,
) -> Result<Localizer<'a>> {
    let surroundings = Surroundings {
        renderer: &*map.renderer,
        ground: &map.ground,
        tiles: &map.grid,
        panoramas: Some(panoramas),
    };
    let start = initial_particles(config, map, first, scan, stance, global_start)?;
    Ok(Localizer::new(config.localizer(), surroundings, start))
}

/// The motion into a frame, as the motion model wants it.
pub fn motion(
    model: MotionModel,
    increment: Option<Pose2>,
    sequence: &Sequence,
    row: usize,
) -> Odometry {
    let Some(increment) = increment else {
        return Odometry::Unknown;
    };
    match model {
        MotionModel::TurnDriveTurn => Odometry::Increment(increment),
        MotionModel::Velocity => {
            let frames = &sequence.frames;
            let before_s = frames[row.saturating_sub(1)].time_s;
            let seconds = (frames[row].time_s - before_s).max(0.0);
            let duration = Duration::from_secs_f64(seconds);
            Odometry::Velocity(VelocityCommand::driving(&increment, duration))
        }
    }
}

/// The places where a scan may have been taken: to begin at, or to begin anew at when lost.
pub fn panoramas<'a>(config: &LocalizationConfig, map: &'a LoadedMap) -> Panoramas<'a> {
    let panorama = config.panorama_config();
    let cells = match config.initialization() {
        Initialization::Tracking | Initialization::Corridor => {
            let poses: Vec<Pose2> = map.mapping_poses.iter().map(pose2_from_pose3).collect();
            Cells::along_road(&poses, ROAD_HALF_WIDTH_M, panorama.cell_m)
        }
        Initialization::Extent => Cells::over_map(&map.grid, &map.ground, panorama.cell_m),
    };
    Panoramas {
        cells,
        surroundings: Surroundings {
            renderer: &*map.renderer,
            ground: &map.ground,
            tiles: &map.grid,
            panoramas: None,
        },
        lidar: config.range_image.model(),
        height_m: Stance::default().height_m,
        config: panorama,
        index: OnceCell::new(),
    }
}

/// The panoramas of a global start, rendered; none where the start is known.
pub fn global_start<'a>(
    config: &LocalizationConfig,
    panoramas: &'a Panoramas<'_>,
) -> Result<Option<&'a PanoramaIndex>> {
    if config.initialization() == Initialization::Tracking {
        return Ok(None);
    }
    let started = Instant::now();
    let index = panoramas.index()?;
    tracing::info!(
        "{} panoramas, {:.1} MB, rendered in {:.1} s",
        index.len(),
        index.size_bytes() as f64 / 1e6,
        started.elapsed().as_secs_f64()
    );
    anyhow::ensure!(
        !index.is_empty(),
        "no place of the map is fit for a start: it has no ground in {}; check map_pose_file, or build the map again",
        config.map_file.display()
    );
    Ok(Some(index))
}

fn initial_particles(
    config: &LocalizationConfig,
    map: &LoadedMap,
    first: &Frame,
    scan: &RangeImage,
    stance: &Stance,
    panoramas: Option<&PanoramaIndex>,
) -> Result<ParticleSet> {
    let mut rng = stream(config.seed, INITIALIZATION_STREAM);
    let count = config.num_particles;
    let hypotheses = match panoramas {
        None => {
            // The start is known in space, and with it the level of the road.
            let level_m = Some(first.map_from_lidar.translation.z - stance.height_m);
            let start = pose2_from_pose3(&first.map_from_lidar);
            let poses = around(&start, count, &config.start, &mut rng).into_iter();
            poses
                .map(|map_from_lidar| Hypothesis {
                    map_from_lidar,
                    level_m,
                })
                .collect()
        }
        Some(index) => index.sample(scan, stance, count, &mut rng),
    };
    anyhow::ensure!(
        hypotheses
            .iter()
            .any(|start| map.grid.valid_tile_of(&start.map_from_lidar).is_some()),
        "the start at frame {} lies outside the map {}; check that map_pose_file and pose_file are given in the same world",
        first.number,
        config.map_file.display()
    );
    Ok(ParticleSet::uniform(hypotheses))
}
