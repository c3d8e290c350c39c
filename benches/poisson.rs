//! Screened Poisson reconstruction of a synthetic street: 50 k, 200 k and 1 M points, noise 2 cm.
//!
//! ```text
//! cargo bench --bench poisson                                      times, all sizes
//! FPMCL_POISSON=1000000,9 RAYON_NUM_THREADS=2 cargo bench --bench poisson
//!                                                                  one run: time, peak memory, error, coverage
//! FPMCL_POISSON_PLY=/tmp/street cargo bench --bench poisson        writes the clouds to /tmp/street_N.ply
//! ```
//!
//! Open3D 0.20 on the same points:
//!
//! ```text
//! import sys, time, resource, open3d as o3d
//! cloud = o3d.io.read_point_cloud(sys.argv[1])                     # /tmp/street_1000000.ply
//! wall, cpu = time.time(), time.process_time()
//! mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
//!     cloud, depth=int(sys.argv[2]), scale=1.1, linear_fit=False, n_threads=2)
//! print(time.time() - wall, time.process_time() - cpu,
//!       resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "MB", len(mesh.triangles))
//! o3d.io.write_triangle_mesh(sys.argv[3], mesh)                    # evaluated by FPMCL_POISSON_MESH=...
//! ```

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench stops at the first error and prints its measurements"
)]

mod process;

use std::path::Path;
use std::time::Instant;

use fpmcl::geometry::{PointCloud, TriangleMesh};
use fpmcl::internals::ply;
use fpmcl::memory::MemoryBudget;
use fpmcl::meshing::{PoissonConfig, reconstruct};
use glam::Vec3;
use rand::{RngExt, SeedableRng, rngs::StdRng};
use rand_distr::{Distribution, StandardNormal};

const SIZES: [usize; 3] = [50_000, 200_000, 1_000_000];
const NOISE_M: f32 = 0.02;

fn main() {
    if let Ok(stem) = std::env::var("FPMCL_POISSON_PLY") {
        for count in SIZES {
            let cloud = noisy_street(count);
            let points = TriangleMesh {
                vertices: cloud.positions,
                normals: cloud.normals,
                ..TriangleMesh::default()
            };
            ply::write(Path::new(&format!("{stem}_{count}.ply")), &points, None).unwrap();
        }
    } else if let Ok(job) = std::env::var("FPMCL_POISSON") {
        let (count, depth) = job.split_once(',').expect("FPMCL_POISSON=points,depth");
        run_once(count.parse().unwrap(), depth.parse().unwrap());
    } else if let Ok(path) = std::env::var("FPMCL_POISSON_MESH") {
        evaluate(&ply::read(Path::new(&path)).unwrap());
    } else {
        divan::main();
    }
}

#[divan::bench(args = SIZES, sample_count = 3, sample_size = 1)]
fn depth_8(bencher: divan::Bencher<'_, '_>, count: usize) {
    let cloud = noisy_street(count);
    let config = PoissonConfig {
        depth: Some(8),
        ..PoissonConfig::default()
    };
    bencher.bench_local(|| reconstruct(&cloud, &config, MemoryBudget::default()).unwrap());
}

#[divan::bench(args = SIZES, sample_count = 3, sample_size = 1)]
fn depth_9(bencher: divan::Bencher<'_, '_>, count: usize) {
    let cloud = noisy_street(count);
    let config = PoissonConfig {
        depth: Some(9),
        ..PoissonConfig::default()
    };
    bencher.bench_local(|| reconstruct(&cloud, &config, MemoryBudget::default()).unwrap());
}

/// A rectangle of the street: a corner and two edges.
struct Panel(Vec3, Vec3, Vec3);

impl Panel {
    fn normal(&self) -> Vec3 {
        self.1.cross(self.2).normalize()
    }
    fn area(&self) -> f32 {
        self.1.cross(self.2).length()
    }
    fn point(&self, u: f32, v: f32) -> Vec3 {
        self.0 + u * self.1 + v * self.2
    }
    fn distance(&self, point: Vec3) -> f32 {
        let d = point - self.0;
        let u = (d.dot(self.1) / self.1.length_squared()).clamp(0.0, 1.0);
        let v = (d.dot(self.2) / self.2.length_squared()).clamp(0.0, 1.0);
        point.distance(self.point(u, v))
    }
}

/// A street of 100 m: road, kerbs, pavements, house fronts with recesses, parked cars, poles.
fn panels() -> Vec<Panel> {
    let v = Vec3::new;
    let mut all = vec![
        Panel(v(-50., -6., 0.), v(100., 0., 0.), v(0., 12., 0.)),
        Panel(v(-50., 6., 0.12), v(100., 0., 0.), v(0., 4., 0.)),
        Panel(v(-50., -10., 0.12), v(100., 0., 0.), v(0., 4., 0.)),
        Panel(v(-50., 6., 0.), v(100., 0., 0.), v(0., 0., 0.12)),
        Panel(v(-50., -6., 0.12), v(100., 0., 0.), v(0., 0., -0.12)),
    ];
    for house in 0..10 {
        let x = -50. + 10. * house as f32;
        let recess = if house % 2 == 0 { 0.0 } else { 2.0 };
        all.push(Panel(
            v(x, 10. + recess, 0.12),
            v(10., 0., 0.),
            v(0., 0., 9.),
        ));
        all.push(Panel(
            v(x + 10., -10. - recess, 0.12),
            v(-10., 0., 0.),
            v(0., 0., 9.),
        ));
    }
    for car in 0..8 {
        let (x, y) = (
            -45. + 12. * car as f32,
            if car % 2 == 0 { 3.5 } else { -5.3 },
        );
        add_box(&mut all, v(x, y, 0.0), v(4.2, 1.8, 1.5));
    }
    for pole in 0..12 {
        let (x, y) = (
            -47. + 8. * pole as f32,
            if pole % 2 == 0 { 6.8 } else { -7.2 },
        );
        add_box(&mut all, v(x, y, 0.12), v(0.3, 0.3, 5.));
    }
    all
}

/// The four sides and the top of a box, normals outwards.
fn add_box(all: &mut Vec<Panel>, low: Vec3, size: Vec3) {
    let (x, y, z) = (Vec3::X * size.x, Vec3::Y * size.y, Vec3::Z * size.z);
    all.push(Panel(low, x, z));
    all.push(Panel(low + x, y, z));
    all.push(Panel(low + x + y, -x, z));
    all.push(Panel(low + y, -y, z));
    all.push(Panel(low + z, x, y));
}

/// Points distributed uniformly over all panels, with normals.
fn sample_panels(count: usize, rng: &mut StdRng) -> Vec<(Vec3, Vec3)> {
    let panels = panels();
    let areas: Vec<f32> = panels.iter().map(Panel::area).collect();
    let chooser = rand::distr::weighted::WeightedIndex::new(&areas).unwrap();
    (0..count)
        .map(|_| {
            let panel = &panels[chooser.sample(rng)];
            (panel.point(rng.random(), rng.random()), panel.normal())
        })
        .collect()
}

fn noisy_street(count: usize) -> PointCloud {
    let mut rng = StdRng::seed_from_u64(count as u64);
    let mut cloud = PointCloud::with_capacity(count);
    for (point, normal) in sample_panels(count, &mut rng) {
        let mut gauss = || -> f32 { StandardNormal.sample(&mut rng) };
        let noise = NOISE_M * Vec3::new(gauss(), gauss(), gauss());
        let tilt = 0.05 * Vec3::new(gauss(), gauss(), gauss());
        cloud.push(point + noise, (normal + tilt).normalize(), 0.0);
    }
    cloud
}

fn run_once(count: usize, depth: u32) {
    let cloud = noisy_street(count);
    let config: PoissonConfig = PoissonConfig {
        depth: Some(depth),
        iterations: parse_env("ITERATIONS", PoissonConfig::default().iterations),
        point_weight: parse_env("POINT_WEIGHT", PoissonConfig::default().point_weight),
        samples_per_node: parse_env(
            "SAMPLES_PER_NODE",
            PoissonConfig::default().samples_per_node,
        ),
        ..PoissonConfig::default()
    };
    let (start, cpu) = (Instant::now(), cpu_s());
    let surface = reconstruct(&cloud, &config, MemoryBudget::default()).unwrap();
    println!(
        "{count} points, depth {depth}: {:.2} s wall, {:.2} s CPU, peak {} MB, {} triangles",
        start.elapsed().as_secs_f64(),
        cpu_s() - cpu,
        process::memory_mib("VmHWM"),
        surface.mesh.triangles.len()
    );
    evaluate(&surface.mesh);
    if let Ok(path) = std::env::var("FPMCL_POISSON_OUT") {
        ply::write(Path::new(&path), &surface.mesh, None).unwrap();
    }
}

fn parse_env<T: std::str::FromStr>(name: &str, default: T) -> T {
    let value = std::env::var(name).ok();
    value
        .and_then(|value| value.parse().ok())
        .unwrap_or(default)
}

/// Prints the error, the distance of the vertices to the true surface, and the coverage, the share of the
/// true surface within 0.1 m of the mesh.
fn evaluate(mesh: &TriangleMesh) {
    let panels = panels();
    let step = (mesh.vertices.len() / 200_000).max(1);
    let mut errors: Vec<f32> = (mesh.vertices.iter().step_by(step))
        .map(|&vertex| {
            let distances = panels.iter().map(|panel| panel.distance(vertex));
            distances.fold(f32::INFINITY, f32::min)
        })
        .filter(|&error| error < 0.5)
        .collect();
    errors.sort_by(f32::total_cmp);
    let truth = sample_panels(100_000, &mut StdRng::seed_from_u64(9));
    let covered = count_covered(mesh, &truth, 0.1);
    println!(
        "median error {:.1} mm, 90 % within {:.1} mm; {:.2} % of the true surface within 0.1 m",
        1e3 * errors[errors.len() / 2],
        1e3 * errors[errors.len() * 9 / 10],
        100.0 * covered as f64 / truth.len() as f64
    );
}

/// Number of points with a triangle within a distance.
fn count_covered(mesh: &TriangleMesh, points: &[(Vec3, Vec3)], max_distance_m: f32) -> usize {
    const CELL_M: f32 = 0.4;
    let cell = |point: Vec3| (point / CELL_M).floor().as_ivec3();
    let mut triangles: std::collections::HashMap<glam::IVec3, Vec<u32>> = Default::default();
    for index in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.corners(index);
        let low = cell(a.min(b).min(c) - max_distance_m);
        let high = cell(a.max(b).max(c) + max_distance_m);
        if (high - low).max_element() > 40 {
            continue;
        }
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                for x in low.x..=high.x {
                    let cell = glam::IVec3::new(x, y, z);
                    triangles.entry(cell).or_default().push(index as u32);
                }
            }
        }
    }
    let is_near = |point: Vec3| {
        triangles.get(&cell(point)).is_some_and(|near| {
            (near.iter()).any(|&index| {
                distance_to_triangle(point, mesh.corners(index as usize)) < max_distance_m
            })
        })
    };
    points.iter().filter(|(point, _)| is_near(*point)).count()
}

fn distance_to_triangle(p: Vec3, [a, b, c]: [Vec3; 3]) -> f32 {
    let normal = (b - a).cross(c - a).normalize_or_zero();
    let inside = [(a, b), (b, c), (c, a)]
        .iter()
        .all(|(s, e)| (e - s).cross(p - s).dot(normal) >= 0.0);
    if inside && normal != Vec3::ZERO {
        return (p - a).dot(normal).abs();
    }
    [(a, b), (b, c), (c, a)]
        .iter()
        .fold(f32::INFINITY, |nearest, (s, e)| {
            let t = ((p - s).dot(e - s) / (e - s).length_squared().max(1e-20)).clamp(0.0, 1.0);
            nearest.min(p.distance(s + t * (e - s)))
        })
}

/// CPU seconds of this process, all threads (Linux; 0 elsewhere).
fn cpu_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat
        .rsplit(')')
        .next()
        .unwrap_or("")
        .split_whitespace()
        .collect();
    let ticks = |i: usize| {
        fields
            .get(i)
            .and_then(|f| f.parse::<f64>().ok())
            .unwrap_or(0.0)
    };
    (ticks(11) + ticks(12)) / 100.0
}
