//! A finished map, prepared for localization: its tiles, and panoramas for the sensor of its scans.

use anyhow::Result;

use crate::app::settings::BuildMapConfig;
use crate::localization::{Localizer, LocalizerConfig, Odometry, Start};
use crate::map::{Map, MapCache, MapError, MapOptions};
use crate::recording::Frame;
use crate::rendering::Backend;
use crate::sensor::Sensor;

/// Opens the map that was written, which makes its tiles, and localizes one of its scans, which makes its panoramas.
/// `None` if no car can be localized in it, after a warning.
pub fn open_map(
    config: &BuildMapConfig,
    sensor: &Sensor,
    frame: Option<&Frame>,
) -> Result<Option<Map>> {
    let options = MapOptions {
        backend: Backend::Cpu,
        cache: MapCache::NextToMap,
        ..MapOptions::default()
    };
    let map = match Map::load(&config.mesh_file, &options) {
        Ok(map) => map,
        Err(error @ (MapError::NoGround { .. } | MapError::NoArea { .. })) => {
            tracing::warn!("no car can be localized in this map: {error}");
            return Ok(None);
        }
        Err(error) => return Err(error.into()),
    };
    if let Some(frame) = frame {
        let scan = frame.read()?;
        let localizer = LocalizerConfig {
            ground: config.map.ground.clone(),
            ..LocalizerConfig::default()
        };
        let found = Localizer::new(
            &map,
            sensor,
            localizer,
            Start::unknown(&map),
            config.map.seed,
        )
        .and_then(|mut localizer| localizer.step(&scan, Odometry::Unknown));
        if let Err(error) = found {
            tracing::warn!("a start anywhere in this map was not prepared: {error}");
        }
    }
    Ok(Some(map))
}
