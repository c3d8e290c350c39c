//! Keyword arguments as settings of the program's configurations.

use anyhow::anyhow;
use fpmcl::app::settings::{CommandConfig, with_settings};
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict as _, PyDict};

use crate::errors::raised;

/// Keyword arguments of a call.
pub type Settings<'a, 'py> = Option<&'a Bound<'py, PyDict>>;

/// Keys of recordings, which only `read_recording` takes.
const RECORDING: [&str; 8] = [
    "body_from_lidar",
    "calib_file",
    "elevation_bias_deg",
    "frame_step",
    "motion_compensation",
    "n_scans",
    "start_idx",
    "topic",
];

/// Keys of the program's files, outputs and modes, which have no effect here.
const PROGRAM: [&str; 26] = [
    "check_poses",
    "cloud_file",
    "force",
    "holdout_step",
    "initial_pose",
    "initialization",
    "map_calib_file",
    "map_file",
    "map_pose_file",
    "mesh_file",
    "motion_model",
    "odometry_file",
    "onto",
    "output_file",
    "output_folder",
    "plot_loc_results",
    "pose_file",
    "pose_tracking",
    "poses",
    "refine",
    "result_file",
    "result_path",
    "save_result",
    "scan_folder",
    "truth_mesh",
    "visualize",
];

/// Applies the settings of a recording to a configuration.
pub fn of_recording<T: CommandConfig>(config: T, settings: Settings) -> PyResult<T> {
    apply(config, settings, |key| RECORDING.contains(&key))
}

/// Applies the settings of a stage to a configuration.
pub fn of_stage<T: CommandConfig>(config: T, settings: Settings) -> PyResult<T> {
    apply(config, settings, |key| {
        !RECORDING.contains(&key) && !PROGRAM.contains(&key)
    })
}

fn apply<T: CommandConfig>(
    config: T,
    settings: Settings,
    is_taken: impl Fn(&str) -> bool,
) -> PyResult<T> {
    let mut rows = Vec::new();
    if let Some(settings) = settings {
        flatten("", settings, &mut rows)?;
    }
    if let Some((key, _)) = rows.iter().find(|(key, _)| !is_taken(first_word(key)))
        && T::FULL.contains(&format!("{}:", first_word(key)))
    {
        return Err(raised(anyhow!(
            "the key `{key}` has no effect here; remove it, or give it to read_recording or to the program"
        )));
    }
    with_settings(config, &rows).map_err(raised)
}

fn first_word(key: &str) -> &str {
    key.split('.').next().unwrap_or(key)
}

/// Dotted keys and their values as JSON, which YAML contains.
fn flatten(
    prefix: &str,
    settings: &Bound<'_, PyDict>,
    rows: &mut Vec<(String, String)>,
) -> PyResult<()> {
    let py = settings.py();
    // NumPy's numbers and arrays.
    let to_list = (py.import("operator")?).call_method1("methodcaller", ("tolist",))?;
    let options = [("default", to_list)].into_py_dict(py)?;
    for (key, value) in settings {
        let key = format!("{prefix}{key}");
        match value.cast::<PyDict>() {
            Ok(block) => flatten(&format!("{key}."), block, rows)?,
            Err(_not_a_block) => {
                let json = py.import("json")?;
                let text = json.call_method("dumps", (value,), Some(&options))?;
                rows.push((key, text.extract()?));
            }
        }
    }
    Ok(())
}
