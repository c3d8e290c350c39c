//! What a newer drive changes in an older map: surfaces that its beams pass through are gone, and surfaces
//! that the older map does not have are added.
//!
//! Each local map of the newer drive judges the older triangles in the region that it owns, by the free-space votes of its
//! scans (see [`visibility`]). A new triangle whose corners and center lie on
//! older surfaces that are kept is already known and dropped. Connected patches of less than half a square metre are noise and
//! change nothing. Borders between older and added surfaces are not welded.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::plan::Domain;
use super::scan_cloud::ScanCloud;
use super::visibility::{self, VisibilityConfig};
use crate::geometry::TriangleMesh;
use crate::map::ground::surface::root;
use crate::map::mesh_view::{MeshView, part_on_lattice};
use crate::raycasting::Scene;

/// Distance along the normal within which surfaces are the same [m].
const SAME_M: f32 = 0.15;

/// Area of the smallest patch that changes [m²].
const MIN_PATCH_M2: f32 = 0.5;

/// What a local map of a newer drive changes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Changes {
    /// Triangles of the older map that are gone, ascending.
    pub gone: Vec<u32>,
    /// New triangles that the older map has already.
    pub known: usize,
}

/// Compares the new mesh of a local map with an older map, and removes what is known from it.
pub(crate) fn compare(
    older: &dyn MeshView,
    mesh: &mut TriangleMesh,
    scans: &[ScanCloud],
    domain: Domain,
    config: &VisibilityConfig,
) -> Changes {
    // Beams lie between the scans and the surfaces on which they end.
    let mut bounds = mesh.bounds();
    for scan in scans {
        bounds.min = bounds.min.min(scan.map_from_lidar.translation);
        bounds.max = bounds.max.max(scan.map_from_lidar.translation);
    }
    let (min, max) = (bounds.min - SAME_M, bounds.max + SAME_M);
    let (min, max) = (
        domain.origin + min.as_dvec3(),
        domain.origin + max.as_dvec3(),
    );
    let overlaps = |triangle: &u32| {
        let [a, b, c] = older.corners(*triangle as usize);
        a.min(b).min(c).cmple(max).all() && a.max(b).max(c).cmpge(min).all()
    };
    let numbers: Vec<u32> = (0..older.triangles() as u32)
        .into_par_iter()
        .filter(overlaps)
        .collect();
    let mut near = part_on_lattice(older, &numbers, domain.origin);
    let crossed = if config.enabled {
        in_patches(&near, &visibility::crossed_triangles(&near, scans, config))
    } else {
        vec![false; numbers.len()]
    };
    let is_owned = |triangle: u32| {
        let center = older.corners(triangle as usize).into_iter().sum::<DVec3>() / 3.0;
        (domain.ownership).is_owner_at(domain.number, center.x, center.y)
    };
    let gone = (numbers.iter().zip(&crossed))
        .filter(|&(&triangle, &is_crossed)| is_crossed && is_owned(triangle))
        .map(|(&triangle, _)| triangle)
        .collect();
    near.retain_triangles(|triangle, _| !crossed[triangle]);
    let is_new = in_patches(mesh, &unknown(&near, mesh));
    Changes {
        gone,
        known: mesh.retain_triangles(|triangle, _| is_new[triangle]),
    }
}

/// Which selected triangles belong to connected patches of at least [`MIN_PATCH_M2`].
fn in_patches(mesh: &TriangleMesh, is_some: &[bool]) -> Vec<bool> {
    let mut parents: Vec<u32> = (0..mesh.vertices.len() as u32).collect();
    let some = || (mesh.triangles.iter().zip(is_some).enumerate()).filter(|(_, (_, is))| **is);
    for (_, (&[a, b, c], _)) in some() {
        for (one, other) in [(a, b), (a, c)] {
            let (one, other) = (root(&mut parents, one), root(&mut parents, other));
            parents[one.max(other) as usize] = one.min(other);
        }
    }
    let mut areas_m2 = vec![0.0_f32; parents.len()];
    for (triangle, (&[a, ..], _)) in some() {
        areas_m2[root(&mut parents, a) as usize] += 0.5 * mesh.scaled_normal(triangle).length();
    }
    (mesh.triangles.iter().zip(is_some))
        .map(|(&[a, ..], &is)| is && areas_m2[root(&mut parents, a) as usize] >= MIN_PATCH_M2)
        .collect()
}

/// Which triangles of a mesh do not lie on the surfaces of another.
fn unknown(surfaces: &TriangleMesh, mesh: &TriangleMesh) -> Vec<bool> {
    let scene = Scene::new(surfaces);
    let is_on_surface = |point: Vec3, normal: Vec3| {
        let mut is_hit = false;
        let below = point - SAME_M * normal;
        scene.for_each_hit(below, normal, 2.0 * SAME_M, |_| is_hit = true);
        is_hit
    };
    (0..mesh.triangles.len())
        .into_par_iter()
        .map(|triangle| {
            let corners = mesh.corners(triangle);
            let Some(normal) = mesh.scaled_normal(triangle).try_normalize() else {
                return false;
            };
            let center = corners.into_iter().sum::<Vec3>() / 3.0;
            !is_on_surface(center, normal)
                || !corners
                    .into_iter()
                    .all(|corner| is_on_surface(corner, normal))
        })
        .collect()
}

/// The older map without what is gone, and with what is new.
pub fn joined(older: &TriangleMesh, gone: &[u32], added: &TriangleMesh) -> TriangleMesh {
    let mut mesh = older.clone();
    mesh.retain_triangles(|triangle, _| gone.binary_search(&(triangle as u32)).is_err());
    mesh.append(added);
    mesh
}
