//! Single decisions of the filter against exact answers.

use std::sync::Arc;

use approx::assert_relative_eq;
use nalgebra::{Matrix3, Vector2, Vector3};
use rand::{SeedableRng, rngs::StdRng};

use super::ParticleFilter;
use super::phase::{Phase, Search};
use super::state::{Pending, Updated};
use crate::geometry::Pose2;
use crate::lidar::{LidarModel, RangeImage};
use crate::localization::motion::OdometryNoise;
use crate::localization::particles::deviation;
use crate::localization::proposal::Gaussian;
use crate::localization::{LocalizerConfig, Odometry, ParticleSet, State};
use crate::map::gaussian_for_tests::GaussianWorld;
use crate::map::world_for_tests::TestWorld;
use crate::map::{PanoramaConfig, PanoramaRequest, SearchRegion, SensorAttitude};

/// A filter that has just tracked a pose with a covariance.
fn tracking(config: LocalizerConfig, pose: Pose2, covariance: Matrix3<f64>) -> ParticleFilter {
    let map = TestWorld::street().map();
    let particles = ParticleSet::uniform([pose; 3]);
    let mut filter = ParticleFilter::new(config, map, None, particles).unwrap();
    filter.phase = Phase::Tracking;
    filter.pending = Some(Pending::default());
    filter.updated = Updated {
        pose,
        covariance,
        is_narrow: true,
    };
    filter
}

fn empty_scan() -> RangeImage {
    RangeImage::project(&[], &LidarModel::default())
}

#[test]
fn the_estimate_of_an_update_and_its_covariance_are_those_of_the_posterior() {
    const COUNT: usize = 20_000;
    let street = TestWorld::street();
    let start = street.pose_at(2.0, 0.5, 0.7);
    // Prior and likelihood of (x, y, heading), of which the second one is off by a standard deviation or so.
    let prior = Matrix3::new(0.04, 0.01, 0.0, 0.01, 0.09, 0.004, 0.0, 0.004, 0.01);
    let likelihood = Matrix3::new(0.03, -0.02, 0.0, -0.02, 0.06, 0.0, 0.0, 0.0, 0.02);
    let off = Vector3::new(0.2, -0.3, 0.1);
    let [prior_information, information] = [prior, likelihood].map(|it| it.try_inverse().unwrap());
    let posterior = (prior_information + information).try_inverse().unwrap();
    let shift = posterior * information * off;

    let mut config = LocalizerConfig::of_test(COUNT);
    config.proposal.scan = false;
    config.tempering.min_effective_fraction = 0.0;
    let mut map = street.map();
    map.renderer = Arc::new(GaussianWorld {
        mean: Pose2::new(
            start.translation.vector + off.xy(),
            start.rotation.angle() + off.z,
        ),
        information,
        scale_m: config.observation.scale_m,
    });
    let mut rng = StdRng::seed_from_u64(4);
    let poses = Gaussian::new(start, prior).unwrap().sample(COUNT, &mut rng);
    let mut filter = ParticleFilter::new(config, map, None, ParticleSet::uniform(poses)).unwrap();
    filter.phase = Phase::Tracking;
    let still = Odometry::Increment(Pose2::identity());
    let frame = filter.step(still, &empty_scan(), &SensorAttitude::default(), &mut rng);
    let frame = frame.unwrap();

    let effective = frame.effective_sample_size;
    assert!(effective > 5000.0, "{effective}");
    // Four standard errors of a mean and of a variance.
    let found = deviation(&frame.pose, &start);
    for axis in 0..3 {
        let sigma = posterior[(axis, axis)].sqrt();
        assert_relative_eq!(
            found[axis],
            shift[axis],
            epsilon = 4.0 * sigma / effective.sqrt()
        );
        for other in 0..3 {
            let scale = sigma * posterior[(other, other)].sqrt();
            assert_relative_eq!(
                frame.covariance[(axis, other)],
                posterior[(axis, other)],
                epsilon = 4.0 * scale * (2.0 / effective).sqrt()
            );
        }
    }
}

#[test]
fn a_pose_that_becomes_imprecise_between_updates_is_reported_as_searching() {
    // A motion of 0.2 m is an update, with a variance of 1 m² along the car: 0.04 m² after 8 mm.
    let config = LocalizerConfig {
        motion: OdometryNoise::constant(1e-3, 1.0, 1e-3),
        ..LocalizerConfig::of_test(3)
    };
    let street = TestWorld::street();
    let start = street.pose_at(0.0, 0.0, 0.7);
    let scan = street.scan(&start);
    let mut filter = tracking(config, start, Matrix3::zeros());
    let mut rng = StdRng::seed_from_u64(1);
    let creep = Odometry::Increment(Pose2::translation(3e-3, 0.0));
    let states = [0; 4].map(|_| {
        let attitude = SensorAttitude::default();
        let frame = filter.step(creep, &scan, &attitude, &mut rng);
        let frame = frame.unwrap();
        assert!(!frame.updated);
        frame.state
    });
    let [tracking, searching] = [State::Tracking, State::Searching];
    assert_eq!(states, [tracking, tracking, searching, searching]);
}

#[test]
fn a_standing_car_is_compared_with_the_map_and_is_sure_only_of_what_it_sees() {
    let street = TestWorld::street();
    let start = street.pose_at(0.0, 0.0, 0.7);
    // At the same pose, without returns, and turned while the odometry reports no motion.
    let seen = |pose: &Pose2| street.scan(pose);
    let turned = start * Pose2::rotation(0.5);
    for (scan, is_tracked, is_updated) in [
        (seen(&start), true, false),
        (empty_scan(), false, false),
        (seen(&turned), false, true),
    ] {
        let mut filter = tracking(LocalizerConfig::of_test(3), start, Matrix3::zeros());
        let mut rng = StdRng::seed_from_u64(1);
        let still = Odometry::Increment(Pose2::identity());
        let frame = filter.step(still, &scan, &SensorAttitude::default(), &mut rng);
        let frame = frame.unwrap();
        let found = (frame.state == State::Tracking, frame.updated);
        assert_eq!(found, (is_tracked, is_updated));
    }
}

#[test]
fn the_scan_of_a_standing_car_that_agrees_far_less_than_usual_is_used() {
    const USUAL: f64 = 0.98;
    let street = TestWorld::street();
    let start = street.pose_at(0.0, 0.0, 0.7);
    let step = |usual: Option<f64>, turned_rad: f64| {
        let config = LocalizerConfig::of_test(3);
        let mut filter = tracking(config.clone(), start, Matrix3::zeros());
        filter.agreement.observe(usual, &config.tracking_loss);
        let mut rng = StdRng::seed_from_u64(1);
        let still = Odometry::Increment(Pose2::identity());
        let scan = street.scan(&(start * Pose2::rotation(turned_rad)));
        let frame = filter.step(still, &scan, &SensorAttitude::default(), &mut rng);
        frame.unwrap()
    };
    let config = LocalizerConfig::default().tracking_loss;
    let mut between = 0;
    for turned_rad in (0..60).map(|i| 0.002 * f64::from(i)) {
        let without = step(None, turned_rad);
        if without.updated {
            continue;
        }
        let share = without.agreement.unwrap();
        let is_low = share < config.lost_fraction * USUAL;
        assert_eq!(step(Some(USUAL), turned_rad).updated, is_low, "{share}");
        between += usize::from(is_low);
    }
    assert!(between > 0);
}

#[test]
fn the_pose_of_an_update_whose_scan_agrees_far_less_than_usual_is_not_sure() {
    const USUAL: f64 = 0.98;
    let street = TestWorld::street();
    let start = street.pose_at(0.0, 0.0, 0.7);
    let ahead = Pose2::translation(0.5, 0.0);
    // Particles that cannot follow a scan that was turned.
    let mut config = LocalizerConfig {
        motion: OdometryNoise::constant(1e-4, 1e-3, 1e-3),
        ..LocalizerConfig::of_test(3)
    };
    config.proposal.scan = false;
    let limits = config.tracking_loss.clone();
    let step = |usual: Option<f64>, turned_rad: f64| {
        let mut filter = tracking(config.clone(), start, Matrix3::zeros());
        filter.agreement.observe(usual, &limits);
        let scan = street.scan(&(start * ahead * Pose2::rotation(turned_rad)));
        let (moved, attitude) = (Odometry::Increment(ahead), SensorAttitude::default());
        let mut rng = StdRng::seed_from_u64(1);
        let frame = filter.step(moved, &scan, &attitude, &mut rng).unwrap();
        assert!(frame.updated);
        frame
    };
    let (mut low, mut usual) = (0, 0);
    for turned_rad in (0..60).map(|i| 0.002 * f64::from(i)) {
        // Without a usual share, only that of the scan decides.
        let without = step(None, turned_rad);
        if without.state != State::Tracking {
            continue;
        }
        let share = without.agreement.unwrap();
        let slow = USUAL + limits.slow_rate * (share - USUAL);
        let is_low = share < limits.lost_fraction * slow;
        let is_tracked = step(Some(USUAL), turned_rad).state == State::Tracking;
        assert_eq!(is_tracked, !is_low, "{share}");
        low += usize::from(is_low);
        usual += usize::from(!is_low);
    }
    assert!(low > 0 && usual > 0, "{low} {usual}");
}

#[test]
fn the_uncertain_heading_of_a_creeping_car_makes_its_position_uncertain() {
    let config = LocalizerConfig {
        motion: OdometryNoise::constant(0.0, 0.0, 0.0),
        ..LocalizerConfig::of_test(3)
    };
    let start = TestWorld::street().pose_at(0.0, 0.0, 0.7);
    let of_heading = Matrix3::from_diagonal(&Vector3::new(0.0, 0.0, 0.01));
    let mut filter = tracking(config, start, of_heading);
    let mut rng = StdRng::seed_from_u64(1);
    let creep = Odometry::Increment(Pose2::translation(0.1, 0.0));
    let frame = filter.step(creep, &empty_scan(), &SensorAttitude::default(), &mut rng);
    // Ten centimetres ahead, a turn by 1 rad moves the position by ten centimetres to the left.
    let by_turn = Vector3::new(-0.1 * 0.7_f64.sin(), 0.1 * 0.7_f64.cos(), 1.0);
    let expected = 0.01 * by_turn * by_turn.transpose();
    assert_relative_eq!(frame.unwrap().covariance, expected, epsilon = 1e-12);
}

#[test]
fn a_search_without_a_decision_is_lost_once_its_patience_is_over() {
    let mut config = LocalizerConfig::of_test(100);
    config.tracking_loss.patience = 3;
    // Five metres from each other: nothing decides between them without returns.
    let start = [0.0, 5.0].map(|x| Pose2::translation(x, 0.0));
    let map = TestWorld::street().map();
    let start = ParticleSet::uniform(start);
    let mut filter = ParticleFilter::new(config, map, None, start).unwrap();
    let mut rng = StdRng::seed_from_u64(1);
    let step = Odometry::Increment(Pose2::translation(1.0, 0.0));
    let states = [0; 5].map(|_| {
        let frame = filter.step(step, &empty_scan(), &SensorAttitude::default(), &mut rng);
        frame.unwrap().state
    });
    let [searching, lost] = [State::Searching, State::Lost];
    assert_eq!(states, [searching, searching, searching, lost, lost]);
}

#[test]
fn a_search_has_as_many_particles_as_kld_sampling_demands() {
    let config = LocalizerConfig {
        num_reduced: 100,
        ..LocalizerConfig::of_test(2000)
    };
    // Forty bins of 0.5 m with particles that weigh, and 500 with particles that do not.
    let in_bin = |bin: usize| {
        let x = 0.5 * (bin % 100) as f64 + 0.25;
        let y = 0.5 * (bin / 100) as f64 + 0.25;
        Pose2::new(Vector2::new(x, y), 0.05)
    };
    let poses = (0..1500).map(|number| {
        in_bin(if number < 1000 {
            number % 40
        } else {
            number - 900
        })
    });
    let map = TestWorld::street().map();
    let mut start = ParticleSet::uniform(poses);
    let logs: Vec<f64> = (0..1500)
        .map(|number| if number < 1000 { 0.0 } else { -50.0 })
        .collect();
    start.reweight(&logs);
    let mut filter = ParticleFilter::new(config, map, None, start).unwrap();
    let mut rng = StdRng::seed_from_u64(1);
    filter.resample(&mut rng);
    // The 99 % quantile of χ² with 39 degrees of freedom is 62.43 (Fox 2003, eq. 5: by 2 ε = 0.1).
    assert_relative_eq!(filter.particles.len() as f64, 624.3, max_relative = 0.01);
    filter.phase = Phase::Tracking;
    filter.resample(&mut rng);
    assert_eq!(filter.particles.len(), 100);
}

#[test]
fn a_restart_keeps_particles_where_the_car_was_because_the_alarm_may_be_false() {
    let world = TestWorld::street();
    let request = PanoramaRequest {
        region: SearchRegion::Road,
        lidar: LidarModel::default(),
        sensor_height_m: SensorAttitude::default().height_m,
        config: PanoramaConfig::default(),
    };
    let config = LocalizerConfig {
        num_reduced: 80,
        ..LocalizerConfig::of_test(500)
    };
    // On the pavement, where no panorama is; three quarters of the weight on the left one.
    let [left, right] = [6.0, -6.0].map(|y| world.pose_at(-20.0, y, 0.0));
    let mut start = ParticleSet::uniform([left, right]);
    start.reweight(&[3.0_f64.ln(), 0.0]);
    let mut filter = ParticleFilter::new(config, world.map(), Some(request), start).unwrap();
    filter.phase = Phase::Lost {
        search: Search::Around,
    };
    let scan = world.scan(&world.pose_at(40.0, 0.0, 0.0));
    let mut rng = StdRng::seed_from_u64(1);
    filter
        .prepare_next(&scan, &SensorAttitude::default(), &mut rng)
        .unwrap();
    assert_eq!(filter.phase.reported(true), State::Searching);
    let copies = |pose: Pose2| {
        filter
            .particles
            .poses()
            .filter(|other| **other == pose)
            .count()
    };
    assert_eq!((copies(left), copies(right)), (60, 20));
    assert!(filter.particles.len() > 80);
}

#[test]
fn a_registration_beyond_six_standard_deviations_of_the_prediction_is_rejected() {
    /// Standard deviations of the prediction.
    const SIGMA_M: f64 = 0.01;
    const SIGMA_RAD: f64 = 1e-3;
    let world = TestWorld::street();
    let truth = world.pose_at(5.0, 0.3, 0.1);
    let is_proposed = |off_sigmas: f64| {
        let predicted = truth * Pose2::translation(0.0, off_sigmas * SIGMA_M);
        // Two particles per axis have the variances of a sixth of them each.
        let spread = 3.0_f64.sqrt();
        let particles = [-spread, spread].into_iter().flat_map(|k| {
            [
                Pose2::translation(k * SIGMA_M, 0.0),
                Pose2::translation(0.0, k * SIGMA_M),
                Pose2::rotation(k * SIGMA_RAD),
            ]
        });
        let particles = ParticleSet::uniform(particles.map(|off| predicted * off));
        let config = LocalizerConfig::of_test(6);
        let mut filter = ParticleFilter::new(config, world.map(), None, particles).unwrap();
        filter.phase = Phase::Tracking;
        let mut rng = StdRng::seed_from_u64(1);
        let attitude = SensorAttitude::default();
        let proposal = filter.propose(&world.scan(&truth), &attitude, &mut rng);
        proposal.unwrap().is_some()
    };
    // The registration is right to a few millimetres.
    assert!(is_proposed(0.0) && is_proposed(5.0) && is_proposed(-5.0));
    assert!(!is_proposed(7.0) && !is_proposed(-7.0));
}
