//! Laws of the reconstruction.

use approx::assert_relative_eq;
use glam::{Quat, Vec3};

use super::shapes_for_tests::{Topology, sphere, street};
use super::*;
use crate::geometry::PointCloud;
use crate::memory::MemoryBudget;

fn at_depth(depth: u32) -> PoissonConfig {
    PoissonConfig {
        depth: Some(depth),
        ..PoissonConfig::default()
    }
}

fn reconstructed(cloud: &PointCloud, depth: u32) -> Reconstruction {
    reconstruct(cloud, &at_depth(depth), MemoryBudget::default()).unwrap()
}

fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values[values.len() / 2]
}

#[test]
fn a_sphere_becomes_a_closed_manifold_of_genus_0_with_its_radius() {
    for depth in [4, 6, 7] {
        // At least one point per face of the finest cells.
        let surface = reconstructed(&sphere(3.0, 80_000), depth);
        let topology = Topology::of(&surface.mesh);
        assert!(topology.is_closed_manifold(), "{depth} {topology:?}");
        assert_eq!(topology.euler, 2);
        let cell_m = 6.6 / f32::from(1_u16 << depth);
        let mut cosines = Vec::new();
        for (vertex, normal) in surface.mesh.vertices.iter().zip(&surface.mesh.normals) {
            assert_relative_eq!(vertex.length(), 3.0, epsilon = 0.1 * cell_m);
            cosines.push(normal.dot(vertex.normalize()));
        }
        // Normals between slivers are off by up to 20 degrees; the median is less than 3.
        let least = cosines.iter().copied().fold(1.0, f32::min);
        assert!(least > 0.9, "{depth} {least}");
        let typical = median(cosines);
        assert!(typical > 3.0_f32.to_radians().cos(), "{depth} {typical}");
    }
}

#[test]
fn a_street_is_manifold_and_its_error_is_a_fraction_of_the_noise() {
    let surface = reconstructed(&street(100_000, 0.02, 1), 8);
    let topology = Topology::of(&surface.mesh);
    assert!(topology.is_manifold(), "{topology:?}");
    let heights = (surface.mesh.vertices.iter())
        .filter(|v| v.x.abs() < 18.0 && v.y.abs() < 4.0 && v.z.abs() < 0.2)
        .map(|v| v.z.abs())
        .collect();
    assert!(median(heights) < 0.01);
}

/// A sphere whose lower half has one point where the upper has forty.
fn unevenly_sampled_sphere() -> PointCloud {
    let mut cloud = sphere(3.0, 60_000);
    let low: Vec<bool> = cloud.positions.iter().map(|p| p.z < 0.0).collect();
    cloud.retain(|index| !low[index] || index % 40 == 0);
    cloud
}

#[test]
fn cells_of_different_size_meet_without_cracks() {
    for depth in [7, 8] {
        let surface = reconstructed(&unevenly_sampled_sphere(), depth);
        let topology = Topology::of(&surface.mesh);
        assert!(topology.is_closed_manifold(), "{depth} {topology:?}");
        assert_eq!(topology.euler, 2);
        // The sparse half has larger triangles because its cells are larger.
        let upper = surface.mesh.vertices.iter().filter(|v| v.z > 0.0).count();
        assert!(surface.mesh.vertices.len() - upper < upper / 2);
        for vertex in &surface.mesh.vertices {
            assert_relative_eq!(vertex.length(), 3.0, epsilon = 0.03);
        }
    }
}

#[test]
fn the_density_increases_by_one_with_four_times_the_points() {
    let density = |count| median(reconstructed(&sphere(3.0, count), 6).densities);
    assert_relative_eq!(density(40_000) - density(10_000), 1.0, epsilon = 0.05);
    // The area of a cell's face at that depth holds `samples_per_node` points.
    let (radius_m, side_m) = (3.0_f32, 6.6_f32);
    let per_area = 40_000.0 / (4.0 * std::f32::consts::PI * radius_m * radius_m);
    let depth = (per_area * side_m * side_m / 1.5).log(4.0);
    assert_relative_eq!(density(40_000), depth, epsilon = 0.1);
}

#[test]
fn the_hole_in_a_plane_has_a_lower_density_and_is_trimmed_with_it() {
    let mut cloud = PointCloud::default();
    for i in 0..200 {
        for j in 0..200 {
            let position = Vec3::new(0.05 * i as f32 - 5.0, 0.05 * j as f32 - 5.0, 0.0);
            if position.length() > 1.5 {
                cloud.push(position, Vec3::Z, 1.0);
            }
        }
    }
    let mut surface = reconstructed(&cloud, 7);
    let in_hole = |v: &&Vec3| v.length() < 0.8;
    assert!(surface.mesh.vertices.iter().filter(in_hole).count() > 10);
    let dropped = trim_by_distance(&mut surface.mesh, &cloud.positions, 0.2, |_| 0.0);
    assert!(dropped > 0);
    assert_eq!(surface.mesh.vertices.iter().filter(in_hole).count(), 0);
    assert!(surface.mesh.vertices.iter().all(|v| v.z.abs() < 0.01));
    assert!(Topology::of(&surface.mesh).bad_edges == 0);
}

#[test]
fn a_rotated_street_gives_the_rotated_surface_within_a_tenth_of_a_cell() {
    let cloud = street(100_000, 0.0, 3);
    let rotation = Quat::from_euler(glam::EulerRot::ZYX, 0.7, 0.1, -0.2);
    let mut turned = cloud.clone();
    for (position, normal) in turned.positions.iter_mut().zip(&mut turned.normals) {
        (*position, *normal) = (rotation * *position, rotation * *normal);
    }
    let off_ground = |cloud: &PointCloud, rotation: Quat| {
        let surface = reconstructed(cloud, 8);
        let back = surface
            .mesh
            .vertices
            .iter()
            .map(|v| rotation.inverse() * *v);
        let errors: Vec<f32> = back
            .filter(|v| v.x.abs() < 18.0 && v.y.abs() < 4.0 && v.z.abs() < 0.5)
            .map(|v| v.z.abs())
            .collect();
        assert!(errors.len() > 1000);
        median(errors)
    };
    let cell_m = 44.0 / 256.0;
    assert!(off_ground(&cloud, Quat::IDENTITY) < 0.1 * cell_m);
    assert!(off_ground(&turned, rotation) < 0.1 * cell_m);
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    let cloud = street(30_000, 0.02, 4);
    let with_threads = |count: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build();
        pool.unwrap().install(|| reconstructed(&cloud, 8))
    };
    let (one, two) = (with_threads(1), with_threads(2));
    assert_eq!(one, two);
}

#[test]
fn invalid_points_are_ignored_and_counted() {
    let clean = sphere(2.0, 5_000);
    let mut dirty = clean.clone();
    dirty.push(Vec3::new(f32::NAN, 0.0, 0.0), Vec3::X, 0.0);
    dirty.push(Vec3::new(1.0, f32::INFINITY, 0.0), Vec3::X, 0.0);
    dirty.push(Vec3::new(9.0, 0.0, 0.0), Vec3::ZERO, 0.0);
    dirty.push(Vec3::new(9.0, 0.0, 0.0), Vec3::splat(f32::NAN), 0.0);
    let (clean, dirty) = (reconstructed(&clean, 6), reconstructed(&dirty, 6));
    assert_eq!(dirty.dropped_points, 4);
    assert_eq!(dirty.mesh, clean.mesh);
}

#[test]
fn finest_cells_have_their_edge_whatever_the_extent() {
    for (radius_m, depth) in [(0.4, 4), (1.0, 6), (3.0, 7)] {
        let config = PoissonConfig {
            cell_m: 0.06,
            ..PoissonConfig::default()
        };
        let cloud = sphere(radius_m, 50_000);
        let surface = reconstruct(&cloud, &config, MemoryBudget::default()).unwrap();
        assert_relative_eq!(surface.cell_m, 0.06, epsilon = 1e-6);
        // As the cube of the next power of two.
        let side_m = 0.06 * f32::from(1_u16 << depth);
        assert!((1.1 * 2.0 * radius_m..2.2 * 2.0 * radius_m + 0.01).contains(&side_m));
        assert!(Topology::of(&surface.mesh).is_closed_manifold());
    }
}

#[test]
fn cells_are_at_least_half_of_the_resolution_at_their_place_and_meet_without_cracks() {
    let cloud = sphere(3.0, 200_000);
    let config = at_depth(7);
    // Twice to four times the cells of 5.2 cm on the one side, those on the other.
    let resolution_m = |position: Vec3| if position.x > 0.0 { 0.21 } else { 0.0 };
    let budget = MemoryBudget::default();
    let surface = reconstruct_resolved(&cloud, &config, resolution_m, budget).unwrap();
    let topology = Topology::of(&surface.mesh);
    assert!(topology.is_closed_manifold(), "{topology:?}");
    assert_eq!(topology.euler, 2);
    let vertices = &surface.mesh.vertices;
    let count = |is_there: fn(&Vec3) -> bool| vertices.iter().filter(|v| is_there(v)).count();
    let (fine, coarse) = (count(|v| v.x < -1.2), count(|v| v.x > 1.2));
    // A quarter as many per doubling.
    assert!((10..20).contains(&(fine / coarse)), "{fine} {coarse}");
    for vertex in vertices {
        assert_relative_eq!(vertex.length(), 3.0, epsilon = 0.02);
    }
}

#[test]
fn too_few_points_and_invalid_settings_are_errors() {
    let error = |cloud: &PointCloud, depth| {
        reconstruct(cloud, &at_depth(depth), MemoryBudget::default()).unwrap_err()
    };
    let nothing = error(&PointCloud::default(), 8).to_string();
    assert!(nothing.contains("only 0 of 0 points"), "{nothing}");
    let mut one_place = PointCloud::default();
    (0..100).for_each(|_| one_place.push(Vec3::ONE, Vec3::Z, 0.0));
    assert!(matches!(
        error(&one_place, 8),
        MeshingError::TooFewPoints { .. }
    ));
    let ball = sphere(1.0, 100);
    for depth in [2, 20] {
        let message = error(&ball, depth).to_string();
        assert!(
            message.starts_with(&format!("depth is {depth}: ")),
            "{message}"
        );
    }
}
