//! The filter in a street of boxes.

use std::time::Duration;

use approx::assert_relative_eq;
use nalgebra::Vector2;
use rand::{SeedableRng, rngs::StdRng};

use super::ParticleFilter;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3, wrap_angle};
use crate::lidar::{LidarModel, RangeImage};
use crate::localization::initialization::{StartSpread, around, from_panoramas};
use crate::localization::motion::{OdometryNoise, TurnDriveTurn, VelocityCommand};
use crate::localization::odometry::{increments, with_noise};
use crate::localization::places::PlacesConfig;
use crate::localization::{Estimate, LocalizerConfig, Odometry, ParticleSet, State};
use crate::map::world_for_tests::TestWorld;
use crate::map::{PanoramaConfig, PanoramaRequest, SearchRegion, SensorAttitude};

/// A slightly winding drive along the street, 0.8 m per frame, map frame.
fn drive(world: &TestWorld, from_x: f64, frames: usize) -> Vec<Pose2> {
    (0..frames)
        .map(|frame| {
            let x = from_x + 0.8 * frame as f64;
            world.pose_at(x, 0.5 * (0.1 * x).sin(), 0.05 * (0.1 * x).cos())
        })
        .collect()
}

/// Odometry with noise of a centimetre and a tenth of a degree per frame.
fn odometry(truth: &[Pose2], seed: u64) -> Vec<Pose2> {
    let poses: Vec<Pose3> = truth
        .iter()
        .map(|pose| crate::geometry::pose3_from_pose2(pose, 0.0))
        .collect();
    let noise = OdometryNoise::constant(0.002, 0.01, 0.0);
    with_noise(
        &increments(&poses),
        &noise,
        &mut StdRng::seed_from_u64(seed),
    )
}

/// OdometrySource of the odometry.
#[derive(Clone, Copy)]
enum OdometrySource {
    Odometry,
    Velocity,
    None,
}

fn run(
    filter: &mut ParticleFilter,
    world: &TestWorld,
    truth: &[Pose2],
    source: OdometrySource,
    rng: &mut StdRng,
) -> Vec<Estimate> {
    let increments = odometry(truth, 99);
    truth
        .iter()
        .zip(increments)
        .map(|(pose, increment)| {
            let odometry = match source {
                OdometrySource::Odometry => Odometry::Increment(increment),
                OdometrySource::Velocity => {
                    let duration = Duration::from_millis(100);
                    Odometry::Velocity(VelocityCommand::driving(&increment, duration))
                }
                OdometrySource::None => Odometry::Unknown,
            };
            filter
                .step(odometry, &world.scan(pose), &SensorAttitude::default(), rng)
                .unwrap()
        })
        .collect()
}

fn track(world: &TestWorld, truth: &[Pose2], seed: u64) -> Vec<Estimate> {
    let mut rng = StdRng::seed_from_u64(seed);
    let start = around(&truth[0], None, 500, &StartSpread::default(), &mut rng);
    let mut filter = ParticleFilter::new(
        LocalizerConfig::of_test(500),
        world.map(),
        None,
        ParticleSet::uniform(start),
    )
    .unwrap();
    run(
        &mut filter,
        world,
        truth,
        OdometrySource::Odometry,
        &mut rng,
    )
}

/// Root mean square of position [m] and heading [rad].
fn rmse(frames: &[Estimate], truth: &[Pose2]) -> (f64, f64) {
    let errors = frames.iter().zip(truth).map(|(frame, truth)| {
        let position = (frame.pose.translation.vector - truth.translation.vector).norm_squared();
        let turn = wrap_angle(frame.pose.rotation.angle() - truth.rotation.angle());
        (position, turn * turn)
    });
    let (position, turn) = errors.fold((0.0, 0.0), |sum, e| (sum.0 + e.0, sum.1 + e.1));
    let n = frames.len() as f64;
    ((position / n).sqrt(), (turn / n).sqrt())
}

#[test]
fn a_start_within_five_metres_and_thirty_degrees_converges_to_centimetres() {
    let world = TestWorld::street();
    let truth = drive(&world, 0.0, 30);
    for seed in 0..3 {
        let frames = track(&world, &truth, seed);
        let (position_m, heading_rad) = rmse(&frames[10..], &truth[10..]);
        assert!(position_m < 0.03, "seed {seed}: {position_m} m");
        assert!(
            heading_rad.to_degrees() < 0.1,
            "seed {seed}: {} deg",
            heading_rad.to_degrees()
        );
        assert!(
            frames[10..]
                .iter()
                .all(|frame| frame.state == State::Tracking)
        );
        assert!(
            frames[12..]
                .iter()
                .all(|frame| frame.particles.len() == 100)
        );
    }
}

#[test]
fn a_street_elsewhere_and_turned_gives_the_same_accuracy() {
    let world = TestWorld::moved_street(Pose2::new(Vector2::new(120.0, -80.0), 2.0));
    let truth = drive(&world, 0.0, 20);
    let frames = track(&world, &truth, 1);
    let (position_m, heading_rad) = rmse(&frames[10..], &truth[10..]);
    assert!(
        position_m < 0.03 && heading_rad.to_degrees() < 0.1,
        "{position_m} {heading_rad}"
    );
}

#[test]
fn a_street_shifted_by_a_tile_shifts_the_estimates() {
    let (here, there) = (
        TestWorld::street(),
        TestWorld::moved_street(Pose2::translation(100.0, 0.0)),
    );
    let (a, b) = (drive(&here, 0.0, 12), drive(&there, 0.0, 12));
    let (a, b) = (track(&here, &a, 4), track(&there, &b, 4));
    let (a, b) = (a.last().unwrap(), b.last().unwrap());
    // Rounding decides some resampling pointers: the runs agree to the width of the distribution.
    assert_relative_eq!(
        a.pose.translation.x + 100.0,
        b.pose.translation.x,
        epsilon = 0.03
    );
    assert_relative_eq!(a.pose.translation.y, b.pose.translation.y, epsilon = 0.03);
}

#[test]
fn the_same_seed_gives_identical_estimates_on_one_thread_and_on_two() {
    let world = TestWorld::street();
    let truth = drive(&world, 20.0, 6);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| track(&world, &truth, 7))
    };
    let (one, two) = (on(1), on(2));
    for (one, two) in one.iter().zip(&two) {
        assert_eq!(one.particles, two.particles);
        assert_eq!(one.pose, two.pose);
    }
    assert_ne!(
        track(&world, &truth, 8).last().unwrap().pose,
        one.last().unwrap().pose
    );
}

#[test]
fn without_odometry_the_velocity_is_estimated_and_tracking_is_not_lost() {
    let world = TestWorld::street();
    // Walking pace, a town, a road outside of it: metres per frame.
    for (step_m, seed) in [(0.1, 1), (0.8, 2), (1.9, 3)] {
        let truth: Vec<Pose2> = (0..30)
            .map(|frame| {
                let x = step_m * f64::from(frame);
                world.pose_at(x, 0.5 * (0.1 * x).sin(), 0.05 * (0.1 * x).cos())
            })
            .collect();
        let mut rng = StdRng::seed_from_u64(seed);
        let start = around(&truth[0], None, 500, &StartSpread::default(), &mut rng);
        let start = ParticleSet::uniform(start);
        let mut filter =
            ParticleFilter::new(LocalizerConfig::of_test(500), world.map(), None, start).unwrap();
        let frames = run(&mut filter, &world, &truth, OdometrySource::None, &mut rng);
        let (position_m, heading_rad) = rmse(&frames[10..], &truth[10..]);
        assert!(
            position_m < 0.05 && heading_rad.to_degrees() < 0.2,
            "{step_m}: {position_m} {heading_rad}"
        );
        let states: Vec<State> = frames.iter().map(|frame| frame.state).collect();
        assert!(!states.contains(&State::Lost), "{step_m}: {states:?}");
        assert!(states[10..].iter().all(|&state| state == State::Tracking));
    }
}

#[test]
fn velocity_commands_of_a_car_that_drifts_sideways_add_no_bias() {
    let world = TestWorld::street();
    // A sensor with a mounting angle of one degree: every frame drifts to the same side.
    let truth: Vec<Pose2> = (0..30)
        .map(|frame| {
            let x = 0.8 * f64::from(frame);
            world.pose_at(x, 0.2 + 0.0175 * x, 0.0)
        })
        .collect();
    let frames = {
        let mut rng = StdRng::seed_from_u64(4);
        let start = around(&truth[0], None, 500, &StartSpread::default(), &mut rng);
        let start = ParticleSet::uniform(start);
        let mut filter =
            ParticleFilter::new(LocalizerConfig::of_test(500), world.map(), None, start).unwrap();
        run(
            &mut filter,
            &world,
            &truth,
            OdometrySource::Velocity,
            &mut rng,
        )
    };
    let aside: f64 = frames[10..]
        .iter()
        .zip(&truth[10..])
        .map(|(frame, truth)| (truth.inverse() * frame.pose).translation.y / 20.0)
        .sum();
    assert!(aside.abs() < 0.003, "{aside} m");
}

#[test]
fn a_standing_car_is_not_updated_and_its_covariance_does_not_grow() {
    let world = TestWorld::street();
    let truth = drive(&world, 0.0, 10);
    let mut rng = StdRng::seed_from_u64(5);
    let start = around(&truth[0], None, 500, &StartSpread::default(), &mut rng);
    let mut filter = ParticleFilter::new(
        LocalizerConfig::of_test(500),
        world.map(),
        None,
        ParticleSet::uniform(start),
    )
    .unwrap();
    let last = run(
        &mut filter,
        &world,
        &truth,
        OdometrySource::Odometry,
        &mut rng,
    )
    .pop()
    .unwrap();
    // Scans are not registered, but weigh particles after some motion.
    filter.config.proposal.scan = false;
    let scan = world.scan(&truth[9]);
    for _ in 0..20 {
        let creep = Odometry::Increment(Pose2::translation(0.001, 0.0));
        let frame = filter
            .step(creep, &scan, &SensorAttitude::default(), &mut rng)
            .unwrap();
        assert!(!frame.updated);
        // Two centimetres are a tenth of an update, with a tenth of its variance.
        assert!(frame.covariance.trace() >= last.covariance.trace());
        let noise = LocalizerConfig::of_test(500)
            .motion
            .covariance(&TurnDriveTurn::decompose(&Pose2::identity()));
        assert!(frame.covariance.trace() < last.covariance.trace() + 0.15 * noise.trace());
        assert!((frame.pose.translation.vector - last.pose.translation.vector).norm() < 0.05);
    }
}

#[test]
fn the_covariance_of_a_creeping_car_grows_by_the_noise_of_its_motion() {
    let world = TestWorld::street();
    let truth = world.pose_at(0.0, 0.0, 0.7);
    let mut config = LocalizerConfig::of_test(3);
    config.proposal.scan = false;
    config.velocity.speed_m_per_s = 4.0;
    // A hundredth of what makes an update due.
    let command = VelocityCommand {
        speed_m_per_s: 0.1 * config.move_thres_m,
        turn_rate_rad_per_s: 0.0,
        duration: Duration::from_millis(100),
    };
    let of_velocity = config.velocity.covariance(&command);
    let motion = TurnDriveTurn::decompose(&command.compose());
    let of_motion = config.motion.covariance(&motion);
    let map_from_car = truth.rotation.to_rotation_matrix().to_homogeneous();
    for (odometry, noise) in [
        (Odometry::Velocity(command), of_velocity),
        (Odometry::Increment(command.compose()), of_motion),
    ] {
        // Identical particles: all of the covariance comes from the motion.
        let start = ParticleSet::uniform([truth; 3]);
        let mut filter = ParticleFilter::new(config.clone(), world.map(), None, start).unwrap();
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        let mut rng = StdRng::seed_from_u64(1);
        filter.step(odometry, &scan, &attitude, &mut rng).unwrap();
        let frame = filter.step(odometry, &scan, &attitude, &mut rng).unwrap();
        assert!(!frame.updated);
        let expected = 0.01 * map_from_car * noise * map_from_car.transpose();
        assert_relative_eq!(frame.covariance, expected, epsilon = 1e-9);
    }
}

#[test]
fn the_velocity_is_known_across_a_border_of_tiles() {
    let world = TestWorld::street();
    let config = LocalizerConfig::of_test(500);
    let border = Vector2::new(50.0, 0.2);
    let tile = |x: f64| world.tiles.tile_at(x, border.y);
    assert_ne!(tile(border.x - 0.01), tile(border.x + 0.01));
    // Brakes by 0.2 m a frame, and stops on the border.
    let mut places_m = vec![border.x; 4];
    for frame in 0..20 {
        places_m.push(places_m.last().unwrap() - (0.1 + 0.2 * f64::from(frame)).min(1.9));
    }
    let truth: Vec<Pose2> = (places_m.iter().rev())
        .map(|&x| world.pose_at(x, border.y, 0.0))
        .collect();
    let mut rng = StdRng::seed_from_u64(3);
    let start = around(&truth[0], None, 500, &StartSpread::default(), &mut rng);
    let start = ParticleSet::uniform(start);
    let mut filter = ParticleFilter::new(config, world.map(), None, start).unwrap();
    run(
        &mut filter,
        &world,
        &truth[..10],
        OdometrySource::None,
        &mut rng,
    );
    for frame in 10..truth.len() {
        let scan = world.scan(&truth[frame]);
        filter
            .step(
                Odometry::Unknown,
                &scan,
                &SensorAttitude::default(),
                &mut rng,
            )
            .unwrap();
        let found_m = filter.last_motion.as_ref().unwrap().increment.translation.x;
        let step_m = (truth[frame - 1].inverse() * truth[frame]).translation.x;
        assert_relative_eq!(found_m, step_m, epsilon = 0.08);
    }
}

fn panoramas() -> PanoramaRequest {
    PanoramaRequest {
        region: SearchRegion::Road,
        lidar: LidarModel::default(),
        sensor_height_m: 1.73,
        config: PanoramaConfig::default(),
    }
}

#[test]
fn a_kidnapped_car_is_detected_within_five_frames_and_localized_again() {
    let world = TestWorld::street();
    let before = drive(&world, -30.0, 12);
    let after = drive(&world, 47.0, 25);
    let mut rng = StdRng::seed_from_u64(6);
    let start = around(&before[0], None, 500, &StartSpread::default(), &mut rng);
    let mut filter = ParticleFilter::new(
        LocalizerConfig::of_test(500),
        world.map(),
        Some(panoramas()),
        ParticleSet::uniform(start),
    )
    .unwrap();
    let frames = run(
        &mut filter,
        &world,
        &before,
        OdometrySource::Odometry,
        &mut rng,
    );
    assert_eq!(frames.last().unwrap().state, State::Tracking);
    let frames = run(
        &mut filter,
        &world,
        &after,
        OdometrySource::Odometry,
        &mut rng,
    );
    let noticed = frames.iter().position(|frame| frame.state == State::Lost);
    assert!(noticed.is_some_and(|frame| frame < 5), "{noticed:?}");
    let (position_m, heading_rad) = rmse(&frames[20..], &after[20..]);
    assert!(
        position_m < 0.05 && heading_rad.to_degrees() < 0.2,
        "{position_m} {heading_rad}"
    );
    assert_eq!(frames.last().unwrap().state, State::Tracking);
}

#[test]
fn after_a_restart_the_covariance_of_a_standing_car_is_that_of_the_particles() {
    let world = TestWorld::street();
    let before = drive(&world, -30.0, 12);
    let mut rng = StdRng::seed_from_u64(6);
    let start = around(&before[0], None, 500, &StartSpread::default(), &mut rng);
    let mut filter = ParticleFilter::new(
        LocalizerConfig::of_test(500),
        world.map(),
        Some(panoramas()),
        ParticleSet::uniform(start),
    )
    .unwrap();
    run(
        &mut filter,
        &world,
        &before,
        OdometrySource::Odometry,
        &mut rng,
    );
    let after = drive(&world, 47.0, 8);
    let lost = after.iter().find(|pose| {
        let odometry = Odometry::Increment(Pose2::translation(0.8, 0.0));
        let frame = filter
            .step(
                odometry,
                &world.scan(pose),
                &SensorAttitude::default(),
                &mut rng,
            )
            .unwrap();
        frame.state == State::Lost
    });
    let stays = Odometry::Increment(Pose2::identity());
    let frame = filter
        .step(
            stays,
            &world.scan(lost.unwrap()),
            &SensorAttitude::default(),
            &mut rng,
        )
        .unwrap();
    assert!(!frame.updated);
    let spread = frame.particles.covariance_about(&frame.pose);
    assert_relative_eq!(frame.covariance, spread, max_relative = 1e-6);
    assert!(spread.trace() > 1.0, "{spread}");
}

#[test]
fn a_start_anywhere_converges() {
    let world = TestWorld::street();
    let index = world.map().panoramas(&panoramas()).unwrap();
    for (seed, from_x) in [(1, -40.0), (2, 3.3), (3, 71.7)] {
        let truth = drive(&world, from_x, 20);
        let mut rng = StdRng::seed_from_u64(seed);
        let scan = world.scan(&truth[0]);
        let start = from_panoramas(
            &index,
            &scan,
            &SensorAttitude::default(),
            1000,
            &PlacesConfig::default(),
            &mut rng,
        )
        .unwrap();
        let mut filter = ParticleFilter::new(
            LocalizerConfig::of_test(1000),
            world.map(),
            Some(panoramas()),
            ParticleSet::uniform(start),
        )
        .unwrap();
        let frames = run(
            &mut filter,
            &world,
            &truth,
            OdometrySource::Odometry,
            &mut rng,
        );
        let (position_m, heading_rad) = rmse(&frames[15..], &truth[15..]);
        assert!(
            position_m < 0.05 && heading_rad.to_degrees() < 0.2,
            "{from_x}: {position_m} {heading_rad}"
        );
    }
}

#[test]
fn tracking_is_not_lost_next_to_a_lorry() {
    let map = TestWorld::street();
    let mut seen = TestWorld::street();
    // As long as the drive: it hides the left side of the street in every frame.
    seen.put_box((-60.0, 140.0), (2.0, 2.5), 4.0);
    let truth = drive(&map, 0.0, 30);
    let mut rng = StdRng::seed_from_u64(8);
    let start = StartSpread {
        position_m: 0.5,
        heading_rad: 0.05,
        ..StartSpread::default()
    };
    let start = ParticleSet::uniform(around(&truth[0], None, 500, &start, &mut rng));
    let mut filter =
        ParticleFilter::new(LocalizerConfig::of_test(500), map.map(), None, start).unwrap();
    let frames = run(
        &mut filter,
        &seen,
        &truth,
        OdometrySource::Odometry,
        &mut rng,
    );
    let (position_m, _) = rmse(&frames[10..], &truth[10..]);
    assert!(position_m < 0.05, "{position_m}");
    assert!(frames.iter().all(|frame| frame.state != State::Lost));
}

#[test]
fn particles_off_the_map_have_no_cost() {
    let world = TestWorld::street();
    let truth = world.pose_at(0.0, 0.0, 0.0);
    let nowhere = Pose2::translation(1e6, f64::MAX.sqrt());
    let start = ParticleSet::uniform([nowhere, truth, nowhere]);
    let mut filter =
        ParticleFilter::new(LocalizerConfig::of_test(3), world.map(), None, start).unwrap();
    let mut rng = StdRng::seed_from_u64(1);
    let scan = world.scan(&truth);
    let odometry = Odometry::Increment(Pose2::identity());
    let frame = filter
        .step(odometry, &scan, &SensorAttitude::default(), &mut rng)
        .unwrap();
    assert!(frame.mean_cost_m.is_some());
    let start = ParticleSet::uniform([nowhere; 3]);
    let mut filter =
        ParticleFilter::new(LocalizerConfig::of_test(3), world.map(), None, start).unwrap();
    let frame = filter
        .step(odometry, &scan, &SensorAttitude::default(), &mut rng)
        .unwrap();
    assert_eq!(frame.mean_cost_m, None);
    assert_ne!(frame.state, State::Tracking);
}

#[test]
fn a_scan_without_returns_leaves_the_prediction() {
    let world = TestWorld::street();
    let truth = drive(&world, 0.0, 10);
    let mut rng = StdRng::seed_from_u64(9);
    let start = around(&truth[0], None, 500, &StartSpread::default(), &mut rng);
    let mut filter = ParticleFilter::new(
        LocalizerConfig::of_test(500),
        world.map(),
        None,
        ParticleSet::uniform(start),
    )
    .unwrap();
    run(
        &mut filter,
        &world,
        &truth,
        OdometrySource::Odometry,
        &mut rng,
    );
    let empty = RangeImage::project(&[], &LidarModel::default());
    let step = Odometry::Increment(Pose2::translation(0.8, 0.0));
    let frame = filter
        .step(step, &empty, &SensorAttitude::default(), &mut rng)
        .unwrap();
    assert_relative_eq!(frame.pose.translation.x, 8.0, epsilon = 0.1);
    // Nothing was compared.
    assert_eq!(frame.agreement, None);
    assert_eq!(frame.state, State::Searching);
}

#[test]
fn without_returns_tracking_is_lost_after_some_distance() {
    let world = TestWorld::street();
    let truth = drive(&world, 0.0, 8);
    let mut rng = StdRng::seed_from_u64(9);
    let start = around(&truth[0], None, 300, &StartSpread::default(), &mut rng);
    let mut filter = ParticleFilter::new(
        LocalizerConfig::of_test(300),
        world.map(),
        None,
        ParticleSet::uniform(start),
    )
    .unwrap();
    let frames = run(
        &mut filter,
        &world,
        &truth,
        OdometrySource::Odometry,
        &mut rng,
    );
    assert_eq!(frames.last().unwrap().state, State::Tracking);
    let nothing = RangeImage::project(&[], &LidarModel::default());
    let step = Odometry::Increment(Pose2::translation(2.0, 0.0));
    let mut after_m = 0.0;
    let mut state = State::Tracking;
    while state != State::Lost {
        let frame = filter.step(step, &nothing, &SensorAttitude::default(), &mut rng);
        state = frame.unwrap().state;
        after_m += 2.0;
        assert!(
            after_m < 600.0,
            "still tracking after {after_m} m without returns"
        );
    }
    assert!(
        after_m > 4.0,
        "tracking was lost after {after_m} m without returns"
    );
}

#[test]
fn a_sensor_that_is_carried_over_a_step_of_the_ground_keeps_its_height() {
    let (world, truth) = TestWorld::carried_over_a_step();
    let mut rng = StdRng::seed_from_u64(5);
    let start = around(
        &pose2_from_pose3(&truth[0]),
        None,
        500,
        &StartSpread::default(),
        &mut rng,
    );
    let (config, start) = (LocalizerConfig::of_test(500), ParticleSet::uniform(start));
    let mut filter = ParticleFilter::new(config, world.map(), None, start).unwrap();
    let held = |truth: &Pose3| {
        world
            .ground
            .patch_under(&pose2_from_pose3(truth), None)
            .unwrap()
            .unwrap()
    };
    let (mut before, mut levels_m) = (truth[0], Vec::new());
    for (frame, truth) in truth.iter().enumerate() {
        let odometry = Odometry::Motion(before.inverse() * truth);
        before = *truth;
        let known = filter.predict(odometry).unwrap();
        let attitude = known.unwrap_or_else(|| held(truth).attitude_of(truth));
        let scan = world.scan_in_space(truth);
        let found = filter.step(odometry, &scan, &attitude, &mut rng).unwrap();
        if frame < 5 {
            continue;
        }
        assert_eq!(found.state, State::Tracking, "frame {frame}");
        let off_m = (found.map_from_lidar.translation.vector - truth.translation.vector).norm();
        assert!(off_m < 0.02, "frame {frame}: {off_m}");
        // The height is that above the ground below.
        let (level_m, above_m) = (found.level_m.unwrap(), found.attitude.height_m);
        assert!(
            (level_m + above_m - 0.9).abs() < 0.05,
            "{level_m} {above_m}"
        );
        levels_m.push(level_m);
    }
    let jump_m = levels_m.windows(2).map(|pair| pair[1] - pair[0]);
    assert!(jump_m.fold(0.0, f64::max) > 0.5, "{levels_m:?}");
}
