//! Keyword arguments as fields of the library's configurations.

use fpmcl::configuration::{self, Configuration};
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict as _, PyDict};

use crate::errors::raised;

/// Sets the fields of a configuration that keyword arguments name.
pub fn apply<T: Configuration>(config: T, settings: Option<&Bound<'_, PyDict>>) -> PyResult<T> {
    let mut rows = Vec::new();
    if let Some(settings) = settings {
        flatten("", settings, &mut rows)?;
    }
    let settings = configuration::Settings {
        before: "",
        pairs: &rows,
    };
    configuration::with_settings(config, settings).map_err(raised)
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
                let value = if value.hasattr("__fspath__")? {
                    value.call_method0("__fspath__")?
                } else {
                    value
                };
                let text: String = json
                    .call_method("dumps", (value,), Some(&options))?
                    .extract()?;
                // YAML's numbers that JSON does not have.
                rows.push((
                    key,
                    match text.as_str() {
                        "Infinity" => ".inf".to_owned(),
                        "-Infinity" => "-.inf".to_owned(),
                        "NaN" => ".nan".to_owned(),
                        _ => text,
                    },
                ));
            }
        }
    }
    Ok(())
}
