//! Sources of the shaders.

use wgpu::{
    BindGroup, BindGroupDescriptor, BindGroupEntry, BindGroupLayout, Buffer, ComputePipeline,
};

use super::device::Gpu;

/// Casts rays and compares beams.
const CASTER: &str = concat!(
    include_str!("ray.wgsl"),
    include_str!("cost.wgsl"),
    include_str!("sum.wgsl"),
    include_str!("caster.wgsl")
);
/// Compares range images.
pub(super) const PIXELS: &str = concat!(
    include_str!("ray.wgsl"),
    include_str!("cost.wgsl"),
    include_str!("sum.wgsl"),
    include_str!("pixels.wgsl")
);
/// Sums costs.
pub(super) const REDUCE: &str = concat!(include_str!("sum.wgsl"), include_str!("reduce.wgsl"));
/// Draws range images.
pub(super) const RASTER: &str = concat!(include_str!("ray.wgsl"), include_str!("raster.wgsl"));

/// Replaced by the depth of the hierarchy.
const STACK_SIZE: &str = "const STACK_SIZE: u32 = 64u;";

/// The source that casts rays through a hierarchy of the given depth.
pub(super) fn caster(depth: usize) -> String {
    let stack_size = format!("const STACK_SIZE: u32 = {}u;", depth.max(1));
    CASTER.replace(STACK_SIZE, &stack_size)
}

/// A compute pipeline of one entry point.
pub(super) fn pipeline(gpu: &Gpu, source: &str, entry_point: &str) -> ComputePipeline {
    let module = module(gpu, source);
    gpu.device
        .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry_point),
            layout: None,
            module: &module,
            entry_point: Some(entry_point),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        })
}

pub(super) fn module(gpu: &Gpu, source: &str) -> wgpu::ShaderModule {
    gpu.device
        .create_shader_module(wgpu::ShaderModuleDescriptor {
            label: None,
            source: wgpu::ShaderSource::Wgsl(source.into()),
        })
}

/// Binds buffers to the bindings 0, 1, 2 …
pub(super) fn bind(gpu: &Gpu, layout: &BindGroupLayout, buffers: &[&Buffer]) -> BindGroup {
    let entries: Vec<BindGroupEntry> = (0..)
        .zip(buffers)
        .map(|(binding, buffer)| BindGroupEntry {
            binding,
            resource: buffer.as_entire_binding(),
        })
        .collect();
    gpu.device.create_bind_group(&BindGroupDescriptor {
        label: None,
        layout,
        entries: &entries,
    })
}

#[cfg(test)]
mod tests {
    use wgpu::naga;

    use super::super::layout;
    use super::*;

    #[test]
    fn the_shader_has_the_depth_of_the_hierarchy() {
        assert!(CASTER.contains(STACK_SIZE));
        assert!(caster(23).contains("const STACK_SIZE: u32 = 23u;"));
    }

    #[test]
    fn structures_are_as_large_in_the_shaders_as_here() {
        let sizes = [
            (CASTER, "Node", size_of::<layout::Node>()),
            (CASTER, "Triangle", size_of::<layout::Triangle>()),
            (CASTER, "Pose", size_of::<layout::Pose>()),
            (CASTER, "Query", size_of::<layout::Query>()),
            (PIXELS, "Pixel", size_of::<layout::Pixel>()),
            (PIXELS, "Comparison", size_of::<layout::Comparison>()),
            (REDUCE, "Reduction", size_of::<layout::Reduction>()),
            (RASTER, "Atlas", size_of::<layout::Atlas>()),
        ];
        for (source, name, size) in sizes {
            let module = naga::front::wgsl::parse_str(source).unwrap();
            let twin = module.types.iter().find_map(|(_, kind)| match kind.inner {
                naga::TypeInner::Struct { span, .. } if kind.name.as_deref() == Some(name) => {
                    Some(span as usize)
                }
                _ => None,
            });
            assert_eq!(twin, Some(size), "{name}");
        }
    }

    #[test]
    fn the_nearest_range_is_that_of_the_cpu() {
        let line = "const NEAREST_M: f32 = 1.0e-4;";
        assert!(CASTER.contains(line) && crate::raycasting::NEAREST_M == 1.0e-4);
    }

    #[test]
    fn constants_are_the_same_in_the_shaders_as_here() {
        let lines = [
            (CASTER, "const FAR: f32 = 3.0e38;", layout::FAR == 3.0e38),
            (CASTER, "const LANES: u32 = 64u;", layout::LANES == 64),
            (REDUCE, "const LANES: u32 = 64u;", layout::LANES == 64),
            (
                CASTER,
                "const BEAMS_PER_GROUP: u32 = 256u;",
                layout::BEAMS_PER_GROUP == 256,
            ),
            (
                PIXELS,
                "const BEAMS_PER_GROUP: u32 = 256u;",
                layout::BEAMS_PER_GROUP == 256,
            ),
            (
                RASTER,
                "const VERTICES_PER_TRIANGLE: u32 = 12u;",
                layout::VERTICES_PER_TRIANGLE == 12,
            ),
            (
                CASTER,
                "const LEAF: u32 = 0x80000000u;",
                layout::LEAF == 0x8000_0000,
            ),
        ];
        for (source, line, same) in lines {
            assert!(same && source.contains(line), "{line}");
        }
    }
}
