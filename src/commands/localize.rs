//! `localize`: where the car is in a map, scan by scan.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::interrupt::Interrupted;
use super::run_output::{self, Movie, RunFiles};
use super::stages::{LoadedMap, Observer};
use super::{Context, input, odometry, run_page};
use crate::config::{self, Initialization, LocalizationConfig, MotionModel};
use crate::evaluation::{LocalizationResults, ParticleLog, RangeMclRules, Report};
use crate::geometry::{Pose2, Pose3, planar};
use crate::ground::{FuzzyConfig, FuzzyGround};
use crate::kitti::{Frame, Sequence};
use crate::lidar::RangeImage;
use crate::localization::initialization::{Cells, ROAD_HALF_WIDTH_M, around};
use crate::localization::motion::VelocityCommand;
use crate::localization::observation::choose_beams;
use crate::localization::odometry::Odometry;
use crate::localization::panorama::PanoramaIndex;
use crate::localization::{FrameEstimate, Localizer, ParticleSet, State, Surroundings};
use crate::map::Stance;
use crate::refinement::{FrameObjective, RefinedFrame, refine_frame};

/// Which random stream belongs to what; the streams of frames follow.
const INITIALIZATION_STREAM: u64 = 0;
const ODOMETRY_STREAM: u64 = 1;
const FIRST_FRAME_STREAM: u64 = 2;

/// Localizes the frames that a configuration selects.
pub fn run(config: &LocalizationConfig, context: &Context) -> Result<Report> {
    input::require_file("map_file", &config.map_file)?;
    input::require_file("map_pose_file", &config.map_pose_file)?;
    input::require_file("map_calib_file", &config.map_calib_file)?;
    input::require_folder("scan_folder", &config.scan_folder)?;
    input::require_file("pose_file", &config.pose_file)?;
    input::require_file("calib_file", &config.calib_file)?;
    let files = RunFiles::beside(&config.result_path);
    if config.save_result {
        run_output::prepare(&files, "result_path", config.force)?;
    }
    let map = LoadedMap::load(
        &config.map_file,
        &config.map_pose_file,
        &config.map_calib_file,
        Some(config.range_image.batch_size()),
        context,
    )?;
    let sequence = map.sequence(
        &config.scan_folder,
        &config.pose_file,
        &config.calib_file,
        &config.selection(),
    )?;
    let increments = odometry::read_increments(
        config.odometry,
        config.odometry_file.as_deref(),
        &sequence,
        &mut stream(config.seed, ODOMETRY_STREAM),
    )?;
    let sequence = odometry::compensated(sequence, config.motion_compensation, &increments);
    let run = localize(config, context, &map, &sequence, &increments, &files)?;
    let Run {
        results,
        lifted,
        refined,
        movie,
        mut failure,
    } = run;
    let about = about(config, context, &map);
    if config.save_result {
        run_output::write_results(&files, &results)?;
        run_output::write_trajectory(&files, "mcl", &sequence, &lifted)?;
        if config.refine {
            run_output::write_trajectory(&files, "refined", &sequence, &refined)?;
        } else {
            run_output::remove_refined(&files)?;
        }
        config::write(&files.file("localization.yml"), config)?;
    }
    tell_of_doubt(&results);
    let report = run_output::judge(&results, &RangeMclRules::default(), about)?;
    if config.save_result {
        run_output::write_report(&files, &results, &report)?;
    }
    if config.plot_loc_results {
        run_output::draw_run(&files, Some(&map), &results)?;
        draw_example(config, &files, &map, &sequence, &lifted)?;
    }
    if config.save_result {
        run_page::write(&files, &report)?;
    }
    if let Some(movie) = movie
        && let Err(error) = movie.finish()
    {
        failure.get_or_insert(error);
    }
    let is_whole = results.len() == sequence.frames.len();
    if is_whole && failure.is_none() {
        return Ok(report);
    }
    let (found, all) = (results.len(), sequence.frames.len());
    let kept = if config.save_result {
        let path = config.result_path.display();
        format!("{found} of {all} frames are localized and kept in {path}")
    } else {
        format!("{found} of {all} frames were localized, and nothing is kept: save_result is False")
    };
    Err(match failure {
        Some(failure) => failure.context(kept),
        None => Interrupted { kept }.into(),
    })
}

/// What the filter made of the frames up to where it came.
struct Run {
    results: LocalizationResults,
    /// The estimates in space.
    lifted: Vec<Pose3>,
    /// The refined poses in space; none unless frames are refined.
    refined: Vec<Pose3>,
    /// Why it did not come to the end, unless that was wished.
    failure: Option<anyhow::Error>,
    /// The pictures of the frames, if they are wanted.
    movie: Option<Movie>,
}

/// Says where the filter was not sure.
fn tell_of_doubt(results: &LocalizationResults) {
    let states = results.states.as_deref().unwrap_or_default();
    let is_sure = |state: &u8| *state == State::Tracking as u8;
    match states.iter().position(is_sure) {
        None => tracing::warn!(
            "the filter was not sure of any of {} frames: the car is perhaps not in the map, or did not drive far enough to tell",
            states.len()
        ),
        Some(first) => {
            let doubtful = states[first..]
                .iter()
                .filter(|&state| !is_sure(state))
                .count();
            if doubtful > 0 {
                tracing::warn!(
                    "the filter lost its way in {doubtful} of {} frames; frames.csv has the state of each",
                    states.len()
                );
            }
        }
    }
}

/// Runs the filter over the frames, as far as it comes; an error only where no frame was finished.
fn localize(
    config: &LocalizationConfig,
    context: &Context,
    map: &LoadedMap,
    sequence: &Sequence,
    increments: &[Option<Pose2>],
    files: &RunFiles,
) -> Result<Run> {
    let classifier = FuzzyGround::new(FuzzyConfig::default())?;
    let observer = Observer {
        model: config.range_image.model(),
        own_car_m: config.own_car_m,
        classifier: &classifier,
    };
    let panoramas = panoramas(config, map)?;
    let mut recorder = Recorder::new(config, map, files);
    let mut drive = Drive {
        config,
        map,
        observer: &observer,
        panoramas: panoramas.as_ref(),
        localizer: None,
        stance: Stance::default(),
    };
    let mut failure = None;
    let task = context.progress.task("localize", sequence.frames.len());
    for (row, frame) in sequence.frames.iter().enumerate() {
        if context.interrupt.requested() {
            break;
        }
        let moved = motion(config.motion_model, increments[row], sequence, row);
        let said = drive
            .take_in(row, frame, moved)
            .and_then(|said| recorder.record(frame, increments[row], said));
        if let Err(error) = said {
            failure = Some(error);
            break;
        }
        task.advance(1);
    }
    drop(task);
    let run = recorder.finish(failure);
    match (run.results.is_empty(), run.failure) {
        (false, failure) => Ok(Run { failure, ..run }),
        (true, Some(failure)) => Err(failure),
        (true, None) => {
            let kept = "no frame was finished".to_owned();
            Err(Interrupted { kept }.into())
        }
    }
}

/// The filter on its way through the frames.
struct Drive<'a> {
    config: &'a LocalizationConfig,
    map: &'a LoadedMap,
    observer: &'a Observer<'a>,
    panoramas: Option<&'a PanoramaIndex>,
    localizer: Option<Localizer<'a>>,
    /// The last that was known.
    stance: Stance,
}

/// What is known of a frame in the end.
struct Said {
    estimate: FrameEstimate,
    runtime: Duration,
    /// With the time that it took.
    refined: Option<(RefinedFrame, Duration)>,
}

impl<'a> Drive<'a> {
    /// Localizes a frame and, where that is wanted, refines it.
    fn take_in(&mut self, row: usize, frame: &Frame, moved: Odometry) -> Result<Said> {
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
    panoramas: Option<&'a PanoramaIndex>,
) -> Result<Localizer<'a>> {
    let surroundings = Surroundings {
        renderer: &*map.renderer,
        ground: &map.ground,
        tiles: &map.grid,
        panoramas,
    };
    let start = initial_particles(config, map, first, scan, stance, panoramas)?;
    Ok(Localizer::new(config.localizer(), surroundings, start))
}

/// The motion into a frame, as the motion model wants it.
fn motion(
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

/// The panoramas of a global start; none where the start is known.
fn panoramas(config: &LocalizationConfig, map: &LoadedMap) -> Result<Option<PanoramaIndex>> {
    let panorama = config.panorama_config();
    let cells = match config.initialization() {
        Initialization::Tracking => return Ok(None),
        Initialization::Corridor => {
            let poses: Vec<Pose2> = map.mapping_poses.iter().map(planar).collect();
            Cells::along_road(&poses, ROAD_HALF_WIDTH_M, panorama.cell_m)
        }
        Initialization::Extent => Cells::over_map(&map.grid, &map.ground, panorama.cell_m),
    };
    let started = Instant::now();
    let surroundings = Surroundings {
        renderer: &*map.renderer,
        ground: &map.ground,
        tiles: &map.grid,
        panoramas: None,
    };
    let index = PanoramaIndex::build(
        &cells,
        &surroundings,
        &config.range_image.model(),
        Stance::default().height_m,
        &panorama,
    )?;
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
    let poses = match panoramas {
        None => around(
            &planar(&first.map_from_lidar),
            count,
            &config.start,
            &mut rng,
        ),
        Some(index) => index.sample(scan, stance, count, &mut rng),
    };
    anyhow::ensure!(
        poses
            .iter()
            .any(|pose| map.grid.valid_tile_of(pose).is_some()),
        "the start at frame {} lies outside the map {}; check that map_pose_file and pose_file are given in the same world",
        first.number,
        config.map_file.display()
    );
    Ok(ParticleSet::uniform(poses))
}

/// The generator of a stream: the same whatever happens in the others.
fn stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

/// Collects what the filter says.
struct Recorder {
    results: LocalizationResults,
    lifted: Vec<Pose3>,
    refined: Vec<Pose3>,
    movie: Option<Movie>,
}

impl Recorder {
    fn new(config: &LocalizationConfig, map: &LoadedMap, files: &RunFiles) -> Self {
        let empty = || Some(Vec::new());
        Self {
            results: LocalizationResults {
                particles: ParticleLog::new(config.num_particles),
                estimates: empty(),
                ground_truth: empty(),
                odometry: empty(),
                covariances: Some(Vec::new()),
                times_s: Some(Vec::new()),
                runtimes_s: Some(Vec::new()),
                states: Some(Vec::new()),
                refined: config.refine.then(Vec::new),
                refine_runtimes_s: config.refine.then(Vec::new),
                ..LocalizationResults::default()
            },
            lifted: Vec::new(),
            refined: Vec::new(),
            movie: config.visualize.then(|| Movie::begin(files, &map.mesh)),
        }
    }

    fn record(&mut self, frame: &Frame, increment: Option<Pose2>, said: Said) -> Result<()> {
        fn push<T>(column: &mut Option<Vec<T>>, value: T) {
            if let Some(column) = column {
                column.push(value);
            }
        }
        let Said {
            estimate,
            runtime,
            refined,
        } = &said;
        let results = &mut self.results;
        results.frames.push(frame.number);
        results
            .particles
            .push_frame(run_output::rows_of(&estimate.particles));
        push(&mut results.estimates, estimate.pose);
        push(&mut results.ground_truth, planar(&frame.map_from_lidar));
        push(
            &mut results.odometry,
            increment.unwrap_or_else(Pose2::identity),
        );
        push(&mut results.covariances, estimate.covariance);
        push(&mut results.times_s, frame.time_s);
        push(&mut results.runtimes_s, runtime.as_secs_f64());
        push(&mut results.states, estimate.state as u8);
        let (pose, lifted, seconds) = match refined {
            Some((refined, runtime)) => (refined.pose, refined.lifted, runtime.as_secs_f64()),
            None => (estimate.pose, estimate.lifted, 0.0),
        };
        push(&mut results.refined, pose);
        push(&mut results.refine_runtimes_s, seconds);
        self.refined.push(lifted);
        self.lifted.push(estimate.lifted);
        if let Some(movie) = &mut self.movie {
            movie.add(results, estimate)?;
        }
        Ok(())
    }

    fn finish(self, failure: Option<anyhow::Error>) -> Run {
        Run {
            results: self.results,
            lifted: self.lifted,
            refined: self.refined,
            failure,
            movie: self.movie,
        }
    }
}

/// What was run, for the report.
fn about(
    config: &LocalizationConfig,
    context: &Context,
    map: &LoadedMap,
) -> std::collections::BTreeMap<String, String> {
    let path = |path: &Path| path.display().to_string();
    [
        ("recording", path(&config.scan_folder)),
        ("map", path(&config.map_file)),
        (
            "odometry",
            odometry::description(config.odometry, config.odometry_file.as_deref()),
        ),
        ("renderer", map.renderer.name()),
        ("seed", config.seed.to_string()),
        ("threads", context.threads.to_string()),
        (
            "particles",
            format!("{} reduced to {}", config.num_particles, config.num_reduced),
        ),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}

/// Draws one frame's range image beside the map's from the estimate.
fn draw_example(
    config: &LocalizationConfig,
    files: &RunFiles,
    map: &LoadedMap,
    sequence: &Sequence,
    lifted: &[Pose3],
) -> Result<()> {
    let row = lifted.len() / 2;
    let model = config.range_image.model();
    let scan = sequence.frames[row].read()?;
    let observed = RangeImage::project(&scan.points, &model);
    let rendered = map.renderer.render(&lifted[row..=row], &model)?;
    let rendered = rendered.first().context("one pose gives one image")?;
    run_output::draw_range_images(files, &observed, rendered, sequence.frames[row].number)
}
