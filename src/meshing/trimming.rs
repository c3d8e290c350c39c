//! Removal of surface that is not supported by samples, which the Poisson reconstruction adds to close
//! the surface: by sampling density and by distance to the samples.

use glam::Vec3;
use rayon::prelude::*;

use crate::geometry::TriangleMesh;

/// Removes the vertices whose density is below the `quantile` of all densities, with their triangles,
/// as in range-mcl (Chen et al., ICRA 2021). Returns the number of removed triangles.
pub fn trim_by_density(mesh: &mut TriangleMesh, densities: &[f32], quantile: f64) -> usize {
    let Some(limit) = quantile_of(densities, quantile) else {
        return 0;
    };
    mesh.retain_triangles(|_, triangle| triangle.iter().all(|&v| densities[v as usize] >= limit))
}

/// Removes the triangles with a vertex that is farther from every sample than `largest_m` at its position, or than `least_m`
/// where that is more [m]; returns their number.
pub fn trim_by_distance(
    mesh: &mut TriangleMesh,
    samples: &[Vec3],
    least_m: f32,
    largest_m: impl Fn(Vec3) -> f32 + Sync,
) -> usize {
    /// Largest radius in cells of the grid: beyond it too many columns are looked at.
    const CELLS: f32 = 8.0;
    let radii_m: Vec<f32> = (mesh.vertices.par_iter())
        .map(|&vertex| largest_m(vertex).max(least_m))
        .collect();
    let widest_m = radii_m.iter().copied().fold(least_m, f32::max);
    let grid = SampleGrid::new(samples, least_m.max(widest_m / CELLS));
    let is_near: Vec<bool> = (mesh.vertices.par_iter().zip(&radii_m))
        .map(|(&vertex, &radius_m)| grid.has_sample_within(vertex, radius_m))
        .collect();
    mesh.retain_triangles(|_, triangle| triangle.iter().all(|&v| is_near[v as usize]))
}

/// The quantile of values, interpolated as in NumPy; `None` without values.
fn quantile_of(values: &[f32], quantile: f64) -> Option<f32> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    let position = quantile.clamp(0.0, 1.0) * (sorted.len().checked_sub(1)?) as f64;
    let low = sorted[position.floor() as usize];
    let high = sorted[position.ceil() as usize];
    Some(low + (high - low) * position.fract() as f32)
}

/// Samples in grid cells.
struct SampleGrid {
    /// Cell and position of each sample, ascending in cell.
    samples: Vec<([i32; 3], Vec3)>,
    cell_m: f32,
}

impl SampleGrid {
    fn new(samples: &[Vec3], cell_m: f32) -> Self {
        let mut samples: Vec<_> = (samples.par_iter())
            .filter(|sample| sample.is_finite())
            .map(|&sample| (cell_of(sample, cell_m), sample))
            .collect();
        samples.par_sort_unstable_by_key(|&(cell, _)| cell);
        Self { samples, cell_m }
    }

    fn has_sample_within(&self, point: Vec3, radius_m: f32) -> bool {
        let [first, last] =
            [-radius_m, radius_m].map(|offset| cell_of(point + offset, self.cell_m));
        (first[0]..=last[0]).any(|x| {
            (first[1]..=last[1]).any(|y| {
                // Cells along z are contiguous.
                let start = (self.samples).partition_point(|&(cell, _)| cell < [x, y, first[2]]);
                (self.samples[start..].iter())
                    .take_while(|&&(cell, _)| cell <= [x, y, last[2]])
                    .any(|(_, sample)| sample.distance_squared(point) <= radius_m * radius_m)
            })
        })
    }
}

fn cell_of(point: Vec3, edge_m: f32) -> [i32; 3] {
    (point / edge_m).floor().as_ivec3().to_array()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A strip of triangles along x, one vertex pair per meter.
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
    fn the_sparsest_tenth_of_the_vertices_is_removed() {
        let mut mesh = strip(50);
        let densities: Vec<f32> = mesh.vertices.iter().map(|v| v.x).collect();
        let dropped = trim_by_density(&mut mesh, &densities, 0.1);
        // Vertices at x < 4.9 are removed: of the 98 triangles those of the first five meters.
        assert_eq!(dropped, 10);
        assert_eq!(mesh.vertices.len(), 90);
        assert!(mesh.vertices.iter().all(|vertex| vertex.x >= 4.9));
    }

    #[test]
    fn quantile_zero_and_an_empty_surface_remove_nothing() {
        assert_eq!(trim_by_density(&mut strip(5), &[1.0; 10], 0.0), 0);
        assert_eq!(trim_by_density(&mut TriangleMesh::default(), &[], 0.5), 0);
    }

    #[test]
    fn triangles_remain_if_all_their_vertices_are_near_a_sample() {
        let mut mesh = strip(20);
        let samples: Vec<Vec3> = (0..5).map(|x| Vec3::new(x as f32, 0.5, 0.0)).collect();
        let dropped = trim_by_distance(&mut mesh, &samples, 0.51, |_| 0.0);
        assert_eq!(dropped, 38 - 8);
        assert!(mesh.vertices.iter().all(|vertex| vertex.x <= 4.0));
        assert_eq!(trim_by_distance(&mut mesh, &[], 0.5, |_| 0.0), 8);
        assert!(mesh.vertices.is_empty());
    }

    #[test]
    fn the_largest_distance_is_that_of_the_place() {
        let mut mesh = strip(40);
        // One sample per five metres.
        let samples: Vec<Vec3> = (0..9)
            .map(|i| Vec3::new(5.0 * i as f32, 0.5, 0.0))
            .collect();
        let largest_m = |place: Vec3| if place.x < 20.0 { 0.0 } else { 2.1 };
        trim_by_distance(&mut mesh, &samples, 0.51, largest_m);
        // Triangles are a metre long, so that single vertices near a sample keep none.
        let kept: Vec<f32> = mesh.vertices.iter().map(|vertex| vertex.x).collect();
        assert!(kept.iter().all(|&x| x >= 20.0), "{kept:?}");
        assert_eq!(kept.len(), 40);
    }
}
