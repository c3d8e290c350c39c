//! Single decisions of the filter against exact answers.

use std::sync::Arc;

use approx::assert_relative_eq;
use nalgebra::{Matrix3, Vector2, Vector3};
use rand::{SeedableRng, rngs::StdRng};

use super::ParticleFilter;
use super::phase::{Phase, Search};
use super::reweight::{Others, Update};
use super::state::{Pending, Updated};
use crate::geometry::Pose2;
use crate::lidar::{LidarModel, RangeImage};
use crate::localization::motion::OdometryNoise;
use crate::localization::particles::{Particle, deviation};
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
        refuted: false,
        is_one_of_several: false,
        doubtful_s: None,
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
fn the_attitude_is_that_of_the_mapped_ground_where_the_pose_is_known_and_else_that_of_the_scan() {
    let street = TestWorld::street();
    let mut config = LocalizerConfig::of_test(6);
    config.proposal.scan = false;
    // The weights of particles that are far from each other hardly change.
    config.tempering.min_effective_fraction = 0.999;
    let start = street.pose_at(0.0, 0.0, 0.0);
    let ahead = Pose2::translation(0.5, 0.0);
    let scan = street.scan(&(start * ahead));
    let (exact, off) = (
        SensorAttitude::default(),
        SensorAttitude {
            roll_rad: 0.01,
            pitch_rad: -0.008,
            ..SensorAttitude::default()
        },
    );
    let attitude = |apart_m: f64| {
        let places = [-1.0, 1.0].map(|side| start * Pose2::translation(0.0, 0.5 * side * apart_m));
        let particles = ParticleSet::uniform(places.into_iter().cycle().take(6));
        let mut filter = tracking(config.clone(), start, Matrix3::zeros());
        filter.particles = particles;
        let mut rng = StdRng::seed_from_u64(1);
        let frame = filter.step(Odometry::Increment(ahead), &scan, &off, &mut rng);
        let frame = frame.unwrap();
        assert_eq!((frame.updated, frame.places), (true, 1));
        frame.attitude
    };
    let narrow = attitude(0.01);
    assert_relative_eq!(narrow.roll_rad, exact.roll_rad, epsilon = 2e-3);
    assert_relative_eq!(narrow.pitch_rad, exact.pitch_rad, epsilon = 2e-3);
    assert_relative_eq!(narrow.height_m, exact.height_m, epsilon = 0.01);
    assert_eq!(attitude(4.0), off);
}

#[test]
fn a_creeping_car_moves_by_its_odometry_and_during_a_search_from_the_likeliest_place() {
    let start = TestWorld::street().pose_at(0.0, 0.0, 0.7);
    let creep = Pose2::new(Vector2::new(0.08, 0.01), 0.005);
    let check = |places: [Pose2; 3], phase: Phase, expected: Pose2| {
        let config = LocalizerConfig {
            motion: OdometryNoise::constant(0.0, 0.0, 0.0),
            ..LocalizerConfig::of_test(3)
        };
        let mut filter = tracking(config, start, Matrix3::zeros());
        filter.particles = ParticleSet::uniform(places);
        filter.phase = phase;
        let mut rng = StdRng::seed_from_u64(1);
        let (creep_of_car, attitude) = (Odometry::Increment(creep), SensorAttitude::default());
        let frame = filter.step(creep_of_car, &empty_scan(), &attitude, &mut rng);
        let frame = frame.unwrap();
        assert!(!frame.updated);
        assert_relative_eq!(frame.pose, expected, epsilon = 1e-9);
        for (after, before) in frame.particles.poses().zip(places) {
            assert_relative_eq!(*after, before * creep, epsilon = 1e-9);
        }
    };
    let particle = start * Pose2::translation(0.02, 0.03);
    check([particle; 3], Phase::Tracking, particle * creep);
    let apart = [-30.0, 0.0, 30.0].map(|x| start * Pose2::translation(x, 0.0));
    let search = Search::Anywhere;
    check(
        apart,
        Phase::Searching { search, updates: 1 },
        start * creep,
    );
}

#[test]
fn places_weigh_by_the_particles_in_them_and_by_the_costs_of_their_scans() {
    let street = TestWorld::street();
    let [a, b] = [0.0, 30.0].map(|x| street.pose_at(x, 0.0, 0.0));
    // The scan costs nothing at the first place and at the other one so much that it is exp(0.7) times less likely.
    let mut config = LocalizerConfig::of_test(100);
    let cost_m = config.places.tolerance_m + 0.7 * config.places.scale_m;
    config.places.likely_weight = 0.1;
    let scale_m = config.observation.scale_m;
    let per_m2 = 2.0 * cost_m / (scale_m * 30.0_f64.powi(2));
    let mut map = street.map();
    map.renderer = Arc::new(GaussianWorld {
        mean: a,
        information: Matrix3::from_diagonal(&Vector3::new(per_m2, 0.0, 0.0)),
        scale_m,
    });
    let start = ParticleSet::uniform([a, b]);
    let mut filter = ParticleFilter::new(config, map, None, start).unwrap();
    let mut rng = StdRng::seed_from_u64(1);
    let (scan, attitude) = (street.scan(&a), SensorAttitude::default());
    // Before the first scan, places weigh the same: their panoramas were compared with it.
    for (before, likely) in [([0.3, 0.7], 2), ([0.9, 0.1], 1)] {
        let is_first = filter.phase.search() == Some(Search::Anywhere);
        let weighted = [(a, before[0]), (b, before[1])].map(|(pose, weight)| Particle {
            weight,
            ..Particle::new(pose, Some(-1.73))
        });
        filter.particles = ParticleSet::weighted(weighted.into());
        let update = filter.search_places(&scan, &attitude, &mut rng);
        let update = update.unwrap().unwrap();
        let before = if is_first { [0.5, 0.5] } else { before };
        let less_likely = before[1] * (-0.7_f64).exp();
        let of_b = less_likely / (before[0] + less_likely);
        assert_relative_eq!(update.pose.unwrap(), a, epsilon = 1e-9);
        assert_relative_eq!(update.mean_cost_m.unwrap(), of_b * cost_m, epsilon = 1e-7);
        assert_eq!(filter.phase.search(), Some(Search::Places { likely }));
        // Standard deviation of the position in a place: half of its radius of 5 m.
        let particles = filter.particles.particles();
        let (in_a, in_b): (Vec<&Particle>, Vec<&Particle>) =
            (particles.iter()).partition(|it| it.map_from_lidar.translation.x < 15.0);
        let counts = [in_a.len(), in_b.len()];
        let share = |weight: f64| ((100.0 * weight) as usize).max(25);
        assert_eq!(counts, [share(1.0 - of_b), share(of_b)]);
        let weight = in_b.iter().map(|it| it.weight).sum::<f64>();
        assert_relative_eq!(weight, of_b, epsilon = 1e-6);
        let variance = in_a
            .iter()
            .map(|it| it.map_from_lidar.translation.y.powi(2));
        let variance = variance.sum::<f64>() / counts[0] as f64;
        assert_relative_eq!(variance, 6.25, epsilon = 0.3);
    }
}

#[test]
fn a_scan_is_registered_where_the_odometry_since_the_last_update_leads() {
    let street = TestWorld::street();
    let start = street.pose_at(0.0, 0.2, 0.05);
    let [pending, step] = [2.0, 1.5].map(|x| Pose2::new(Vector2::new(x, 0.1), 0.02));
    let truth = start * pending * step;
    let scan = street.scan(&truth);
    let registered = |phase: Phase| {
        let mut filter = tracking(LocalizerConfig::of_test(3), start, Matrix3::zeros());
        filter.pending = Some(Pending {
            motion: pending,
            ..Pending::default()
        });
        filter.phase = phase;
        let mut rng = StdRng::seed_from_u64(1);
        let (step, attitude) = (Odometry::Increment(step), SensorAttitude::default());
        filter.registered(step, &scan, &attitude, &mut rng).unwrap()
    };
    let found = registered(Phase::Tracking).unwrap();
    let expected = street.ground.lift(&truth, &SensorAttitude::default());
    assert_relative_eq!(found, expected.unwrap().unwrap(), epsilon = 5e-3);
    let search = Search::Around;
    assert_eq!(registered(Phase::Lost { search }), None);
}

#[test]
fn a_pose_that_becomes_imprecise_between_updates_is_reported_as_searching() {
    // A motion of 0.2 m is an update, with a variance of 1 m² along the car: 0.04 m² after 8 mm.
    let mut config = LocalizerConfig {
        motion: OdometryNoise::constant(1e-3, 1.0, 1e-3),
        ..LocalizerConfig::of_test(3)
    };
    config.proposal.scan = false;
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
fn the_scan_of_a_creeping_car_is_used_where_its_odometry_is_less_certain() {
    let street = TestWorld::street();
    let start = street.pose_at(0.0, 0.0, 0.7);
    // Where the odometry reports 2 cm, the car moved 6 cm.
    let truth = start * Pose2::translation(0.06, 0.0);
    let step = |noise: f64| {
        let mut config = LocalizerConfig {
            motion: OdometryNoise::constant(noise, noise, noise),
            ..LocalizerConfig::of_test(300)
        };
        config.proposal.registration.map_error_m = 0.004;
        let mut filter = tracking(config, start, Matrix3::zeros());
        filter.particles = ParticleSet::uniform([start; 300]);
        let creep = Odometry::Increment(Pose2::translation(0.02, 0.0));
        let mut rng = StdRng::seed_from_u64(1);
        let attitude = SensorAttitude::default();
        let frame = filter.step(creep, &street.scan(&truth), &attitude, &mut rng);
        let frame = frame.unwrap();
        let off_m = (frame.pose.translation.vector - truth.translation.vector).norm();
        (frame.updated, off_m)
    };
    // A tenth of the motion that is an update has a tenth of its variance: 16 mm, where the error of the map is 4 mm.
    let (is_used, off_m) = step(0.05);
    assert!(is_used && off_m < 0.01, "{is_used}, {off_m} m");
    // 3 mm.
    let (is_used, off_m) = step(0.01);
    assert!(
        !is_used && (off_m - 0.04).abs() < 0.001,
        "{is_used}, {off_m} m"
    );
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
    let mut config = LocalizerConfig {
        motion: OdometryNoise::constant(0.0, 0.0, 0.0),
        ..LocalizerConfig::of_test(3)
    };
    config.proposal.scan = false;
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
fn particles_are_resampled_where_few_are_effective_and_where_fewer_track_a_pose() {
    let config = LocalizerConfig {
        num_reduced: 100,
        ..LocalizerConfig::of_test(400)
    };
    let least = config.resampling.min_effective_fraction;
    let start = TestWorld::street().pose_at(0.0, 0.0, 0.7);
    let after = |count: usize, effective: f64| {
        let mut filter = tracking(config.clone(), start, Matrix3::zeros());
        filter.particles = ParticleSet::uniform(std::iter::repeat_n(start, count));
        let log = |number| if number < effective { 0.0 } else { -1e3 };
        let logs: Vec<f64> = (0..count).map(|number| log(number as f64)).collect();
        filter.particles.reweight(&logs);
        let mut rng = StdRng::seed_from_u64(1);
        filter
            .prepare_next(&empty_scan(), &SensorAttitude::default(), &mut rng)
            .unwrap();
        let effective = filter.particles.effective_sample_size().round() as usize;
        (filter.particles.len(), effective)
    };
    let above = (100.0 * least + 5.0).round();
    assert_eq!(after(100, above), (100, above as usize));
    assert_eq!(after(100, above - 10.0), (100, 100));
    assert_eq!(after(400, 400.0), (100, 100));
}

#[test]
fn the_motion_between_updates_is_known_if_the_pose_was_certain_at_both() {
    let start = TestWorld::street().pose_at(0.0, 0.0, 0.7);
    let step = Pose2::new(Vector2::new(1.0, 0.1), 0.02);
    let motion_of = |was_narrow: bool, apart_m: f64, [refuted, refutes]: [bool; 2]| {
        let mut filter = tracking(LocalizerConfig::of_test(6), start, Matrix3::zeros());
        filter.updated.is_narrow = was_narrow;
        filter.updated.refuted = refuted;
        let sides = [-0.5, 0.5].map(|side| start * step * Pose2::translation(side * apart_m, 0.0));
        filter.particles = ParticleSet::uniform(sides);
        let update = Update {
            mean_cost_m: None,
            beams: vec![],
            attitude: SensorAttitude::default(),
            ground: None,
            pose: None,
            refutes,
            others: Others::Unknown,
        };
        let compared = filter.compared(&update).unwrap();
        filter.updated_estimate(&update, compared).unwrap();
        filter.last_motion.map(|last| last.increment)
    };
    let motion = |was_narrow: bool, apart_m: f64| motion_of(was_narrow, apart_m, [false; 2]);
    assert_relative_eq!(motion(true, 0.01).unwrap(), step, epsilon = 1e-9);
    // A correction of the prediction is no motion, but a second one in turn is.
    assert_eq!(motion_of(true, 0.01, [false, true]), None);
    assert!(motion_of(true, 0.01, [true, true]).is_some());
    assert_eq!(motion(false, 0.01), None);
    assert_eq!(motion(true, 4.0), None);
    assert_eq!(motion(false, 4.0), None);
}

#[test]
fn a_place_is_not_tracked_where_the_scan_fits_much_better_next_to_it() {
    let world = TestWorld::street();
    let truth = world.pose_at(12.0, 0.2, 0.05);
    let scan = world.scan(&truth);
    let mut config = LocalizerConfig::of_test(6);
    // What agrees there by chance confirms a place.
    config.tracking_loss.sure_agreement = 0.2;
    config.tracking_loss.min_agreement = 0.1;
    for (aside_m, expected) in [(0.0, State::Tracking), (0.4, State::Searching)] {
        let pose = truth * Pose2::translation(0.0, aside_m);
        let mut filter = tracking(config.clone(), pose, Matrix3::zeros());
        filter.phase = Phase::Searching {
            search: Search::Around,
            updates: 0,
        };
        let attitude = SensorAttitude::default();
        let mut rng = StdRng::seed_from_u64(1);
        let still = Odometry::Increment(Pose2::identity());
        filter.pending = None;
        let estimate = filter.step(still, &scan, &attitude, &mut rng).unwrap();
        assert_eq!(estimate.state, expected, "{:?}", estimate.agreement);
        // The place is found, and its pose right at once; the next scan confirms it, also of a car that stands.
        assert!(filter.phase.is_tracking());
        assert!(deviation(&estimate.pose, &truth).xy().norm() < 0.01);
        let next = filter.step(still, &scan, &attitude, &mut rng).unwrap();
        assert_eq!(next.state, State::Tracking);
    }
}

#[test]
fn places_are_compared_while_the_car_may_be_in_several() {
    let start = TestWorld::street().pose_at(0.0, 0.0, 0.7);
    let found = |search: Search, apart_m: f64, scan: bool| {
        let mut config = LocalizerConfig::of_test(6);
        config.proposal.scan = scan;
        let mut filter = tracking(config, start, Matrix3::zeros());
        let sides = [-0.5, 0.5].map(|side| start * Pose2::translation(side * apart_m, 0.0));
        filter.particles = ParticleSet::uniform(sides);
        filter.phase = Phase::Searching { search, updates: 1 };
        (filter.compares_places(), filter.likely_places())
    };
    let places = Search::Places { likely: 3 };
    assert_eq!(found(places, 30.0, true), (true, 3));
    assert_eq!(found(Search::Anywhere, 30.0, true), (true, 1));
    assert_eq!(found(Search::Around, 30.0, true), (false, 1));
    assert_eq!(found(places, 0.01, true), (false, 1));
    assert_eq!(found(places, 30.0, false), (false, 1));
    let near = [-3.0, 3.0].map(|side| start * Pose2::translation(side, 0.0));
    let world = TestWorld::street();
    let filter = |is_anywhere: bool| {
        let (config, particles) = (LocalizerConfig::of_test(6), ParticleSet::uniform(near));
        let filter = ParticleFilter::new(config, world.map(), None, particles).unwrap();
        if is_anywhere {
            filter.searching_anywhere()
        } else {
            filter
        }
    };
    assert_eq!(
        [false, true].map(|it| filter(it).compares_places()),
        [false, true]
    );
}

#[test]
fn a_search_that_a_scan_did_not_confirm_finds_a_tilted_sensor_next_to_its_particles() {
    let world = TestWorld::street();
    let truth = world.pose_at(12.0, 0.2, 0.05);
    // In a hand: the particles assume a level sensor.
    let tilted = SensorAttitude {
        pitch_rad: 0.12,
        ..SensorAttitude::default()
    };
    let scan = world.scan_in_space(&world.ground.lift(&truth, &tilted).unwrap().unwrap());
    let is_found = |phase: Phase| {
        let mut filter = tracking(LocalizerConfig::of_test(6), truth, Matrix3::zeros());
        filter.particles = ParticleSet::uniform([truth * Pose2::translation(0.3, 0.3); 6]);
        filter.phase = phase;
        filter.pending = None;
        let mut rng = StdRng::seed_from_u64(1);
        let still = Odometry::Increment(Pose2::identity());
        let states = [0; 2].map(|_| {
            let estimate = filter.step(still, &scan, &SensorAttitude::default(), &mut rng);
            let estimate = estimate.unwrap();
            let error_m = deviation(&estimate.pose, &truth).xy().norm();
            (error_m < 0.02, estimate.state)
        });
        // Another pose than that of the particles is confirmed by the next scan.
        let [(is_right, first), second] = states;
        is_right && first != State::Tracking && second == (true, State::Tracking)
    };
    let search = Search::Around;
    let searching = |updates: usize| Phase::Searching { search, updates };
    assert!(is_found(searching(1)) && is_found(Phase::Lost { search }));
    assert!(!is_found(searching(0)));
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
    let mut config = LocalizerConfig {
        num_reduced: 80,
        ..LocalizerConfig::of_test(500)
    };
    // As in a map that is as small as the surroundings of a given pose.
    config.places.known_start_m = 1000.0;
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
    assert_eq!(filter.phase, Phase::searching(Search::Anywhere));
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
        let proposal = filter.propose(&world.scan(&truth), (&attitude, None), None, &mut rng);
        proposal.unwrap().is_some()
    };
    // The registration is right to a few millimetres.
    assert!(is_proposed(0.0) && is_proposed(5.0) && is_proposed(-5.0));
    assert!(!is_proposed(7.0) && !is_proposed(-7.0));
}
