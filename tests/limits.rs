//! Numbers of a configuration that decide an allocation or a loop: beyond their limit they are an error
//! that names key, value and limit, before anything is read or written.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use common::fpmcl;

/// Sets one key of a command and expects the error that names it.
#[track_caller]
fn refuses(command: &str, key: &str, value: &str, limit: &str) {
    let message = format!("{key} is ");
    fpmcl(command)
        .set(key, value)
        .fails_with(&[&message, limit]);
}

#[test]
fn maps_are_bounded() {
    for (key, value, limit) in [
        ("crop_x", "10000", "500"),
        ("crop_y", "1e30", "500"),
        ("crop_z", ".inf", "500"),
        ("voxel_size", "1e-9", "0.001"),
        ("simplify_resolution", "1e-6", "0.01"),
        ("number_of_iterations", "1000000000", "1000"),
        ("depth", "40", "12"),
        ("local_map_size", "1000000000", "10000"),
        ("num_iterations", "1000000000", "100000"),
        ("ransac_n", "1000000000", "1000"),
        ("poisson.iterations", "1000000000", "1000"),
        ("range_image.width", "65536", "4194304"),
        ("range_image.max_range", "1e30", "1000000"),
        ("normals.spacing_m", "1e9", "10"),
        ("visibility.point_voters", "1000000000", "1000"),
        ("own_car_m", "[-1e30, 1e30, -1, 1]", "x_min"),
    ] {
        let call = fpmcl("build-map").set("range_image.height", "4096");
        let message = format!("{key} is ");
        call.set("range_image.width", "900")
            .set(key, value)
            .fails_with(&[&message, limit]);
    }
}

#[test]
fn localization_is_bounded() {
    for (key, value, limit) in [
        ("numParticles", "1000000000000", "1000000"),
        ("num_reduced", "1000000000000", "1000000"),
        ("range_image.height", "100000", "4096"),
        ("range_image.max_instance", "1000000000000", "1000000"),
        ("grid_res", "0.0001", "0.05"),
        ("panorama.columns", "65536", "3600"),
        ("panorama.rows", "100000", "256"),
        ("observation.beams", "1000000000000", "1000000"),
        ("observation.min_beams", "1000000000000", "1000000"),
        ("observation.ray_budget", "1000000000000000", "1000000000"),
        ("tempering.searching_rounds", "1000000000", "100"),
        ("proposal.beams", "1000000000000", "1000000"),
        ("proposal.registration.sectors", "1000000000000", "10000"),
        ("proposal.registration.iterations", "1000000000000", "1000"),
        ("refinement.swarm.candidates", "1000000000000", "10000"),
        ("refinement.swarm.iterations", "1000000000000", "1000"),
        ("refinement.smoothing.iterations", "1000000000", "1000"),
        ("refinement.max_reach_m", "1e300", "1000000"),
        ("start.position_m", "1e300", "1000000"),
        ("sensor_height_m", "1e300", "1000000"),
        ("kld.bin_m", "1e-300", "1000000"),
    ] {
        refuses("localize", key, value, limit);
    }
}

#[test]
fn refinement_and_ground_are_bounded() {
    for (key, value, limit) in [
        ("refinement.swarm.candidates", "1000000000000", "10000"),
        ("refinement.gauss_newton.sectors", "1000000000000", "10000"),
        ("range_image.width", "1000000000000", "65536"),
    ] {
        refuses("refine", key, value, limit);
    }
    refuses("ground", "ransac.num_iterations", "1000000000", "100000");
    refuses("ground", "fuzzy.features.spacing_m", "1e30", "10");
}

#[test]
fn simulations_are_bounded() {
    for (key, value, limit) in [
        ("path", "[{length_m: 1e12}]", "100000"),
        ("motion.speed_m_s", "1e-9", "0.1"),
        ("motion.weaving_m", ".nan", "10"),
        ("street.ground.cell_m", "0.0001", "0.1"),
        ("street.ground.reach_m", "1e9", "500"),
        ("street.lamp_spacing_m", "1e-6", "1000000"),
        ("street.plants_per_100_m", "1e12", "1000"),
        ("street.side_street_spacing_m", "1e-6", "5"),
        ("traffic.oncoming_spacing_m", "1e-6", "1000000"),
        ("traffic.pedestrians_per_100_m", "1e12", "1000"),
        ("scanner.beams", "1000000000000", "4096"),
        ("scanner.azimuth_steps", "65537", "65536"),
        ("odometry.step_noise_m", "1e300", "100"),
    ] {
        refuses("simulate", key, value, limit);
    }
}
