//! Points on the surface of a mesh: evenly by area, without randomness.
//!
//! The triangles are laid end to end along a Z-order curve through their centroids, each on an interval as long as its
//! area in squares of the spacing, and larger ones are bisected down to one square. Sample k is in the piece with the
//! position k + ½:
//!
//! ```text
//! number of samples = round(Σ area / spacing²)
//! ```
//!
//! Pieces that follow each other on the curve are neighbours, so that the number of samples on any part of the curve, such
//! as a whole triangle, differs by less than one from its area in squares. Systematic sampling along a curve: Stevens and
//! Olsen, *Spatially Balanced Sampling of Natural Resources* (2004); bisection of the longest edge: Rivara,
//! *Algorithms for refining triangular grids* (1984).

use glam::Vec3;
use rayon::prelude::*;

use super::mesh::TriangleMesh;
use super::morton;

/// Memory of [`sample_surface`] per triangle [bytes].
pub const TRIANGLE_BYTES: usize = size_of::<(u64, u32)>();

/// Area of all triangles [m²].
pub fn surface_area_m2(mesh: &TriangleMesh) -> f64 {
    let triangles = 0..mesh.triangles.len();
    triangles.map(|index| area_m2(mesh.corners(index))).sum()
}

/// Samples the surface with one point per square of the spacing [m], which must be greater than 0. Equal meshes give
/// equal points in the same order.
pub fn sample_surface(mesh: &TriangleMesh, spacing_m: f64) -> Vec<Vec3> {
    let square_m2 = spacing_m * spacing_m;
    let mut samples =
        Vec::with_capacity(samples_before(surface_area_m2(mesh) / square_m2) as usize);
    let mut sum_m2 = 0.0;
    for index in along_curve(mesh) {
        let corners = mesh.corners(index as usize);
        let start = sum_m2 / square_m2;
        sum_m2 += area_m2(corners);
        add_samples(corners, [start, sum_m2 / square_m2], &mut samples);
    }
    samples
}

/// The triangles in the order of the Z-order curve through their centroids.
fn along_curve(mesh: &TriangleMesh) -> impl Iterator<Item = u32> {
    const CELLS: f32 = (1 << 21) as f32;
    let bounds = mesh.bounds();
    let cells_per_m = (CELLS - 1.0) / bounds.size().max_element().max(f32::MIN_POSITIVE);
    let mut order: Vec<(u64, u32)> = (0..mesh.triangles.len() as u32)
        .into_par_iter()
        .map(|index| {
            let position = centroid(mesh.corners(index as usize)) - bounds.min;
            let cell = (cells_per_m * position).as_uvec3();
            (morton::encode(cell.into()), index)
        })
        .collect();
    order.par_sort_unstable();
    order.into_iter().map(|(_, index)| index)
}

/// Adds the samples of a triangle whose interval on the curve is given.
fn add_samples(corners: [Vec3; 3], [start, end]: [f64; 2], samples: &mut Vec<Vec3>) {
    match samples_before(end) - samples_before(start) {
        0 => {}
        1 if end - start <= 1.0 => samples.push(centroid(corners)),
        _ => {
            let [first, second] = bisected(corners);
            let middle = 0.5 * (start + end);
            add_samples(first, [start, middle], samples);
            add_samples(second, [middle, end], samples);
        }
    }
}

/// The number of samples at positions up to the given one.
fn samples_before(position: f64) -> u64 {
    (position + 0.5).floor() as u64
}

/// Halves a triangle at its longest edge.
fn bisected([a, b, c]: [Vec3; 3]) -> [[Vec3; 3]; 2] {
    let halves = |a: Vec3, b: Vec3, c: Vec3| {
        let middle = a + 0.5 * (b - a);
        [[a, middle, c], [middle, b, c]]
    };
    let [ab, bc, ca] = [(a, b), (b, c), (c, a)].map(|(a, b)| a.distance_squared(b));
    if ab >= bc && ab >= ca {
        halves(a, b, c)
    } else if bc >= ca {
        halves(b, c, a)
    } else {
        halves(c, a, b)
    }
}

fn area_m2([a, b, c]: [Vec3; 3]) -> f64 {
    let [a, b, c] = [a, b, c].map(Vec3::as_dvec3);
    0.5 * (b - a).cross(c - a).length()
}

fn centroid([a, b, c]: [Vec3; 3]) -> Vec3 {
    a + ((b - a) + (c - a)) / 3.0
}

#[cfg(test)]
mod tests {
    use glam::Vec3Swizzles as _;

    use super::*;

    const SPACING_M: f64 = 0.2;

    /// A slope of 30 m x 20 m of small triangles, one wall of two large ones, and a sliver; far from the origin.
    fn mesh() -> TriangleMesh {
        const COLUMNS: u32 = 150;
        let origin = Vec3::new(-1200.0, 800.0, 90.0);
        let mut mesh = TriangleMesh::default();
        for row in 0..101 {
            for column in 0..=COLUMNS {
                let (x, y) = (0.2 * column as f32, 0.2 * row as f32);
                mesh.vertices.push(origin + Vec3::new(x, y, 0.3 * x));
            }
        }
        for row in 0..100 {
            for column in 0..COLUMNS {
                let low = row * (COLUMNS + 1) + column;
                let high = low + COLUMNS + 1;
                mesh.triangles.push([low, low + 1, high + 1]);
                mesh.triangles.push([low, high + 1, high]);
            }
        }
        let wall = [
            (0.0, 0.0),
            (30.0, 0.0),
            (30.0, 12.0),
            (0.0, 12.0),
            (15.0, 0.02),
        ];
        let first = mesh.vertices.len() as u32;
        let wall = wall.map(|(x, z)| origin + Vec3::new(x, x, z));
        mesh.vertices.extend(wall);
        let triangles = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [0, 0, 4]];
        mesh.triangles
            .extend(triangles.map(|triangle| triangle.map(|vertex| first + vertex)));
        mesh
    }

    /// Distance from a point to a triangle [m].
    fn distance_m(p: Vec3, [a, b, c]: [Vec3; 3]) -> f32 {
        let normal = (b - a).cross(c - a).normalize_or_zero();
        let outside = [(a, b), (b, c), (c, a)]
            .map(|(s, e)| -(e - s).normalize_or_zero().cross(p - s).dot(normal));
        let farthest = outside.into_iter().fold(0.0, f32::max);
        farthest.max((p - a).dot(normal).abs())
    }

    #[test]
    fn every_sample_is_on_a_triangle_and_the_number_is_the_area_in_squares() {
        let mesh = mesh();
        let samples = sample_surface(&mesh, SPACING_M);
        let squares = surface_area_m2(&mesh) / (SPACING_M * SPACING_M);
        assert!(squares > 20_000.0 && (samples.len() as f64 - squares).abs() <= 1.0);
        for &sample in samples.iter().step_by(37) {
            let distances = (0..mesh.triangles.len()).map(|t| distance_m(sample, mesh.corners(t)));
            let nearest_m = distances.fold(f32::INFINITY, f32::min);
            // Rounding at a coordinate of a kilometre.
            assert!(nearest_m < 5e-4, "{sample} is {nearest_m} m off");
        }
    }

    #[test]
    fn a_part_of_the_surface_has_its_share_of_the_samples_within_its_border() {
        let samples = sample_surface(&mesh(), SPACING_M);
        let slope_m2 = f64::from(Vec3::new(1.0, 0.0, 0.3).length());
        let at = |column: f32, row: f32| Vec3::new(-1200.0 + 5.0 * column, 800.0 + 5.0 * row, 0.0);
        for (column, row) in [(0.0, 2.0), (1.0, 3.0), (4.0, 0.0), (5.0, 1.0)] {
            let (low, high) = (at(column, row), at(column + 1.0, row + 1.0));
            let is_inside =
                |p: &&Vec3| p.xy().cmpge(low.xy()).all() && p.xy().cmplt(high.xy()).all();
            let count = samples.iter().filter(is_inside).count() as f64;
            let expected = 25.0 * slope_m2 / (SPACING_M * SPACING_M);
            // Random samples would have a standard deviation of 4 per cent.
            assert!((count / expected - 1.0).abs() < 0.03, "{count} {expected}");
        }
    }

    #[test]
    fn large_and_small_triangles_have_no_holes_and_no_clusters() {
        let mesh = mesh();
        let samples = sample_surface(&mesh, SPACING_M);
        let nearest_m = |point: Vec3| {
            let others = samples.iter().filter(|&&other| other != point);
            let squares = others.map(|other| other.distance_squared(point));
            squares.fold(f32::INFINITY, f32::min).sqrt()
        };
        for &sample in samples.iter().step_by(211) {
            let nearest_m = nearest_m(sample);
            assert!((0.0..0.5).contains(&nearest_m), "{nearest_m}");
        }
        let wall = mesh.vertices[mesh.vertices.len() - 5];
        for step in 1..60 {
            let along = 0.48 * step as f32;
            let point = wall + Vec3::new(along, along, 3.0 + 0.1 * step as f32);
            let hole_m = nearest_m(point);
            assert!(hole_m < 0.4, "{hole_m}");
        }
    }

    #[test]
    fn samples_do_not_depend_on_the_number_of_threads() {
        let mesh = mesh();
        let with_threads = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let pool = pool.build().unwrap();
            pool.install(|| sample_surface(&mesh, SPACING_M))
        };
        assert!(with_threads(1) == with_threads(3));
    }

    #[test]
    fn a_mesh_without_area_has_no_samples() {
        let mut mesh = TriangleMesh::default();
        assert!(sample_surface(&mesh, SPACING_M).is_empty());
        mesh.vertices = vec![Vec3::ONE; 3];
        mesh.triangles = vec![[0, 1, 2]];
        assert!(sample_surface(&mesh, SPACING_M).is_empty());
    }
}
