//! Cutting off what Poisson invents to close its surface: where no sample is, by density, and far
//! from every sample, by distance. Both say how many triangles went.

use std::collections::HashMap;

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::Surface;
use crate::geometry::TriangleMesh;

/// Drops the vertices whose density is below the `quantile` of all densities, with their triangles,
/// as range-mcl does (Chen et al., ICRA 2021). Returns the number of dropped triangles.
pub fn trim_by_density(surface: &mut Surface, quantile: f64) -> usize {
    let Some(limit) = quantile_of(&surface.densities, quantile) else {
        return 0;
    };
    let densities = std::mem::take(&mut surface.densities);
    let is_kept = |vertex: u32| densities[vertex as usize] >= limit;
    let triangles = surface.mesh.triangles.clone();
    let mut is_used = vec![false; densities.len()];
    for triangle in triangles.iter().filter(|t| t.iter().all(|&v| is_kept(v))) {
        for &vertex in triangle {
            is_used[vertex as usize] = true;
        }
    }
    surface.densities = (densities.iter().zip(&is_used))
        .filter_map(|(&density, &is_used)| is_used.then_some(density))
        .collect();
    surface
        .mesh
        .retain_triangles(|index| triangles[index].iter().all(|&v| is_kept(v)));
    triangles.len() - surface.mesh.triangles.len()
}

/// Drops the triangles with a vertex farther than `max_distance_m` from every sample. Returns
/// their number.
pub fn trim_by_distance(mesh: &mut TriangleMesh, samples: &[Vec3], max_distance_m: f32) -> usize {
    let near = Neighborhood::new(samples, max_distance_m);
    let is_near: Vec<bool> = mesh
        .vertices
        .par_iter()
        .map(|&vertex| near.has_sample_at(vertex))
        .collect();
    let triangles = mesh.triangles.clone();
    mesh.retain_triangles(|index| triangles[index].iter().all(|&v| is_near[v as usize]));
    triangles.len() - mesh.triangles.len()
}

/// The value below which a share of all values lies, interpolated as NumPy does; `None` without values.
fn quantile_of(values: &[f32], quantile: f64) -> Option<f32> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    let place = quantile.clamp(0.0, 1.0) * (sorted.len().checked_sub(1)?) as f64;
    let low = sorted[place.floor() as usize];
    let high = sorted[place.ceil() as usize];
    Some(low + (high - low) * place.fract() as f32)
}

/// Samples by cell, each cell as wide as the distance that is asked for.
struct Neighborhood<'a> {
    samples: &'a [Vec3],
    /// Sample indices, cell by cell.
    order: Vec<u32>,
    ranges: HashMap<IVec3, (u32, u32)>,
    reach_m: f32,
}

impl<'a> Neighborhood<'a> {
    fn new(samples: &'a [Vec3], reach_m: f32) -> Self {
        let mut keyed: Vec<([i32; 3], u32)> = samples
            .par_iter()
            .enumerate()
            .filter(|(_, sample)| sample.is_finite())
            .map(|(index, sample)| {
                (
                    (sample / reach_m).floor().as_ivec3().to_array(),
                    index as u32,
                )
            })
            .collect();
        keyed.par_sort_unstable();
        let mut ranges = HashMap::new();
        let mut begin = 0;
        for chunk in keyed.chunk_by(|a, b| a.0 == b.0) {
            let end = begin + chunk.len() as u32;
            ranges.insert(IVec3::from_array(chunk[0].0), (begin, end));
            begin = end;
        }
        Self {
            samples,
            order: keyed.into_iter().map(|(_, index)| index).collect(),
            ranges,
            reach_m,
        }
    }

    fn has_sample_at(&self, point: Vec3) -> bool {
        let cell = (point / self.reach_m).floor().as_ivec3();
        (0..27).any(|i| {
            let offset = IVec3::new(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
            self.ranges
                .get(&(cell + offset))
                .is_some_and(|&(begin, end)| {
                    self.order[begin as usize..end as usize]
                        .iter()
                        .any(|&index| {
                            let limit = self.reach_m * self.reach_m;
                            self.samples[index as usize].distance_squared(point) <= limit
                        })
                })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A strip of triangles along x, one vertex pair per metre.
    fn strip(length: u32) -> TriangleMesh {
        TriangleMesh {
            vertices: (0..2 * length)
                .map(|i| Vec3::new((i / 2) as f32, (i % 2) as f32, 0.0))
                .collect(),
            triangles: (0..2 * length - 2)
                .map(|i| {
                    if i % 2 == 0 {
                        [i, i + 2, i + 1]
                    } else {
                        [i, i + 1, i + 2]
                    }
                })
                .collect(),
            ..TriangleMesh::default()
        }
    }

    #[test]
    fn the_sparsest_tenth_of_the_vertices_goes_and_densities_stay_beside_their_vertices() {
        let mesh = strip(50);
        let mut surface = Surface {
            densities: mesh.vertices.iter().map(|v| v.x).collect(),
            mesh,
            dropped_points: 0,
        };
        let dropped = trim_by_density(&mut surface, 0.1);
        // Vertices at x < 4.9 go: of the 98 triangles those of the first five metres.
        assert_eq!(dropped, 10);
        assert_eq!(surface.mesh.vertices.len(), 90);
        assert!(
            surface
                .mesh
                .vertices
                .iter()
                .zip(&surface.densities)
                .all(|(v, d)| v.x == *d)
        );
    }

    #[test]
    fn quantile_zero_and_an_empty_surface_drop_nothing() {
        let mut surface = Surface {
            mesh: strip(5),
            densities: vec![1.0; 10],
            dropped_points: 0,
        };
        assert_eq!(trim_by_density(&mut surface, 0.0), 0);
        assert_eq!(trim_by_density(&mut Surface::default(), 0.5), 0);
    }

    #[test]
    fn triangles_stay_where_all_their_corners_have_a_sample_in_reach() {
        let mut mesh = strip(20);
        let samples: Vec<Vec3> = (0..5).map(|x| Vec3::new(x as f32, 0.5, 0.0)).collect();
        let dropped = trim_by_distance(&mut mesh, &samples, 0.51);
        assert_eq!(dropped, 38 - 8);
        assert!(mesh.vertices.iter().all(|vertex| vertex.x <= 4.0));
        assert_eq!(trim_by_distance(&mut mesh, &[], 0.5), 8);
        assert!(mesh.vertices.is_empty());
    }
}
