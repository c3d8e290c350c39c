//! `doctor`: instruction sets, graphics adapters and rendering speed of this machine.

use std::collections::BTreeMap;
use std::env::consts::{ARCH, OS};
use std::thread::available_parallelism;
use std::time::{Duration, Instant};

use super::output::Printed;
use super::{Context, version};
use crate::app::cli::DoctorArgs;
use crate::lidar::LidarModel;
use crate::map::{TileConfig, TileGrid, tiles};
use crate::rendering::backend::AdapterReport;
use crate::rendering::{Backend, renderer, selection};
use crate::simulation::{Simulation, SimulationConfig};

/// Number of poses whose images are rendered at once, as in the benchmark.
const POSES: usize = 8;

/// The properties of this machine, one per line.
pub(super) fn run(args: &DoctorArgs, context: &Context) -> anyhow::Result<Printed> {
    let choice = selection::choose(Backend::Auto)?;
    let processors = available_parallelism().map_or("unknown".to_owned(), |n| n.to_string());
    let graphics = if cfg!(feature = "gpu") {
        "built in"
    } else {
        "not built in; build with the feature gpu"
    };
    let mut rows = vec![
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
        rows.push(("rays", rays_per_second(time, context)?));
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

/// Rays per second for range images of the simulated street.
fn rays_per_second(time: Duration, context: &Context) -> anyhow::Result<String> {
    let simulation = Simulation::new(&SimulationConfig::default(), None)?;
    let street = &simulation.street.surface.mesh;
    let (poses, model) = (simulation.poses(), LidarModel::default());
    let grid = TileGrid::around(&poses, &TileConfig::default());
    let renderer = renderer(&tiles::cut(street, &grid), context.backend, None)?;
    let step = poses.len().div_ceil(POSES);
    let poses: Vec<_> = poses.into_iter().step_by(step).collect();
    let (start, mut rays) = (Instant::now(), 0);
    while start.elapsed() < time {
        renderer.render(&poses, &model)?;
        rays += poses.len() * model.len();
    }
    Ok(format!(
        "{:.2} M per second, images of {} x {} in a street of {} triangles by {}",
        rays as f64 / start.elapsed().as_secs_f64() * 1e-6,
        model.height,
        model.width,
        street.triangles.len(),
        renderer.name()
    ))
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
