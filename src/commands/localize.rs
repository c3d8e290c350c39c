//! `localize`: where the car is in a map, scan by scan.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::interrupt::Interrupted;
use super::run_output::{self, Movie, RunFiles};
use super::stages::{LoadedMap, Observer};
use super::{Context, input, odometry, output, run_page};
use crate::config::{self, Initialization, LocalizationConfig, MotionModel};
use crate::evaluation::{LocalizationResults, ParticleLog, RangeMclRules, Report};
use crate::geometry::{Pose2, Pose3, planar};
use crate::ground::{FuzzyConfig, FuzzyGround};
use crate::kitti::{Frame, Sequence};
use crate::lidar::RangeImage;
use crate::localization::initialization::{Cells, ROAD_HALF_WIDTH_M, around};
use crate::localization::motion::VelocityCommand;
use crate::localization::odometry::Odometry;
use crate::localization::panorama::PanoramaIndex;
use crate::localization::{FrameEstimate, Localizer, ParticleSet, Surroundings};
use crate::map::Stance;

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
    output::prepare(&config.result_path, "result_path", config.force)?;
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
    let files = RunFiles::beside(&config.result_path);
    let increments = odometry::read_increments(
        config.odometry,
        config.odometry_file.as_deref(),
        &sequence,
        &mut stream(config.seed, ODOMETRY_STREAM),
    )?;
    let sequence = odometry::compensated(sequence, config.motion_compensation, &increments);
    let run = localize(config, context, &map, &sequence, &increments, &files)?;
    let (results, lifted, finished) = run;
    let about = about(config, context, &map);
    if config.save_result {
        run_output::write_results(&files, &results)?;
        run_output::write_trajectory(&files, "mcl", &sequence, &lifted)?;
        config::write(&files.file("localization.yml"), config)?;
    }
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
    if finished {
        Ok(report)
    } else {
        Err(Interrupted {
            kept: format!(
                "{} of {} frames are localized and kept in {}",
                results.len(),
                sequence.frames.len(),
                config.result_path.display()
            ),
        }
        .into())
    }
}

/// Runs the filter over the frames; whether it came to the end.
fn localize(
    config: &LocalizationConfig,
    context: &Context,
    map: &LoadedMap,
    sequence: &Sequence,
    increments: &[Option<Pose2>],
    files: &RunFiles,
) -> Result<(LocalizationResults, Vec<Pose3>, bool)> {
    let classifier = FuzzyGround::new(FuzzyConfig::default())?;
    let observer = Observer {
        model: config.range_image.model(),
        own_car_m: config.own_car_m,
        classifier: &classifier,
    };
    let mut recorder = Recorder::new(config, map, files);
    let mut localizer: Option<Localizer> = None;
    let panoramas = panoramas(config, map)?;
    let mut stance = Stance::default();
    let task = context.progress.task("localize", sequence.frames.len());
    for (row, frame) in sequence.frames.iter().enumerate() {
        if context.interrupt.requested() {
            break;
        }
        let points = observer.read(frame)?;
        let started = Instant::now();
        let image = observer.image(points);
        let known = localizer.as_ref().and_then(Localizer::stance);
        stance = known.or_else(|| observer.stance(&image)).unwrap_or(stance);
        let mut rng = stream(config.seed, FIRST_FRAME_STREAM + row as u64);
        if localizer.is_none() {
            let surroundings = Surroundings {
                renderer: &*map.renderer,
                ground: &map.ground,
                tiles: &map.grid,
                panoramas: panoramas.as_ref(),
            };
            let start = initial_particles(config, map, frame, &image, &stance, panoramas.as_ref())?;
            localizer = Some(Localizer::new(config.localizer(), surroundings, start));
        }
        let Some(localizer) = &mut localizer else {
            continue;
        };
        let moved = motion(config.motion_model, increments[row], sequence, row);
        let estimate = localizer.step(moved, &image, &stance, &mut rng)?;
        recorder.record(frame, increments[row], &estimate, started.elapsed())?;
        task.advance(1);
    }
    drop(task);
    let (results, lifted) = recorder.finish()?;
    if results.is_empty() {
        let kept = "no frame was finished".to_owned();
        return Err(Interrupted { kept }.into());
    }
    let finished = results.len() == sequence.frames.len();
    Ok((results, lifted, finished))
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
                ..LocalizationResults::default()
            },
            lifted: Vec::new(),
            movie: config.visualize.then(|| Movie::begin(files, &map.mesh)),
        }
    }

    fn record(
        &mut self,
        frame: &Frame,
        increment: Option<Pose2>,
        estimate: &FrameEstimate,
        runtime: Duration,
    ) -> Result<()> {
        fn push<T>(column: &mut Option<Vec<T>>, value: T) {
            if let Some(column) = column {
                column.push(value);
            }
        }
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
        self.lifted.push(estimate.lifted);
        if let Some(movie) = &mut self.movie {
            movie.add(results, estimate)?;
        }
        Ok(())
    }

    fn finish(self) -> Result<(LocalizationResults, Vec<Pose3>)> {
        if let Some(movie) = self.movie {
            movie.finish()?;
        }
        Ok((self.results, self.lifted))
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
