//! `doctor`: instruction sets, graphics adapters and rendering speed of this machine.

use std::env::consts::{ARCH, OS};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::thread::available_parallelism;
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Args;
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::Serialize;

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

/// What the program finds on a machine.
#[derive(Debug, Serialize, JsonSchema)]
pub struct MachineReport {
    /// Version of the program.
    fpmcl: &'static str,
    /// Operating system.
    system: &'static str,
    /// Architecture of the processor.
    architecture: &'static str,
    /// Vector instructions that the ray caster can use.
    instruction_sets: Vec<&'static str>,
    /// Number of processors, if it is known.
    processors: Option<usize>,
    /// Number of threads in use.
    threads: usize,
    /// Whether support of graphics adapters is built in.
    has_graphics_support: bool,
    /// Graphics adapters, best first.
    adapters: Vec<AdapterReport>,
    /// The renderer that `--backend auto` selects.
    backend_auto: String,
    /// Why it is selected.
    backend_reason: String,
    /// Measured speeds; empty with `--measure 0`.
    speeds: Vec<Speed>,
    /// Difference of the weights of particles between graphics adapter and CPU.
    weights: Option<WeightDifference>,
}

/// Speed of a renderer.
#[derive(Debug, Serialize, JsonSchema)]
struct Speed {
    /// The renderer.
    renderer: String,
    /// What was rendered and how.
    work: String,
    /// Rays per second.
    rays_per_second: f64,
    /// Time of one image, or of the beams of all particles [ms].
    ms: f64,
    /// The same in words.
    #[serde(skip)]
    text: String,
}

/// How far apart the weights of particles are by two renderers.
#[derive(Debug, Serialize, JsonSchema)]
struct WeightDifference {
    /// 99th percentile [%].
    p99_percent: f64,
    /// Maximum [%].
    max_percent: f64,
}

/// The properties of this machine, one per line.
pub fn run(args: &DoctorArgs, context: &Context) -> Result<Printed> {
    let choice = selection::choose(Backend::Auto, RenderingMethod::Auto)?;
    let mut report = MachineReport {
        fpmcl: version::VERSION,
        system: OS,
        architecture: ARCH,
        instruction_sets: instruction_sets(),
        processors: available_parallelism().ok().map(NonZeroUsize::get),
        threads: context.threads,
        has_graphics_support: cfg!(feature = "gpu"),
        backend_auto: choice.name(),
        backend_reason: choice.reason,
        adapters: match choice.adapters {
            adapters if adapters.is_empty() => selection::adapters(),
            adapters => adapters,
        },
        speeds: Vec::new(),
        weights: None,
    };
    if args.measure > 0 {
        report.measure(Duration::from_secs(args.measure))?;
    }
    Printed::text(report.to_text()).with_json(&report)
}

impl MachineReport {
    fn to_text(&self) -> String {
        let processors = self.processors.map(|count| count.to_string());
        let graphics = if self.has_graphics_support {
            "built in"
        } else {
            "not built in; build with the feature gpu"
        };
        let instruction_sets = if self.instruction_sets.is_empty() {
            "none that the ray caster uses".to_owned()
        } else {
            self.instruction_sets.join(", ")
        };
        let mut rows = vec![
            ("fpmcl", self.fpmcl.to_owned()),
            (
                "system",
                format!("{} on {}", self.system, self.architecture),
            ),
            ("instruction sets", instruction_sets),
            ("processors", processors.unwrap_or("unknown".to_owned())),
            ("threads in use", self.threads.to_string()),
            ("graphics support", graphics.to_owned()),
        ];
        rows.extend(self.adapters.iter().map(|it| ("adapter", adapter(it))));
        let backend = format!("{}, because {}", self.backend_auto, self.backend_reason);
        rows.push(("backend auto", backend));
        rows.extend(self.speeds.iter().map(|it| ("rays", it.text.clone())));
        rows.extend(self.weights.iter().map(|it| {
            let WeightDifference { p99_percent, max_percent } = it;
            let text = format!("of 99 % of the particles within {p99_percent:.3} % of those of the CPU, of all within {max_percent:.3} %");
            ("weights", text)
        }));
        (rows.iter())
            .map(|(what, value)| format!("{what:<18}{value}\n"))
            .collect()
    }

    /// Measures rays per second of the CPU and of the best graphics adapter, if there is one, and how far apart the
    /// weights are that they give particles.
    fn measure(&mut self, time: Duration) -> Result<()> {
        let workload = Workload::new()?;
        let cpu = workload.renderer(Backend::Cpu, RenderingMethod::Cast)?;
        let has_adapter = best_adapter(&self.adapters, Backend::Gpu).is_some();
        let time = time / if has_adapter { 5 } else { 2 };
        self.speeds.push(workload.images("cast", time, &*cpu)?);
        self.speeds.push(workload.beams(time, &*cpu)?);
        if !has_adapter {
            return Ok(());
        }
        let gpu = workload.renderer(Backend::Gpu, RenderingMethod::Cast)?;
        self.speeds.push(workload.images("cast", time, &*gpu)?);
        self.speeds.push(workload.beams(time, &*gpu)?);
        match workload.renderer(Backend::Gpu, RenderingMethod::Raster) {
            Ok(gpu) => self
                .speeds
                .push(workload.images("rasterized", time, &*gpu)?),
            Err(error) => tracing::warn!("{error}"),
        }
        self.weights = Some(workload.weights(&*cpu, &*gpu)?);
        Ok(())
    }
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

impl Speed {
    /// The speed of a renderer, and the time of some of its rays.
    fn new(
        renderer: &dyn RangeRenderer,
        work: String,
        rays_per_second: f64,
        rays: usize,
        place: &str,
    ) -> Self {
        let ms = 1e3 * rays as f64 / rays_per_second;
        let (renderer, millions) = (renderer.name(), 1e-6 * rays_per_second);
        Self {
            text: format!("{millions:.2} M per second, {work}, {ms:.2} ms{place} by {renderer}"),
            renderer,
            work,
            rays_per_second,
            ms,
        }
    }
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
        // Its size does not depend on anything that could be set.
        let budget = MemoryBudget::default();
        let simulation = Simulation::new(&SimulationConfig::default(), None, budget)?;
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
    fn images(&self, how: &str, time: Duration, renderer: &dyn RangeRenderer) -> Result<Speed> {
        let (poses, unlimited) = (&self.particles[..IMAGES], RangeDifference::UNLIMITED);
        let pixels = self.scan.beams().count();
        let rays = rays_per_second(time, poses.len() * pixels, || {
            renderer.compare_images(poses, &self.scan, &unlimited)
        })?;
        let LidarModel { height, width, .. } = self.scan.model;
        let work = format!("images of {height} x {width} {how}");
        let place = format!(" each, in a street of {} triangles", self.triangles);
        Ok(Speed::new(renderer, work, rays, pixels, &place))
    }

    /// Speed with which beams are compared.
    fn beams(&self, time: Duration, renderer: &dyn RangeRenderer) -> Result<Speed> {
        let difference = self.observation.difference();
        let count = self.particles.len() * self.beams.len();
        let rays = rays_per_second(time, count, || {
            renderer.compare(&self.particles, &self.beams, &difference)
        })?;
        let (beams, particles) = (self.beams.len(), self.particles.len());
        let work = format!("{beams} beams of each of {particles} particles");
        Ok(Speed::new(renderer, work, rays, count, ","))
    }

    /// How far apart the likelihoods of the particles are by two renderers.
    fn weights(
        &self,
        cpu: &dyn RangeRenderer,
        gpu: &dyn RangeRenderer,
    ) -> Result<WeightDifference> {
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
        Ok(WeightDifference {
            p99_percent: per_cent(99),
            max_percent: per_cent(100),
        })
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
fn instruction_sets() -> Vec<&'static str> {
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
    candidates
        .into_iter()
        .filter_map(|(name, is_available)| is_available.then_some(name))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::world_for_tests::TestWorld;

    #[test]
    fn a_speed_is_in_rays_per_second_with_the_time_of_one_image() {
        let world = TestWorld::street();
        let speed = Speed::new(&world, "images cast".to_owned(), 2e6, 57_600, " per image");
        let text = "2.00 M per second, images cast, 28.80 ms per image by boxes";
        assert_eq!(speed.text, text);
        assert_eq!(speed.ms, 28.8);
        let report = MachineReport {
            fpmcl: "",
            system: "",
            architecture: "",
            instruction_sets: Vec::new(),
            processors: None,
            threads: 1,
            has_graphics_support: false,
            adapters: Vec::new(),
            backend_auto: String::new(),
            backend_reason: String::new(),
            speeds: vec![speed],
            weights: None,
        };
        let row = format!("rays              {text}\n");
        assert!(report.to_text().ends_with(&row), "{}", report.to_text());
    }
}
