//! Schemas of what the commands print with `--json`, from the types that they print and the docs of their fields.

use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema};

use super::commands::benchmark::BenchmarkReport;
use super::commands::demo::DemoReport;
use super::commands::doctor::MachineReport;
use super::commands::export::ExportReport;
use super::commands::ground::simulated::SceneScore;
use super::commands::info::{CloudInfo, MapInfo, RecordingInfo, ResultInfo};
use super::commands::simulate::SimulationReport;
use super::comparison::ComparisonFile;
use super::report::Report;
use super::report::ground::GroundReport;
use super::report::map::BuildReport;
use super::report::odometry::OdometryReport;

/// The schema of each output with keys of its own; the other outputs are texts and configurations.
pub fn schemas() -> Vec<(&'static str, Schema)> {
    vec![
        ("info of a recording", schema::<RecordingInfo>()),
        ("info of a scan or a point cloud", schema::<CloudInfo>()),
        ("info of a map", schema::<MapInfo>()),
        ("info of a result", schema::<ResultInfo>()),
        ("odometry", schema::<OdometryReport>()),
        ("build-map", schema::<BuildReport>()),
        ("localize, live, refine, evaluate", schema::<Report>()),
        ("export", schema::<ExportReport>()),
        ("compare", schema::<ComparisonFile>()),
        ("benchmark", schema::<BenchmarkReport>()),
        ("simulate", schema::<SimulationReport>()),
        ("demo", schema::<DemoReport>()),
        ("ground", schema::<GroundReport>()),
        ("ground of simulated scans", schema::<Vec<SceneScore>>()),
        ("doctor", schema::<MachineReport>()),
    ]
}

fn schema<T: JsonSchema>() -> Schema {
    let settings = SchemaSettings::default().for_serialize();
    settings.into_generator().into_root_schema_for::<T>()
}
