//! Laws of the reconstruction.

use approx::assert_relative_eq;

use super::shapes::{Topology, sphere, street};
use super::*;
use crate::geometry::PointCloud;

fn at_depth(depth: u32) -> PoissonConfig {
    PoissonConfig {
        depth,
        ..PoissonConfig::default()
    }
}

fn reconstructed(cloud: &PointCloud, depth: u32) -> Surface {
    reconstruct(cloud, None, &at_depth(depth)).unwrap()
}

fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values[values.len() / 2]
}

#[test]
fn a_sphere_becomes_one_closed_manifold_without_holes_of_its_radius() {
    for depth in [4, 6, 7] {
        let surface = reconstructed(&sphere(3.0, 20_000), depth);
        let topology = Topology::of(&surface.mesh);
        assert!(topology.is_closed_manifold(), "{depth} {topology:?}");
        assert_eq!(topology.euler, 2);
        let cell_m = 6.6 / f32::from(1_u16 << depth);
        for (vertex, normal) in surface.mesh.vertices.iter().zip(&surface.mesh.normals) {
            assert_relative_eq!(vertex.length(), 3.0, epsilon = 0.1 * cell_m);
            assert!(normal.dot(vertex.normalize()) > 0.95);
        }
    }
}

#[test]
fn a_street_is_manifold_and_lies_within_a_fraction_of_its_noise() {
    let surface = reconstructed(&street(100_000, 0.02, 1), 8);
    let topology = Topology::of(&surface.mesh);
    assert!(topology.is_manifold(), "{topology:?}");
    let heights = (surface.mesh.vertices.iter())
        .filter(|v| v.x.abs() < 18.0 && v.y.abs() < 4.0 && v.z.abs() < 0.2)
        .map(|v| v.z.abs())
        .collect();
    assert!(median(heights) < 0.01);
}
