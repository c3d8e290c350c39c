//! Python package of fpmcl: the library on NumPy arrays, and the program.
//!
//! Each function converts its arguments, releases the interpreter lock, calls the library, and converts the result.
//! Comments of what is exported are the docstrings; `package/fpmcl/__init__.pyi` has the types.

mod arrays;
mod errors;
mod localizer;
mod logging;
mod map;
mod recording;
mod settings;
mod trajectory;

use pyo3::prelude::*;

#[pymodule]
mod _fpmcl {
    #[pymodule_export]
    use super::errors::Error;
    #[pymodule_export]
    use super::localizer::{Estimate, Localizer};
    #[pymodule_export]
    use super::main;
    #[pymodule_export]
    use super::map::{Map, cast_rays, classify_ground};
    #[pymodule_export]
    use super::recording::{Recording, Scan, Sensor, infer_sensor, read_recording};
    #[pymodule_export]
    use super::trajectory::{
        RefinedTrajectory, Trajectory, evaluate, odometry, refine, write_trajectory,
    };

    #[pymodule_init]
    fn init(module: &pyo3::Bound<'_, pyo3::types::PyModule>) -> pyo3::PyResult<()> {
        use pyo3::types::PyModuleMethods as _;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}

/// Runs the program with the arguments of the process; returns its exit code.
#[cfg(feature = "program")]
#[pyfunction]
fn main(py: Python<'_>) -> PyResult<u8> {
    let arguments: Vec<std::ffi::OsString> = py.import("sys")?.getattr("argv")?.extract()?;
    let library = py.import("fpmcl._fpmcl")?.getattr("__file__")?;
    let library: std::path::PathBuf = library.extract()?;
    Ok(py.detach(|| fpmcl::main_of_library(arguments, library)))
}

/// Ends the process with the reason why it has no program: the script of the package exists in spite of it.
#[cfg(not(feature = "program"))]
#[pyfunction]
fn main() -> PyResult<u8> {
    Err(pyo3::exceptions::PySystemExit::new_err(
        "error: this package was built without the program; `pip install ./python` builds it with it",
    ))
}
