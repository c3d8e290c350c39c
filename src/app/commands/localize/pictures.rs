//! Pictures of one frame: its range images and its likelihood.

use anyhow::{Context as _, Result};

use crate::app::commands::run_output::RunFiles;
use crate::app::config::LocalizationConfig;
use crate::app::plotting::color::{MCL, REFINED};
use crate::app::plotting::{LineChart, Panel, RangeImageStrip, Series};
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
    let Some(patch) = map.ground.patch_under(&center, Some(below_m)) else {
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
        let (axis, unit) = match direction {
            Direction::Along => ("along", "m"),
            Direction::Across => ("across", "m"),
            Direction::Heading => ("heading", "deg"),
        };
        let mut series = Vec::new();
        for (model, color, observation) in models {
            let points = profile(&view, &center, direction, observation)?;
            let width = match width_at_half(&points) {
                Some(width) => format!("{width:.3} {unit} wide at half height"),
                None => "wider than shown at half height".to_owned(),
            };
            series.push(Series::line(&format!("{model}: {width}"), color, points));
        }
        panels.push(Panel {
            y_name: "likelihood / peak".to_owned(),
            own_x_name: Some(format!("offset {axis} [{unit}]")),
            series,
            clip_outliers: false,
        });
    }
    LineChart {
        title: format!("Frame {}: likelihood around the {name}", frame.number),
        x_name: String::new(),
        panels,
        marks: vec![(0.0, name.to_owned())],
    }
    .save(&files.plot("likelihood.png")?)
}
