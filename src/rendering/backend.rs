//! Rendering backends and methods: what can be requested, and the graphics adapters that may provide it.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Requested rendering backend.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// A graphics card if there is one, else the CPU.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// Any graphics adapter, including software adapters; an error without one.
    Gpu,
}

/// Requested method to render whole range images on a graphics adapter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum RenderingMethod {
    /// The faster one, by a measurement; on the CPU rays.
    #[default]
    Auto,
    /// Triangles, drawn by the rasterizer of a graphics adapter.
    Raster,
    /// Rays.
    Cast,
}

/// Type of a graphics adapter, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum AdapterKind {
    Discrete,
    Integrated,
    Virtual,
    Unknown,
    Software,
}

impl fmt::Display for AdapterKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Discrete => "discrete graphics card",
            Self::Integrated => "integrated graphics",
            Self::Virtual => "virtual graphics card",
            Self::Unknown => "graphics adapter of unknown type",
            Self::Software => "software adapter",
        })
    }
}

/// A graphics adapter of this machine and its limits.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct AdapterReport {
    /// Name given by the driver.
    pub name: String,
    /// Type of the adapter.
    pub kind: AdapterKind,
    /// Graphics API: `vulkan`, `gl`.
    pub api: String,
    /// Driver and its version.
    pub driver: String,
    /// Largest buffer that a shader can read [bytes].
    pub max_binding_bytes: u64,
    /// Largest buffer [bytes].
    pub max_buffer_bytes: u64,
    /// Largest edge of a texture [pixels].
    pub max_texture_size: u32,
    /// Why it cannot render; `None` if it can.
    pub obstacle: Option<&'static str>,
}

impl fmt::Display for AdapterReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {})", self.name, self.kind, self.api)
    }
}

/// Returns the index of the best adapter that can render and that the backend allows.
pub fn best_adapter(adapters: &[AdapterReport], backend: Backend) -> Option<usize> {
    let is_allowed = |kind| match backend {
        Backend::Auto => kind <= AdapterKind::Integrated,
        Backend::Cpu => false,
        Backend::Gpu => true,
    };
    (0..adapters.len())
        .filter(|&index| adapters[index].obstacle.is_none() && is_allowed(adapters[index].kind))
        .min_by_key(|&index| adapters[index].kind)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backends_are_lowercase_in_yaml() {
        for (word, backend) in [
            ("auto", Backend::Auto),
            ("cpu", Backend::Cpu),
            ("gpu", Backend::Gpu),
        ] {
            assert_eq!(serde_yaml::from_str::<Backend>(word).unwrap(), backend);
        }
        assert!(serde_yaml::from_str::<Backend>("GPU").is_err());
    }
}
