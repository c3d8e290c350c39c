//! Selection of the renderer: CPU or graphics adapter, and the reason.
//!
//! `auto` takes a discrete graphics card, else an integrated one, else the CPU. It never takes a
//! software adapter (a graphics driver that runs on the CPU): the ray packets of the CPU renderer
//! do the same work many times faster.

use std::path::Path;
use std::sync::Arc;

use super::backend::{AdapterReport, Backend, RenderingMethod, best_adapter};
#[cfg(feature = "gpu")]
use super::gpu::GpuRenderer;
use super::{CpuRenderer, RangeRenderer, RenderError};
use crate::memory::MemoryBudget;
use crate::raycasting::SceneSource;

/// Selected renderer, the adapters that were considered, and the reason.
#[derive(Clone, Debug, PartialEq)]
pub struct BackendChoice {
    /// Index of the selected adapter; `None` for the CPU.
    pub adapter: Option<usize>,
    /// Reason, to be read after "because".
    pub reason: String,
    /// All graphics adapters of this machine, best first; with `auto`, none where it has no graphics card.
    pub adapters: Vec<AdapterReport>,
    /// What was requested.
    pub request: (Backend, RenderingMethod),
}

impl BackendChoice {
    /// Name of the selected renderer: `cpu`, or that of the adapter.
    pub fn name(&self) -> String {
        self.adapter.map_or_else(
            || "cpu".to_owned(),
            |index| self.adapters[index].to_string(),
        )
    }

    /// Prepares a map for rendering; its tiles are read, and on a graphics adapter uploaded, when rays may reach them. The
    /// budget is that of the map and the images on a graphics device. Reports a renderer that was selected, and the reason,
    /// to the log.
    ///
    /// # Errors
    /// Those of the graphics device.
    pub fn renderer(
        &self,
        source: Arc<dyn SceneSource>,
        #[cfg_attr(
            not(feature = "gpu"),
            expect(
                unused_variables,
                reason = "only a graphics device has memory of its own"
            )
        )]
        memory_budget: MemoryBudget,
    ) -> Result<Arc<dyn RangeRenderer>, RenderError> {
        // Stages that need the CPU ask for it by themselves.
        if self.request.0 != Backend::Cpu {
            tracing::info!("rendering on {} because {}", self.name(), self.reason);
        }
        #[cfg(feature = "gpu")]
        if self.adapter.is_some() {
            return Ok(Arc::new(GpuRenderer::new(
                source,
                self.request,
                memory_budget,
            )?));
        }
        Ok(Arc::new(CpuRenderer::over(source)))
    }
}

/// Selects one of the graphics adapters of this machine, or the CPU.
///
/// # Errors
/// [`RenderError::NoAdapter`] if a graphics adapter is requested and there is none, [`RenderError::NotBuiltIn`] without the feature
/// `gpu`, [`RenderError::NothingToRasterize`] if the CPU is selected and rasterizing is requested.
pub fn choose(backend: Backend, method: RenderingMethod) -> Result<BackendChoice, RenderError> {
    let adapters = match backend {
        Backend::Cpu => Vec::new(),
        // Loading drivers takes time, and those of Mesa print an error where there is no display.
        Backend::Auto if !may_have_graphics_card() => Vec::new(),
        Backend::Auto | Backend::Gpu => adapters(),
    };
    choose_among(adapters, backend, method)
}

/// Whether this machine may have a graphics card: on Linux, a card has a device file of one of these names.
fn may_have_graphics_card() -> bool {
    const DEVICES: [&str; 6] = [
        "/dev/dri",
        "/dev/nvidiactl",
        "/dev/nvhost-gpu",
        "/dev/dxg",
        "/dev/mali0",
        "/dev/kgsl-3d0",
    ];
    !cfg!(target_os = "linux") || DEVICES.iter().any(|path| Path::new(path).exists())
}

/// All graphics adapters of this machine, best first; none without the feature `gpu`.
pub fn adapters() -> Vec<AdapterReport> {
    #[cfg(feature = "gpu")]
    return super::gpu::adapters();
    #[cfg(not(feature = "gpu"))]
    return Vec::new();
}

fn choose_among(
    adapters: Vec<AdapterReport>,
    backend: Backend,
    method: RenderingMethod,
) -> Result<BackendChoice, RenderError> {
    let adapter = best_adapter(&adapters, backend);
    let reason = match (backend, adapter) {
        (Backend::Cpu, _) => "it was requested".to_owned(),
        (Backend::Gpu, None) if !cfg!(feature = "gpu") => return Err(RenderError::NotBuiltIn),
        (Backend::Gpu, None) => return Err(RenderError::NoAdapter),
        (Backend::Gpu, Some(_)) => {
            "a graphics adapter was requested, and it is the best".to_owned()
        }
        (Backend::Auto, Some(index)) => format!("it is the best {}", adapters[index].kind),
        (Backend::Auto, None) => reason_for_cpu(&adapters),
    };
    if adapter.is_none() && method == RenderingMethod::Raster {
        return Err(RenderError::NothingToRasterize { reason });
    }
    Ok(BackendChoice {
        adapter,
        reason,
        adapters,
        request: (backend, method),
    })
}

/// Why `auto` takes none of the adapters.
fn reason_for_cpu(adapters: &[AdapterReport]) -> String {
    match adapters.first() {
        None if cfg!(feature = "gpu") => "there is no graphics card".to_owned(),
        None => "fpmcl was built without the feature gpu".to_owned(),
        Some(AdapterReport {
            obstacle: Some(obstacle),
            ..
        }) => format!("{} cannot render: {obstacle}", adapters[0]),
        Some(first) => {
            format!("{first} is not a graphics card, so the CPU is faster or safer")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rendering::backend::AdapterKind;

    fn adapter(name: &str, kind: AdapterKind) -> AdapterReport {
        AdapterReport {
            name: name.to_owned(),
            kind,
            api: "vulkan".to_owned(),
            driver: "1.0".to_owned(),
            max_binding_bytes: 1 << 27,
            max_buffer_bytes: 1 << 28,
            max_texture_size: 8192,
            obstacle: None,
        }
    }

    #[test]
    fn auto_selects_the_discrete_card_at_any_position_of_the_list() {
        let card = adapter("card", AdapterKind::Discrete);
        let chip = adapter("chip", AdapterKind::Integrated);
        let software = adapter("software", AdapterKind::Software);
        let choice = choose_among(
            vec![software, chip, card],
            Backend::Auto,
            RenderingMethod::Auto,
        )
        .unwrap();
        assert_eq!(choice.adapter, Some(2));
        assert!(choice.reason.contains("discrete"), "{}", choice.reason);
    }

    #[test]
    fn auto_never_selects_a_software_adapter_and_names_it() {
        let software = adapter("llvmpipe", AdapterKind::Software);
        let choice = choose_among(vec![software], Backend::Auto, RenderingMethod::Auto).unwrap();
        assert_eq!(choice.adapter, None);
        assert!(choice.reason.contains("llvmpipe"), "{}", choice.reason);
    }

    #[test]
    fn a_requested_graphics_adapter_may_be_a_software_adapter() {
        let software = adapter("llvmpipe", AdapterKind::Software);
        let choice = choose_among(vec![software], Backend::Gpu, RenderingMethod::Raster).unwrap();
        assert_eq!(choice.adapter, Some(0));
        let without = choose_among(Vec::new(), Backend::Gpu, RenderingMethod::Raster).unwrap_err();
        if cfg!(feature = "gpu") {
            assert!(matches!(without, RenderError::NoAdapter));
        } else {
            assert!(matches!(without, RenderError::NotBuiltIn));
        }
    }

    #[test]
    fn an_adapter_with_an_obstacle_is_never_selected() {
        let old = AdapterReport {
            obstacle: Some("it has no compute shaders"),
            ..adapter("old", AdapterKind::Discrete)
        };
        let choice = choose_among(vec![old.clone()], Backend::Auto, RenderingMethod::Auto).unwrap();
        assert_eq!(choice.adapter, None);
        assert!(choice.reason.contains("compute"), "{}", choice.reason);
        assert!(choose_among(vec![old], Backend::Gpu, RenderingMethod::Raster).is_err());
    }

    #[test]
    fn the_cpu_does_not_rasterize_and_the_error_says_why_it_was_selected_and_what_to_do() {
        let software = adapter("llvmpipe", AdapterKind::Software);
        for (adapters, backend, why) in [
            (vec![software], Backend::Auto, "llvmpipe"),
            (Vec::new(), Backend::Cpu, "it was requested"),
        ] {
            let error = choose_among(adapters, backend, RenderingMethod::Raster).unwrap_err();
            let message = error.to_string();
            for part in ["method is raster", why, "auto or cast"] {
                assert!(message.contains(part), "{message}");
            }
        }
    }
}
