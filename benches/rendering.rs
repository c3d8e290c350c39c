//! CPU renderer on a street of 1.3 million triangles: rays per second of images and comparisons, and
//! build time of the bounding volume hierarchy.
//!
//! ```text
//! cargo bench --bench rendering
//! ```
//!
//! Comparison with Embree on the same mesh and rays: with `FPMCL_BENCH_DIR`, the bench writes them to
//! that folder first, and Open3D casts them,
//!
//! ```text
//! FPMCL_BENCH_DIR=/tmp/rays cargo bench --bench rendering -- images
//! python benches/embree.py /tmp/rays
//! ```
//!
//! alternately (A B A B) on an otherwise idle machine. Embree casts the rays in the order of the
//! beams and computes the nearest hit of each; a comparison may stop earlier.

mod street;

use std::path::Path;

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use fpmcl::geometry::{Pose3, Vec3};
use fpmcl::internals::CpuRenderer;
use fpmcl::internals::Rigid3f;
use fpmcl::internals::Scene;
use fpmcl::internals::ply;
use fpmcl::lidar::{Beam, LidarModel};
use fpmcl::rendering::{RangeDifference, RangeRenderer as _};
use npyz::WriterBuilder as _;
use rayon::{ThreadPool, ThreadPoolBuilder};

const SEED: u64 = 7;
const THREADS: [usize; 2] = [1, 2];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    if let Some(folder) = std::env::var_os("FPMCL_BENCH_DIR") {
        write_rays(Path::new(&folder))?;
    }
    divan::main();
    Ok(())
}

/// Writes the street and the rays of the benches for another ray caster.
fn write_rays(folder: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let renderer = renderer();
    std::fs::create_dir_all(folder)?;
    ply::write(&folder.join("street.ply"), &street::street(SEED), None)?;
    let pixels = LidarModel::default().directions();
    let few = directions_of(&beams(&renderer, truth(), 500));
    let many = directions_of(&beams(&renderer, truth(), 3600));
    for (name, poses, directions) in [
        ("images", poses(), &pixels),
        ("compare_100_close_poses_3600_beams", close_poses(), &many),
        ("compare_100_poses_3600_beams", tracked_poses(), &many),
        ("compare_10000_near_poses_500_beams", near_poses(), &few),
        ("compare_10000_poses_500_beams", all_poses(), &few),
    ] {
        let file = std::fs::File::create(folder.join(format!("{name}.npy")))?;
        let mut array = npyz::WriteOptions::new()
            .default_dtype()
            .writer(std::io::BufWriter::new(file))
            .begin_2d(6)?;
        array.extend(rays(&poses, directions).into_flattened())?;
        array.finish()?;
    }
    Ok(())
}

fn directions_of(beams: &[Beam]) -> Vec<Vec3> {
    beams.iter().map(|beam| beam.direction).collect()
}

/// Origin and unit direction of each ray, ordered by pose.
fn rays(poses: &[Pose3], directions: &[Vec3]) -> Vec<[f32; 6]> {
    let mut rays = Vec::with_capacity(poses.len() * directions.len());
    for pose in poses {
        let map_from_lidar = Rigid3f::from(pose);
        let t = pose.translation.vector.cast::<f32>();
        rays.extend(directions.iter().map(|direction| {
            let d = map_from_lidar.rotate(*direction);
            [t.x, t.y, t.z, d.x, d.y, d.z]
        }));
    }
    rays
}

/// Full images at eight poses.
#[divan::bench(args = THREADS, sample_count = 10)]
fn images(bencher: Bencher, threads: usize) {
    let (renderer, poses, model) = (renderer(), poses(), LidarModel::default());
    let pool = pool(threads);
    bencher
        .counter(ItemsCount::new(poses.len() * model.len()))
        .bench(|| pool.install(|| renderer.render(black_box(&poses), &model)));
}

/// Every fourth row and column.
#[divan::bench(args = THREADS, sample_count = 10)]
fn strided_images(bencher: Bencher, threads: usize) {
    let model = LidarModel {
        height: 16,
        width: 225,
        ..LidarModel::default()
    };
    let (renderer, poses) = (renderer(), poses());
    let pool = pool(threads);
    bencher
        .counter(ItemsCount::new(poses.len() * model.len()))
        .bench(|| pool.install(|| renderer.render(black_box(&poses), &model)));
}

/// Tracking: poses within centimetres of the truth.
#[divan::bench(args = THREADS, sample_count = 10)]
fn compare_100_close_poses_3600_beams(bencher: Bencher, threads: usize) {
    compare(bencher, threads, &close_poses(), 3600);
}

/// Poses within a metre of the truth.
#[divan::bench(args = THREADS, sample_count = 10)]
fn compare_100_poses_3600_beams(bencher: Bencher, threads: usize) {
    compare(bencher, threads, &tracked_poses(), 3600);
}

/// Initialization within a few metres of the truth.
#[divan::bench(args = THREADS, sample_count = 3)]
fn compare_10000_near_poses_500_beams(bencher: Bencher, threads: usize) {
    compare(bencher, threads, &near_poses(), 500);
}

/// Global initialization: poses over the whole street.
#[divan::bench(args = THREADS, sample_count = 3)]
fn compare_10000_poses_500_beams(bencher: Bencher, threads: usize) {
    compare(bencher, threads, &all_poses(), 500);
}

#[divan::bench(args = THREADS, sample_count = 3)]
fn build(bencher: Bencher, threads: usize) {
    let mesh = street::street(SEED);
    let pool = pool(threads);
    bencher
        .counter(ItemsCount::new(mesh.triangles.len()))
        .bench(|| pool.install(|| Scene::new(black_box(&mesh))));
}

fn compare(bencher: Bencher, threads: usize, poses: &[Pose3], count: usize) {
    let renderer = renderer();
    let beams = beams(&renderer, truth(), count);
    let difference = RangeDifference::truncated(0.5);
    let pool = pool(threads);
    bencher
        .counter(ItemsCount::new(poses.len() * beams.len()))
        .bench(|| pool.install(|| renderer.compare(black_box(poses), &beams, &difference)));
}

fn pool(threads: usize) -> ThreadPool {
    let pool = ThreadPoolBuilder::new().num_threads(threads);
    pool.build().expect("threads can be started")
}

fn renderer() -> CpuRenderer {
    let mut street = street::street(SEED);
    street.snap();
    CpuRenderer::new(&street::tiles(&street, 100.0))
}

fn at(position: Vec3) -> Pose3 {
    Pose3::translation(position.x.into(), position.y.into(), position.z.into())
}

fn poses() -> Vec<Pose3> {
    (0..8_u8)
        .map(f32::from)
        .map(|i| at(street::on_the_road(0.1 + 0.1 * i, 0.7 * i - 2.0)))
        .collect()
}

fn close_poses() -> Vec<Pose3> {
    around(100, 0.1, 0.2, 0.03)
}

fn tracked_poses() -> Vec<Pose3> {
    around(100, 1.0, 2.0, 1.0)
}

fn near_poses() -> Vec<Pose3> {
    around(10_000, 5.0, 10.0, 1.0)
}

fn all_poses() -> Vec<Pose3> {
    around(10_000, 100.0, 2.0, 1.0)
}

/// Position at which the beams are measured.
fn truth() -> Vec3 {
    street::on_the_road(0.5, 0.0)
}

/// Poses within `along_m` of the middle of the street, in a strip of `width_m`, with a range of
/// headings of `turn_rad`, from a low-discrepancy (Weyl) sequence.
fn around(count: usize, along_m: f64, width_m: f64, turn_rad: f64) -> Vec<Pose3> {
    let spread = |number: usize, step: f64| (number as f64 * step).fract() - 0.5;
    (0..count)
        .map(|number| {
            let along = 0.5 + 2.0 * along_m / 300.0 * spread(number, 0.754_877_666);
            let lateral_m = width_m * spread(number, 0.569_840_291);
            at(street::on_the_road(along as f32, lateral_m as f32))
                * Pose3::rotation(
                    nalgebra::Vector3::z() * (turn_rad * spread(number, 0.618_033_989)),
                )
        })
        .collect()
}

/// About `count` beams, evenly distributed over the image at a position.
fn beams(renderer: &CpuRenderer, position: Vec3, count: usize) -> Vec<Beam> {
    let columns = (count as f32 * 900.0 / 64.0).sqrt();
    let model = LidarModel {
        width: columns as usize,
        height: (count as f32 / columns) as usize,
        ..LidarModel::default()
    };
    let image = renderer.render(&[at(position)], &model);
    let ranges = image.expect("the CPU always renders").concat();
    std::iter::zip(model.directions(), ranges)
        .filter(|(_, range_m)| range_m.is_finite())
        .map(|(direction, range_m)| Beam { direction, range_m })
        .collect()
}
