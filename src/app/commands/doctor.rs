//! `doctor`: instruction sets, graphics adapters and rendering speed of this machine.

use std::collections::BTreeMap;
use std::env::consts::{ARCH, OS};
use std::sync::Arc;
use std::thread::available_parallelism;
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Args;
use nalgebra::Vector3;

use crate::app::run::memory;
use crate::app::run::{Context, Printed, version};
use crate::geometry::{Pose3, TriangleMesh};
use crate::lidar::{Beam, LidarModel, RangeImage};
use crate::localization::observation::ObservationConfig;
use crate::map::TileConfig;
use crate::map::tiles::grid;
use crate::memory::MemoryBudget;
use crate::raycasting::{Scene, TileError};
use crate::rendering::backend::{AdapterReport, best_adapter};
use crate::rendering::{
    Backend, CpuRenderer, RangeDifference, RangeRenderer, RenderError, RenderingMethod, selection,
};
use crate::simulation::{Simulation, SimulationConfig};

/// Arguments of `doctor`.
#[derive(Clone, Debug, Args)]
pub struct DoctorArgs {
    /// Duration of the ray-casting measurement; 0 for none
    #[arg(long, value_name = "SECONDS", default_value_t = 10)]
    pub measure: u64,
}

/// Number of images that are compared at once.
const IMAGES: usize = 8;
/// Number of particles that are compared at once, and of beams of each, as while a search converges.
const PARTICLES: usize = 1000;
const BEAMS: usize = 600;

/// What and how much.
type Row = (&'static str, String);

/// The properties of this machine, one per line.
pub fn run(args: &DoctorArgs, context: &Context) -> Result<Printed> {
    let choice = selection::choose(Backend::Auto, RenderingMethod::Auto)?;
    let processors = available_parallelism().map_or("unknown".to_owned(), |n| n.to_string());
    let graphics = if cfg!(feature = "gpu") {
        "built in"
    } else {
        "not built in; build with the feature gpu"
    };
    let mut rows: Vec<Row> = vec![
        ("fpmcl", version::VERSION.to_owned()),
        ("system", format!("{OS} on {ARCH}")),
        ("instruction sets", instruction_sets()),
        ("processors", processors),
        ("threads in use", context.threads.to_string()),
        ("graphics support", graphics.to_owned()),
    ];
    rows.extend(choice.adapters.iter().map(|it| ("adapter", adapter(it))));
    rows.push((
        "backend auto",
        format!("{}, because {}", choice.name(), choice.reason),
    ));
    if args.measure > 0 {
        let time = Duration::from_secs(args.measure);
        rows.extend(measurements(time, &choice.adapters)?);
    }
    let table = (rows.iter()).map(|(what, value)| format!("{what:<18}{value}\n"));
    let json: BTreeMap<&str, Vec<&str>> =
        rows.iter()
            .fold(BTreeMap::new(), |mut json, (what, value)| {
                // A machine may have several adapters.
                json.entry(*what).or_default().push(value);
                json
            });
    Printed::text(table.collect::<String>()).with_json(&json)
}

/// An adapter, its driver, and the reason if it cannot be used.
fn adapter(report: &AdapterReport) -> String {
    let obstacle = report
        .obstacle
        .map(|obstacle| format!("; not usable: {obstacle}"));
    format!(
        "{report}, driver {}, {} MiB per binding, {} MiB per buffer, textures of {} pixels{}",
        report.driver,
        report.max_binding_bytes >> 20,
        report.max_buffer_bytes >> 20,
        report.max_texture_size,
        obstacle.unwrap_or_default()
    )
}

/// Rays per second of the CPU and of the best graphics adapter, if there is one, and how far apart the weights are that they
/// give particles.
fn measurements(time: Duration, adapters: &[AdapterReport]) -> Result<Vec<Row>> {
    let workload = Workload::new()?;
    let cpu = workload.renderer(Backend::Cpu, RenderingMethod::Cast)?;
    let has_adapter = best_adapter(adapters, Backend::Gpu).is_some();
    let time = time / if has_adapter { 5 } else { 2 };
    let mut rows = vec![
        ("rays", workload.images("cast", time, &*cpu)?),
        ("rays", workload.beams(time, &*cpu)?),
    ];
    if !has_adapter {
        return Ok(rows);
    }
    let gpu = workload.renderer(Backend::Gpu, RenderingMethod::Cast)?;
    rows.push(("rays", workload.images("cast", time, &*gpu)?));
    rows.push(("rays", workload.beams(time, &*gpu)?));
    let rasterized = match workload.renderer(Backend::Gpu, RenderingMethod::Raster) {
        Ok(gpu) => workload.images("rasterized", time, &*gpu)?,
        Err(error) => error.to_string(),
    };
    rows.push(("rays", rasterized));
    rows.push(("weights", workload.weights(&*cpu, &*gpu)?));
    Ok(rows)
}

/// The simulated street, a scan of it, and particles around its pose.
struct Workload {
    scene: Arc<Scene<TileError>>,
    triangles: usize,
    scan: RangeImage,
    /// Every few pixels of it.
    beams: Vec<Beam>,
    particles: Vec<Pose3>,
    observation: ObservationConfig,
}

impl Workload {
    fn new() -> Result<Self> {
        let simulation = Simulation::new(&SimulationConfig::default(), None, memory::budget())?;
        let mut street = simulation.street.surface.mesh.clone();
        street.snap();
        let tiles = grid::cut(&street, TileConfig::default().side_m);
        let tiles: Vec<TriangleMesh> = tiles.into_iter().map(|(_, tile)| tile).collect();
        let (poses, model) = (simulation.poses(), LidarModel::default());
        let pose = poses[poses.len() / 2];
        let scene = Arc::new(Scene::of_tiles(&tiles));
        let cpu = CpuRenderer::over(scene.clone());
        let ranges = cpu.render(&[pose], &model)?.concat();
        let scan = RangeImage::from_ranges(ranges, &model);
        let every = (scan.beams().count() / BEAMS).max(1);
        // Evenly spread (Weyl sequences).
        let spread = |number: usize, step: f64| (number as f64 * step).fract() - 0.5;
        let particle = |number| {
            let [x, y, turn] = [0.755, 0.570, 0.618].map(|step| spread(number, step));
            pose * Pose3::new(Vector3::new(x, y, 0.0), Vector3::z() * (0.05 * turn))
        };
        Ok(Self {
            triangles: street.triangles.len(),
            beams: scan.beams().step_by(every).collect(),
            scan,
            scene,
            particles: (0..PARTICLES).map(particle).collect(),
            observation: ObservationConfig::default(),
        })
    }

    fn renderer(
        &self,
        backend: Backend,
        method: RenderingMethod,
    ) -> Result<Arc<dyn RangeRenderer>, RenderError> {
        let choice = selection::choose(backend, method)?;
        choice.renderer(self.scene.clone(), MemoryBudget::default())
    }

    /// Speed with which whole images are compared.
    fn images(&self, how: &str, time: Duration, renderer: &dyn RangeRenderer) -> Result<String> {
        let (poses, unlimited) = (&self.particles[..IMAGES], RangeDifference::UNLIMITED);
        let pixels = self.scan.beams().count();
        let rays = rays_per_second(time, poses.len() * pixels, || {
            renderer.compare_images(poses, &self.scan, &unlimited)
        })?;
        Ok(format!(
            "{:.2} M per second, images of {} x {} {how}, {:.2} ms each, in a street of {} triangles by {}",
            1e-6 * rays,
            self.scan.model.height,
            self.scan.model.width,
            1e3 * pixels as f64 / rays,
            self.triangles,
            renderer.name()
        ))
    }

    /// Speed with which beams are compared.
    fn beams(&self, time: Duration, renderer: &dyn RangeRenderer) -> Result<String> {
        let difference = self.observation.difference();
        let count = self.particles.len() * self.beams.len();
        let rays = rays_per_second(time, count, || {
            renderer.compare(&self.particles, &self.beams, &difference)
        })?;
        Ok(format!(
            "{:.2} M per second, {} beams of each of {} particles, {:.2} ms, by {}",
            1e-6 * rays,
            self.beams.len(),
            self.particles.len(),
            1e3 * count as f64 / rays,
            renderer.name()
        ))
    }

    /// How far apart the likelihoods of the particles are by two renderers.
    fn weights(&self, cpu: &dyn RangeRenderer, gpu: &dyn RangeRenderer) -> Result<String> {
        let difference = self.observation.difference();
        let logs = |renderer: &dyn RangeRenderer| -> Result<Vec<f64>> {
            let costs_m = renderer.compare(&self.particles, &self.beams, &difference)?;
            let logs = costs_m.into_iter().map(f64::from);
            Ok(logs
                .map(|cost_m| self.observation.log_likelihood(cost_m))
                .collect())
        };
        let (cpu, gpu) = (logs(cpu)?, logs(gpu)?);
        let mut apart: Vec<f64> = cpu.iter().zip(&gpu).map(|(a, b)| (a - b).abs()).collect();
        apart.sort_by(f64::total_cmp);
        // A beam that passes an edge within rounding may end on either side of it.
        let per_cent = |share: usize| 100.0 * apart[(apart.len() - 1) * share / 100].exp_m1();
        Ok(format!(
            "of 99 % of the particles within {:.3} % of those of the CPU, of all within {:.3} %",
            per_cent(99),
            per_cent(100)
        ))
    }
}

/// Rays per second of work with a number of rays, repeated for a time.
fn rays_per_second<T>(
    time: Duration,
    rays: usize,
    work: impl Fn() -> Result<T, RenderError>,
) -> Result<f64> {
    // Drivers finish shaders with their first use.
    work()?;
    let (start, mut times) = (Instant::now(), 0);
    while times == 0 || start.elapsed() < time {
        work()?;
        times += 1;
    }
    Ok((rays * times) as f64 / start.elapsed().as_secs_f64())
}

/// The vector instructions that the ray caster can use.
fn instruction_sets() -> String {
    #[cfg(target_arch = "x86_64")]
    let candidates = [
        ("sse4.2", is_x86_feature_detected!("sse4.2")),
        ("avx", is_x86_feature_detected!("avx")),
        ("avx2", is_x86_feature_detected!("avx2")),
        ("fma", is_x86_feature_detected!("fma")),
        ("avx512f", is_x86_feature_detected!("avx512f")),
    ];
    #[cfg(target_arch = "aarch64")]
    let candidates = [("neon", std::arch::is_aarch64_feature_detected!("neon"))];
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let candidates = [("", false); 0];
    let found: Vec<&str> = candidates
        .into_iter()
        .filter_map(|(name, is_available)| is_available.then_some(name))
        .collect();
    if found.is_empty() {
        return "none that the ray caster uses".to_owned();
    }
    found.join(", ")
}
