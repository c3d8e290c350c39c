//! `refine`: the trajectory of `localize` polished frame by frame, then smoothed as a whole.

use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use nalgebra::{Matrix3, Vector3};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::interrupt::Interrupted;
use super::run_output::{self, RunFiles};
use super::stages::{Inputs, LoadedMap, Observer, mapping_file};
use super::{Context, input, odometry, run_page};
use crate::app::config::{self, OdometrySource, RefinementConfig};
use crate::app::results::{LocalizationResults, Report};
use crate::evaluation::RangeMclRules;
use crate::geometry::{Pose2, Pose3};
use crate::ground::{FuzzyConfig, FuzzyGround};
use crate::localization::State;
use crate::localization::observation::choose_beams;
use crate::localization::odometry::demonstration_noise;
use crate::map::Stance;
use crate::recording::{Frame, Sequence};
use crate::refinement::smoothing::{self, FramePrior, SmoothingConfig, smooth};
use crate::refinement::{FrameObjective, refine_frame};

/// Refines the result that a configuration names, and adds the refined trajectory to it.
pub fn run(config: &RefinementConfig, context: &Context) -> Result<Report> {
    input::require_file("result_file", &config.result_file)?;
    let inputs = Inputs {
        map_file: &config.map_file,
        map_pose_file: mapping_file("map_pose_file", config.map_pose_file.as_deref())?,
        map_calib_file: mapping_file("map_calib_file", config.map_calib_file.as_deref())?,
        scan_folder: &config.scan_folder,
        pose_file: &config.pose_file,
        calib_file: &config.calib_file,
    };
    inputs.require()?;
    let mut results = LocalizationResults::read(&config.result_file)?;
    ensure!(
        results.refined.is_none() || config.force,
        "{} has refined poses already; add --force to replace them",
        config.result_file.display()
    );
    let map = LoadedMap::load(&inputs, None, context)?;
    let sequence = map.sequence(&inputs, &config.selection())?;
    let sequence = matching(sequence, &results, config)?;
    let estimates = results.estimates_or_particle_means(&RangeMclRules::default())?;
    let increments = increments(config, &sequence, &results)?;
    let sequence = odometry::compensated(sequence, config.motion_compensation, &increments);
    let polished = polish_all(config, context, &map, &sequence, &results, &estimates)?;
    let smoothed = smooth_all(config, &increments, &polished)?;
    let lifted = lift_all(&map, &smoothed.poses, &polished);

    results.estimates = Some(estimates);
    results.refined = Some(smoothed.poses);
    results.refined_covariances = Some(smoothed.covariances);
    results.refine_runtimes_s = Some(polished.iter().map(|frame| frame.seconds).collect());
    let files = RunFiles::beside(&config.result_file);
    run_output::write_results(&files, &results)?;
    run_output::write_trajectory(&files, "refined", &sequence, &lifted)?;
    config::write(&files.file("refinement.yml"), config)?;
    let about = [
        ("recording", config.scan_folder.display().to_string()),
        ("map", config.map_file.display().to_string()),
        (
            "odometry",
            odometry::description(config.odometry, config.odometry_file.as_deref()),
        ),
        ("renderer", map.renderer.name()),
        ("seed", config.seed.to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value));
    let report = run_output::evaluate(&results, &RangeMclRules::default(), about.into())?;
    run_output::write_report(&files, &results, &report)?;
    if config.plot_loc_results {
        run_output::draw_run(&files, Some(&map.mesh), &results)?;
    }
    run_page::write(&files, &report)?;
    Ok(report)
}

/// The frames of the sequence that the result has, in its order.
fn matching(
    mut sequence: Sequence,
    results: &LocalizationResults,
    config: &RefinementConfig,
) -> Result<Sequence> {
    sequence
        .frames
        .retain(|frame| results.frames.binary_search(&frame.number).is_ok());
    ensure!(
        sequence.frames.len() == results.len(),
        "{} has {} frames, of which {} are selected by start_idx, n_scans and frame_step; choose the frames that were localized",
        config.result_file.display(),
        results.len(),
        sequence.frames.len()
    );
    Ok(sequence)
}

/// A frame after the swarm and the finishing step.
struct Polished {
    pose: Pose2,
    /// How well that is known before smoothing [m², m·rad, rad²].
    covariance: Matrix3<f64>,
    /// What the frame says about its pose; nothing where the filter was not sure.
    prior: Option<FramePrior>,
    /// Whether the scan was laid onto the map.
    is_refined: bool,
    /// Whether the filter knew that it was wrong.
    is_lost: bool,
    stance: Stance,
    /// Height of the ground below it, where that is known [m].
    level_m: Option<f64>,
    seconds: f64,
}

fn polish_all(
    config: &RefinementConfig,
    context: &Context,
    map: &LoadedMap,
    sequence: &Sequence,
    results: &LocalizationResults,
    estimates: &[Pose2],
) -> Result<Vec<Polished>> {
    let classifier = FuzzyGround::new(FuzzyConfig::default())?;
    let observer = Observer {
        model: config.range_image,
        own_car_m: config.own_car_m,
        classifier: &classifier,
    };
    let task = context.progress.task("refine", sequence.frames.len());
    let mut polished: Vec<Polished> = Vec::with_capacity(sequence.frames.len());
    let mut skipped = 0;
    for (row, frame) in sequence.frames.iter().enumerate() {
        if context.interrupt.requested() {
            let kept = format!(
                "{} is as it was: a trajectory is refined whole or not at all",
                config.result_file.display()
            );
            return Err(Interrupted { kept }.into());
        }
        let start = Start {
            estimate: estimates[row],
            covariance: results.covariances.as_ref().map(|all| all[row]),
            is_found: is_found(results, row),
            is_lost: (results.states.as_ref())
                .is_some_and(|states| states[row] == State::Lost as u8),
        };
        skipped += usize::from(!start.is_found);
        let seed = ChaCha8Rng::seed_from_u64(config.seed);
        polished.push(polish(
            config,
            map,
            &observer,
            frame,
            &start,
            polished.last(),
            seed,
            row,
        )?);
        task.advance(1);
    }
    let smoothed = if is_smoothed(config, &polished) {
        ", only smoothed"
    } else {
        ""
    };
    if skipped > 0 {
        tracing::info!(
            "{skipped} frames in which the filter was not sure are not refined{smoothed}"
        );
    }
    let refined = polished.iter().filter(|frame| frame.is_refined).count();
    let unmapped = polished.len() - refined - skipped;
    if unmapped > 0 {
        tracing::warn!(
            "{unmapped} frames are as they were localized{smoothed}: there is no ground of the map under the car, or nothing to see in the scan"
        );
    }
    Ok(polished)
}

/// Where a frame's refinement begins.
struct Start {
    estimate: Pose2,
    covariance: Option<Matrix3<f64>>,
    is_found: bool,
    is_lost: bool,
}

impl Start {
    /// What the filter said; where it says nothing, 0.2 m and 0.6 degrees.
    fn covariance(&self) -> Matrix3<f64> {
        self.covariance
            .unwrap_or_else(|| Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 1e-4)))
    }
}

/// Whether the filter was sure; results that do not say are taken at their word.
fn is_found(results: &LocalizationResults, row: usize) -> bool {
    results
        .states
        .as_ref()
        .is_none_or(|states| states[row] == State::Tracking as u8)
}

#[expect(
    clippy::too_many_arguments,
    reason = "one frame with all that it needs"
)]
fn polish(
    config: &RefinementConfig,
    map: &LoadedMap,
    observer: &Observer,
    frame: &Frame,
    start: &Start,
    before: Option<&Polished>,
    mut rng: ChaCha8Rng,
    row: usize,
) -> Result<Polished> {
    rng.set_stream(row as u64);
    let points = observer.read(frame)?;
    let started = Instant::now();
    let image = observer.image(points);
    // A frame that was laid onto the map knows better than the plane of the road that a scan sees.
    let stance = match before {
        Some(before) if before.is_refined => before.stance,
        Some(before) => observer.stance(&image).unwrap_or(before.stance),
        None => observer.stance(&image).unwrap_or_default(),
    };
    let level_m = before
        .filter(|_| !start.is_lost)
        .and_then(|before| before.level_m);
    let refined = if start.is_found {
        let observation = &config.observation;
        let beams = choose_beams(
            &image,
            observation.beams,
            observation.road_share,
            &stance,
            &mut rng,
        );
        let mut objective = FrameObjective {
            renderer: &*map.renderer,
            ground: &map.ground,
            beams: &beams,
            level_m,
            stance,
            difference: observation.difference(),
        };
        if level_m.is_none() {
            objective = objective.on_best_level(&start.estimate)?;
        }
        refine_frame(
            &objective,
            &start.estimate,
            &start.covariance(),
            &config.refinement,
            &mut rng,
        )?
    } else {
        None
    };
    // Where there was nothing to refine with, the filter's word stands.
    let localized = FramePrior {
        pose: start.estimate,
        covariance: start.covariance(),
    };
    let refined_prior = refined.as_ref().map(|frame| FramePrior {
        pose: frame.pose,
        covariance: frame.covariance,
    });
    Ok(Polished {
        is_refined: refined.is_some(),
        is_lost: start.is_lost,
        stance: refined.as_ref().map_or(stance, |frame| frame.stance),
        level_m: (refined.as_ref())
            .and_then(|frame| frame.level_m)
            .or(level_m),
        pose: refined.as_ref().map_or(start.estimate, |frame| frame.pose),
        covariance: (refined.as_ref()).map_or_else(|| start.covariance(), |frame| frame.covariance),
        prior: refined_prior.or(start.is_found.then_some(localized)),
        seconds: started.elapsed().as_secs_f64(),
    })
}

/// The odometry into each frame: the one that was localized with, where that is kept.
fn increments(
    config: &RefinementConfig,
    sequence: &Sequence,
    results: &LocalizationResults,
) -> Result<Vec<Option<Pose2>>> {
    match (&results.odometry, config.odometry) {
        (Some(recorded), OdometrySource::GroundTruth) => {
            Ok(recorded.iter().copied().map(Some).collect())
        }
        _ => {
            let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
            rng.set_stream(u64::MAX);
            odometry::read_increments(
                config.odometry,
                config.odometry_file.as_deref(),
                sequence,
                &mut rng,
            )
        }
    }
}

/// A trajectory and how well its poses are known.
struct Smoothed {
    poses: Vec<Pose2>,
    /// Of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    covariances: Vec<Matrix3<f64>>,
}

/// Whether there is anything to smooth, and to smooth it with.
fn is_smoothed(config: &RefinementConfig, polished: &[Polished]) -> bool {
    config.odometry != OdometrySource::None && polished.iter().any(|frame| frame.prior.is_some())
}

/// Smooths the trajectory with the odometry between its frames, each stretch between frames in which
/// the filter was lost; without odometry every frame
/// stays where its scan puts it.
fn smooth_all(
    config: &RefinementConfig,
    increments: &[Option<Pose2>],
    polished: &[Polished],
) -> Result<Smoothed> {
    let mut smoothed = Smoothed {
        poses: polished.iter().map(|frame| frame.pose).collect(),
        covariances: polished.iter().map(|frame| frame.covariance).collect(),
    };
    let priors: Vec<Option<FramePrior>> = polished.iter().map(|frame| frame.prior).collect();
    if !is_smoothed(config, polished) {
        return Ok(smoothed);
    }
    let increments = increments
        .iter()
        .copied()
        .collect::<Option<Vec<_>>>()
        .context("the odometry has gaps")?;
    // Where the filter was lost, the odometry may not know how the car came from before to after.
    let smoothing = trusted(config);
    // No smoothing takes away what the map is off by in all frames.
    let variance = config.refinement.gauss_newton.map_error_m.powi(2);
    let of_map = Matrix3::from_diagonal(&Vector3::new(variance, variance, 0.0));
    let mut begin = 0;
    for stretch in polished.chunk_by(|before, after| before.is_lost == after.is_lost) {
        let rows = begin..begin + stretch.len();
        begin = rows.end;
        let (priors, increments) = (&priors[rows.clone()], &increments[rows.clone()]);
        if stretch[0].is_lost || priors.iter().all(Option::is_none) {
            continue;
        }
        let poses = smooth(
            &smoothed.poses[rows.clone()],
            priors,
            increments,
            &smoothing,
        );
        if let Some(mut covariances) =
            smoothing::covariances(&poses, priors, increments, &smoothing)
        {
            for covariance in &mut covariances {
                *covariance += of_map;
            }
            smoothed.covariances[rows.clone()].copy_from_slice(&covariances);
        }
        smoothed.poses[rows].copy_from_slice(&poses);
    }
    Ok(smoothed)
}

/// How far the odometry is to be trusted: with the noise that the demonstration puts on the truth,
/// no farther than that noise.
fn trusted(config: &RefinementConfig) -> SmoothingConfig {
    let smoothing = config.refinement.smoothing.clone();
    if config.odometry != OdometrySource::GroundTruth {
        return smoothing;
    }
    let noise = demonstration_noise();
    let turn_rad = std::f64::consts::SQRT_2 * noise.turn_rad;
    SmoothingConfig {
        odometry_ahead_m: smoothing.odometry_ahead_m.max(noise.drive_m),
        odometry_aside_m: smoothing.odometry_aside_m.max(noise.turn_rad),
        odometry_turn_rad: smoothing.odometry_turn_rad.max(turn_rad),
        ..smoothing
    }
}

/// The refined poses standing on the map's ground, or on the last ground that there was.
fn lift_all(map: &LoadedMap, poses: &[Pose2], polished: &[Polished]) -> Vec<Pose3> {
    let mut patch = None;
    poses
        .iter()
        .zip(polished)
        .map(|(pose, frame)| {
            patch = map.ground.patch_under(pose, frame.level_m).or(patch);
            match &patch {
                Some(patch) => patch.lift(pose, &frame.stance),
                None => crate::geometry::pose3_from_pose2(pose, 0.0),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_leap_at_which_the_filter_was_lost_bends_nothing_beside_it() {
        let config = RefinementConfig {
            odometry: OdometrySource::File,
            ..RefinementConfig::default()
        };
        let polished: Vec<Polished> = (0..20)
            .map(|row| {
                let is_lost = row == 10;
                let leap_m = if row > 10 { 50.0 } else { 0.0 };
                let pose = Pose2::translation(f64::from(row) + leap_m, 0.0);
                let covariance = Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 1e-6));
                Polished {
                    pose,
                    covariance,
                    prior: (!is_lost).then_some(FramePrior { pose, covariance }),
                    is_refined: !is_lost,
                    is_lost,
                    stance: Stance::default(),
                    level_m: None,
                    seconds: 0.0,
                }
            })
            .collect();
        let increments = vec![Some(Pose2::translation(1.0, 0.0)); 20];
        let smoothed = smooth_all(&config, &increments, &polished).unwrap();
        assert_eq!(smoothed.covariances.len(), 20);
        for (frame, smoothed) in polished.iter().zip(&smoothed.poses) {
            let off_m = (smoothed.translation.vector - frame.pose.translation.vector).norm();
            assert!(off_m < 1e-6, "{off_m}");
        }
    }
}
