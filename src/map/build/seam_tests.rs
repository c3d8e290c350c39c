//! Laws of the clipping between local maps.

use std::collections::HashSet;

use glam::{DVec2, DVec3, Vec3};
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

use super::plan::{Domain, Ownership, Region, local_maps};
use super::seam::{keep_own, on_border};
use crate::geometry::{Pose3, TriangleMesh};
use crate::raycasting::Scene;

const LOCAL_MAPS: usize = 4;

/// Scans along an arc of 12 m, three to a local map.
fn ownership() -> Ownership {
    let poses: Vec<Pose3> = (0..3 * LOCAL_MAPS)
        .map(|number| {
            let turn = number as f64 * 0.25;
            Pose3::translation(4.0 * turn.sin(), 4.0 * turn.cos(), 0.0)
        })
        .collect();
    Ownership::new(&poses, &local_maps(&poses, 3, 1.0))
}

/// What a local map owns of the bumpy ground and next to it.
fn region(ownership: &Ownership, number: usize) -> Region {
    ownership.region(number, [-9.0, -9.0].into(), [9.0, 9.0].into())
}

/// The local map that owns the cell of a position [m].
fn owner_at(ownership: &Ownership, position: DVec2) -> Option<usize> {
    let [x, y] = position.to_array();
    (0..LOCAL_MAPS).find(|&number| ownership.is_owner_at(number, x, y))
}

/// Bumpy ground of 16 m x 16 m with random vertices.
fn bumpy(seed: u64) -> TriangleMesh {
    const CELLS: u32 = 53;
    let mut rng = StdRng::seed_from_u64(seed);
    let step = 16.0 / CELLS as f32;
    let mut mesh = TriangleMesh::default();
    for i in 0..(CELLS + 1) * (CELLS + 1) {
        let (column, row) = (i % (CELLS + 1), i / (CELLS + 1));
        let mut jitter = |spread: f32| spread * (rng.random::<f32>() - 0.5);
        mesh.vertices.push(Vec3::new(
            step * column as f32 - 8.0 + jitter(0.5 * step),
            step * row as f32 - 8.0 + jitter(0.5 * step),
            jitter(0.05),
        ));
        mesh.normals.push(Vec3::Z);
    }
    for i in (0..CELLS * (CELLS + 1)).filter(|i| i % (CELLS + 1) < CELLS) {
        let up = i + CELLS + 1;
        mesh.triangles.push([i, i + 1, up + 1]);
        mesh.triangles.push([i, up + 1, up]);
    }
    mesh
}

fn pieces(whole: &TriangleMesh, ownership: &Ownership) -> Vec<TriangleMesh> {
    (0..LOCAL_MAPS)
        .map(|number| {
            let mut piece = whole.clone();
            keep_own(&mut piece, &region(ownership, number), DVec3::ZERO);
            piece
        })
        .collect()
}

fn area(mesh: &TriangleMesh) -> f32 {
    (0..mesh.triangles.len())
        .map(|triangle| 0.5 * mesh.scaled_normal(triangle).length())
        .sum()
}

#[test]
fn clipped_neighbours_of_different_meshes_have_no_gap_and_no_overlap() {
    let ownership = ownership();
    let mut joined = TriangleMesh::default();
    for (number, seed) in (0..LOCAL_MAPS).zip(1..) {
        let mut mesh = bumpy(seed);
        keep_own(&mut mesh, &region(&ownership, number), DVec3::ZERO);
        joined.append(&mesh);
    }
    let scene = Scene::new(&joined);
    let mut rng = StdRng::seed_from_u64(0);
    for _ in 0..50_000 {
        let mut coordinate = || 15.0 * (rng.random::<f32>() - 0.5);
        let above = Vec3::new(coordinate(), coordinate(), 1.0);
        let mut heights_m = Vec::new();
        scene.for_each_hit(above, Vec3::NEG_Z, 2.0, |hit| heights_m.push(hit.range_m));
        // A ray through an edge hits both of its triangles.
        heights_m.sort_unstable_by(f32::total_cmp);
        heights_m.dedup_by(|a, b| (*a - *b).abs() < 1e-5);
        assert_eq!(heights_m.len(), 1, "under {above}: {heights_m:?}");
    }
}

#[test]
fn the_pieces_of_a_mesh_have_its_total_area_and_lie_on_it() {
    let whole = bumpy(1);
    let pieces = pieces(&whole, &ownership());
    let sum: f32 = pieces.iter().map(area).sum();
    assert!((sum - area(&whole)).abs() < 1e-4 * sum, "{sum}");
    assert!(
        pieces
            .iter()
            .all(|piece| piece.normals.len() == piece.vertices.len())
    );
    let scene = Scene::new(&whole);
    for vertex in pieces.iter().flat_map(|piece| &piece.vertices) {
        let mut least_m = f32::INFINITY;
        scene.for_each_hit(vertex + Vec3::Z, Vec3::NEG_Z, 2.0, |hit| {
            least_m = least_m.min((hit.range_m - 1.0).abs());
        });
        let on_rim = vertex.x.abs().max(vertex.y.abs()) > 7.8;
        assert!(on_rim || least_m < 1e-5, "{vertex}: {least_m}");
    }
}

#[test]
fn a_piece_is_open_only_at_the_rim_of_the_mesh_and_along_the_border() {
    let ownership = ownership();
    let whole = bumpy(1);
    for piece in pieces(&whole, &ownership) {
        let edges: HashSet<[u32; 2]> = piece
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .collect();
        assert_eq!(edges.len(), 3 * piece.triangles.len(), "an edge twice");
        for [from, to] in piece
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
        {
            let [a, b] = [from, to].map(|v| piece.vertices[v as usize]);
            let on_rim = a.min(b).abs().max(a.max(b).abs()).truncate().max_element() > 7.8;
            if on_rim || edges.contains(&[to, from]) {
                continue;
            }
            let middle = 0.5 * (a + b).truncate();
            let across = (b - a).truncate().perp().normalize() * 0.01;
            let [left, right] = [middle + across, middle - across]
                .map(|point| owner_at(&ownership, point.as_dvec2()));
            assert_ne!(left, right, "a crack from {a} to {b}");
        }
    }
}

#[test]
fn the_vertices_on_the_border_are_new_ones() {
    let ownership = ownership();
    let whole = bumpy(1);
    let old: HashSet<_> = (whole.vertices.iter())
        .map(|vertex| vertex.to_array().map(f32::to_bits))
        .collect();
    for (number, piece) in pieces(&whole, &ownership).iter().enumerate() {
        let on_border = on_border(&piece.vertices, &region(&ownership, number), DVec3::ZERO);
        assert!(on_border.contains(&true));
        for (vertex, on_border) in piece.vertices.iter().zip(on_border) {
            // Triangles across the border are divided at lines between own cells too.
            let is_new = !old.contains(&vertex.to_array().map(f32::to_bits));
            assert!(is_new || !on_border, "{vertex}");
        }
    }
}

#[test]
fn a_mesh_without_a_border_stays_unchanged() {
    let poses = [Pose3::identity()];
    let ownership = Ownership::new(&poses, &local_maps(&poses, 3, 1.0));
    let whole = bumpy(1);
    let mut own = whole.clone();
    let own_region = region(&ownership, 0);
    assert_eq!(keep_own(&mut own, &own_region, DVec3::ZERO), 0);
    assert!(own == whole);
    let other_region = region(&ownership, 1);
    let foreign = keep_own(&mut own, &other_region, DVec3::ZERO);
    assert_eq!(foreign, whole.triangles.len());
    assert!(own.vertices.is_empty());
}

#[test]
fn far_from_the_origin_of_the_map_a_mesh_is_clipped_as_near_it() {
    let far = DVec3::new(1_003_520.0, -49_152.0, 0.0);
    let scans: Vec<[f64; 2]> = vec![[-2.0, 0.3], [2.0, -0.1]];
    let at = |origin: DVec3| {
        let pose =
            |scan: &[f64; 2]| Pose3::translation(origin.x + scan[0], origin.y + scan[1], 0.0);
        let poses: Vec<Pose3> = scans.iter().map(pose).collect();
        let ownership = Ownership::new(&poses, &local_maps(&poses, 1, 0.0));
        let domain = Domain {
            number: 0,
            origin,
            ownership: &ownership,
        };
        let mut mesh = bumpy(3);
        let region = domain.region(&mesh.bounds());
        keep_own(&mut mesh, &region, origin);
        mesh
    };
    assert!(at(far) == at(DVec3::ZERO));
}
