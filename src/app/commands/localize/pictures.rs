//! Pictures of one frame: its range images and its likelihood.

use anyhow::{Context as _, Result};

use crate::app::report::plotting::color::{MCL, REFINED, Rgb};
use crate::app::report::plotting::{LineChart, Panel, RangeImageStrip, Series};
use crate::app::report::run_output::RunFiles;
use crate::app::settings::LocalizationConfig;
use crate::geometry::{Pose3, pose2_from_pose3};
use crate::lidar::RangeImage;
use crate::localization::likelihood::{Direction, View, profile, width_at_half};
use crate::localization::observation::{Likelihood, ObservationConfig, choose_beams};
use crate::map::{Map, SensorAttitude};
use crate::random::stream;
use crate::recording::{Frame, Recording};

/// Random stream of the beams that are compared.
const LIKELIHOOD_STREAM: u64 = 2;

/// Draws the range image of a frame beside that of the map at the estimate.
pub fn draw_example(
    config: &LocalizationConfig,
    files: &RunFiles,
    map: &Map,
    recording: &Recording,
    map_from_lidar: &[Pose3],
) -> Result<()> {
    let row = map_from_lidar.len() / 2;
    let model = config.range_image.model();
    let scan = recording.frames[row].read()?;
    let observed = RangeImage::project(&scan.points, &model);
    let rendered = map.renderer.render(&map_from_lidar[row..=row], &model)?;
    let rendered = rendered.first().context("one pose gives one image")?;
    let frame = &recording.frames[row];
    RangeImageStrip {
        title: &format!("Frame {}: observed, rendered, difference", frame.number),
        observed: &observed,
        rendered,
    }
    .save(&files.plot("range_images.png")?)?;
    let (name, pose) = match frame.map_from_lidar {
        Some(truth) => ("true pose", truth),
        None => ("estimate", map_from_lidar[row]),
    };
    draw_likelihood(config, files, map, (frame, name, &pose), &observed)
}

/// Draws the likelihood of this run and of range-mcl around a named pose of a frame, one panel per
/// direction.
fn draw_likelihood(
    config: &LocalizationConfig,
    files: &RunFiles,
    map: &Map,
    (frame, name, map_from_lidar): (&Frame, &str, &Pose3),
    scan: &RangeImage,
) -> Result<()> {
    let center = pose2_from_pose3(map_from_lidar);
    let below_m = map_from_lidar.translation.z - SensorAttitude::default().height_m;
    let Some(patch) = map.ground.patch_under(&center, Some(below_m))? else {
        tracing::info!(
            "frame {}: the likelihood is not drawn because there is no ground below the {name}",
            frame.number
        );
        return Ok(());
    };
    let observation = &config.observation;
    let attitude = patch.attitude_of(map_from_lidar);
    let mut rng = stream(config.seed, LIKELIHOOD_STREAM);
    let beams = choose_beams(
        scan,
        observation.beams,
        observation.road_share,
        &attitude,
        &mut rng,
    );
    let view = View {
        renderer: &*map.renderer,
        ground: &map.ground,
        level_m: Some(patch.height_m),
        attitude,
        beams: &beams,
    };
    let reference = ObservationConfig {
        likelihood: Likelihood::Reference,
        ..observation.clone()
    };
    let models = [
        ("range-mcl", MCL, &reference),
        ("this run", REFINED, observation),
    ];
    let mut panels = Vec::new();
    for direction in Direction::ALL {
        let mut profiles = Vec::new();
        for (model, color, observation) in models {
            let points = profile(&view, &center, direction, observation)?;
            profiles.push((model, color, points));
        }
        panels.extend(likelihood_panels(direction, &profiles));
    }
    LineChart {
        title: format!("Frame {}: likelihood around the {name}", frame.number),
        panels,
        columns: 2,
        marks: vec![(0.0, name.to_owned())],
        ..LineChart::default()
    }
    .save(&files.plot("likelihood.png")?)
}

/// Name, color and points of a profile of the likelihood.
type Profile<'a> = (&'a str, Rgb, Vec<(f64, f64)>);

/// Panels of one direction: all profiles, and the last one at the scale of its own width.
fn likelihood_panels(direction: Direction, profiles: &[Profile]) -> Vec<Panel> {
    /// Visible part on each side, in widths at half height.
    const ZOOM: f64 = 3.0;
    let (axis, unit, fine_unit, fine, decimals) = match direction {
        Direction::Along => ("along", "m", "cm", 100.0, 1),
        Direction::Across => ("across", "m", "cm", 100.0, 1),
        Direction::Heading => ("heading", "deg", "deg", 1.0, 3),
    };
    let panel = |unit: &str, series: Vec<Series>| Panel {
        y_name: "likelihood / peak".to_owned(),
        own_x_name: Some(format!("offset {axis} [{unit}]")),
        series,
        ..Panel::default()
    };
    let all = profiles.iter().map(|(model, color, points)| {
        let width = match width_at_half(points) {
            Some(width) => format!(
                "{:.decimals$} {fine_unit} wide at half height",
                fine * width
            ),
            None => "wider than shown at half height".to_owned(),
        };
        Series::line(&format!("{model}: {width}"), *color, points.iter().copied())
    });
    let mut panels = vec![panel(unit, all.collect())];
    if let Some((model, color, points)) = profiles.last() {
        let reach = width_at_half(points).map_or(f64::INFINITY, |width| ZOOM * width);
        let near = points.iter().filter(|(offset, _)| offset.abs() <= reach);
        let near = near.map(|(offset, likelihood)| (fine * offset, *likelihood));
        let series = Series::line(&format!("{model}, enlarged"), *color, near);
        panels.push(panel(fine_unit, vec![series]));
    }
    panels
}
