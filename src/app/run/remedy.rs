//! What a user of the program can do about an error of the library: flags, and the keys that take what they take.

use std::error::Error;
use std::io;

use crate::localization::{LocalizerError, SecondDriveError, TrackerError};
use crate::map::{BuildError, MapError};
use crate::mapping::MappingError;
use crate::memory::MemoryError;
use crate::meshing::MeshingError;
use crate::odometry::{OdometryError, PlacementError, TimingError};
use crate::recording::RecordingError;
use crate::refinement::RefinerError;
use crate::rendering::RenderError;
use crate::sensor::SensorError;
use crate::simulation::SimulationError;

/// The option of a command that names poses.
pub const POSES: &str = "--poses";

/// The remedies for an error and its causes, each once; `option` is that of the command that names poses.
pub fn remedies(error: &anyhow::Error, option: &str) -> Vec<String> {
    let remedies = error.chain().filter_map(remedy);
    let mut remedies: Vec<String> = remedies.map(|it| it.replace(POSES, option)).collect();
    remedies.dedup();
    remedies
}

fn remedy(error: &(dyn Error + 'static)) -> Option<&'static str> {
    let of_rendering = |error: &RenderError| match error {
        RenderError::NoAdapter
        | RenderError::DeviceLost { .. }
        | RenderError::DeviceRefused { .. }
        | RenderError::MapTooLarge { .. } => Some("use --backend cpu"),
        RenderError::NotBuiltIn => Some("build with --features gpu, or use --backend cpu"),
        RenderError::NothingToRasterize { .. } => {
            Some("set rendering.method to auto or cast, or use --backend gpu")
        }
        RenderError::DeviceMemory(_) => {
            Some("use --backend cpu, or raise the budget with --memory")
        }
        RenderError::Memory(_) | RenderError::Tile(_) => None,
    };
    let of_recording = |error: &RecordingError| match error {
        RecordingError::SeveralTopics { .. } => {
            Some("name it with the key topic (scans) or with --poses (poses)")
        }
        RecordingError::ChoosePart { .. } => Some("name it with --set topic=NAME"),
        RecordingError::TopicNotNamed { .. } => Some("name it with --poses"),
        RecordingError::NoPoseFile { .. } => Some("name it with --poses"),
        RecordingError::NoMounting { .. } => Some("--poses names a file of poses"),
        _ => None,
    };
    (error.downcast_ref::<MemoryError>())
        .map(|_| "--memory sets the budget")
        .or_else(|| error.downcast_ref().and_then(of_rendering))
        .or_else(|| error.downcast_ref().and_then(of_recording))
        .or_else(|| passed_on(error).and_then(remedy))
}

/// The error that an error of the library passes on without words of its own, so that it is none of the causes.
fn passed_on<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a (dyn Error + 'static)> {
    macro_rules! first_of {
        ($($kind:ident::$variant:ident),* $(,)?) => {
            $(if let Some($kind::$variant(inner)) = error.downcast_ref::<$kind>() {
                return Some(inner);
            })*
        };
    }
    first_of![
        BuildError::Map,
        BuildError::Memory,
        BuildError::Meshing,
        LocalizerError::Render,
        LocalizerError::Sensor,
        MapError::Memory,
        MapError::Render,
        MappingError::Build,
        MappingError::Memory,
        MappingError::Odometry,
        MappingError::Recording,
        MappingError::SecondDrive,
        MappingError::Sensor,
        MappingError::Timing,
        MeshingError::Memory,
        OdometryError::Memory,
        PlacementError::Memory,
        RefinerError::Map,
        RefinerError::Render,
        RefinerError::Sensor,
        RenderError::Memory,
        SecondDriveError::Map,
        SecondDriveError::Odometry,
        SecondDriveError::Placement,
        SecondDriveError::Tracker,
        SensorError::Recording,
        SensorError::Timing,
        SimulationError::Memory,
        TimingError::Odometry,
        TrackerError::Localizer,
        TrackerError::Odometry,
        TrackerError::Sensor,
    ];
    let error: &'a io::Error = error.downcast_ref()?;
    let inner: &'a (dyn Error + Send + Sync + 'static) = error.get_ref()?;
    Some(inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_that_others_pass_on_has_its_remedy_once() {
        let no_adapter = || RenderError::NoAdapter;
        let over_budget = MemoryError {
            what: "the map",
            needed_bytes: 2.0,
            budget_bytes: 1.0,
            remedy: "build a smaller one",
        };
        let of_file = RecordingError::Read {
            path: "poses.txt".into(),
            source: io::Error::other(over_budget),
        };
        for (error, expected) in [
            (anyhow::Error::new(no_adapter()), "use --backend cpu"),
            (MapError::from(no_adapter()).into(), "use --backend cpu"),
            (
                TrackerError::from(LocalizerError::from(no_adapter())).into(),
                "use --backend cpu",
            ),
            (
                LocalizerError::from(RenderError::from(over_budget)).into(),
                "--memory sets the budget",
            ),
            (of_file.into(), "--memory sets the budget"),
        ] {
            let error = error.context("while localizing");
            assert_eq!(remedies(&error, POSES), [expected]);
        }
        assert!(remedies(&anyhow::anyhow!("else"), POSES).is_empty());
    }
}
