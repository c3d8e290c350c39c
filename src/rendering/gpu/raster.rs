//! Range images by drawing, one instance per pose and tile; twin of `raster.wgsl` and `pixels.wgsl`.

use std::ops::Range;

use wgpu::{
    Buffer, BufferUsages, CommandEncoder, ComputePipeline, RenderPipeline, TextureFormat,
    TextureUsages,
};

use super::batch_sizes::IN_FLIGHT;
use super::batches;
use super::device::{Gpu, InFlight};
use super::device_map::DeviceMap;
use super::layout::{self, FAR, Pixel, Pose, VERTICES_PER_TRIANGLE};
use super::shaders;
use super::sums::{PartialSums, Summation};
use crate::geometry::Vec3;
use crate::lidar::{LidarModel, RangeImage};
use crate::rendering::{RangeDifference, RenderError};

/// Maximum number of pixels in an atlas, unless a single image has more: 16 MB of ranges.
const PIXELS_PER_ATLAS: usize = 1 << 22;
/// Memory of a pixel of an atlas: range, depth, and a copy of the range [bytes].
const PIXEL_BYTES: usize = 12;
/// Rows of a texture are copied in multiples of 256 bytes.
const ROW_PIXELS: u32 = wgpu::COPY_BYTES_PER_ROW_ALIGNMENT / 4;
const RANGES: TextureFormat = TextureFormat::R32Uint;
const DEPTH: TextureFormat = TextureFormat::Depth32Float;
/// Depth is range / limit; this limit keeps it a normal number.
const MAX_LIMIT_M: f32 = 1e30;

/// Render pipeline of range images, and what compares them.
pub(super) struct Rasterizer {
    pipeline: RenderPipeline,
    comparison: ComputePipeline,
    summation: Summation,
}

/// Images that are drawn.
struct Drawing<'a> {
    model: &'a LidarModel,
    atlas: AtlasLayout,
    /// Centre rays of the pixels.
    directions: Buffer,
}

/// Positions of images in a texture.
#[derive(Clone, Copy, Debug)]
struct AtlasLayout {
    columns: usize,
    rows: usize,
    /// Size of the texture [pixels].
    width: u32,
    height: u32,
}

impl AtlasLayout {
    /// A texture for as many of the images as fit; `None` if not even one does.
    fn fitting(images: usize, model: &LidarModel, largest: u32) -> Option<Self> {
        let largest_row = (largest - largest % ROW_PIXELS) as usize;
        let most = images.min(PIXELS_PER_ATLAS / model.len().max(1)).max(1);
        let columns = (largest_row / model.width.max(1)).min(most);
        let rows = (largest as usize / model.height.max(1)).min(most.div_ceil(columns.max(1)));
        (columns > 0 && rows > 0).then(|| Self {
            columns,
            rows,
            width: ((columns * model.width) as u32).next_multiple_of(ROW_PIXELS),
            height: (rows * model.height) as u32,
        })
    }

    fn images(&self) -> usize {
        self.columns * self.rows
    }

    fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    fn bytes(&self) -> u64 {
        (self.pixels() * size_of::<f32>()) as u64
    }

    /// Cuts an image out of the texels of the texture.
    fn image(&self, texels: &[f32], slot: usize, model: &LidarModel) -> Vec<f32> {
        let left = slot % self.columns * model.width;
        let top = slot / self.columns * model.height;
        (top..top + model.height)
            .flat_map(|row| {
                let start = row * self.width as usize + left;
                &texels[start..start + model.width]
            })
            .copied()
            .collect()
    }
}

/// Draws of the tiles for the poses of a batch that see them.
struct Instances {
    /// Slots in the atlas, tile by tile.
    slots: Vec<u32>,
    /// Vertices and instances of each draw.
    draws: Vec<(Range<u32>, Range<u32>)>,
}

impl Instances {
    fn of(map: &DeviceMap, poses: &[Pose], far_m: f32) -> Self {
        let mut slots = Vec::new();
        let mut draws = Vec::new();
        for tile in &map.tiles {
            let first = slots.len() as u32;
            let sees = |pose: &Pose| {
                let [x, y, z, _] = pose.origin;
                tile.distance_to(Vec3::new(x, y, z)) <= far_m
            };
            slots.extend(
                (0..)
                    .zip(poses)
                    .filter(|(_, p)| sees(p))
                    .map(|(slot, _)| slot),
            );
            let vertices = tile.triangles.start * VERTICES_PER_TRIANGLE
                ..tile.triangles.end * VERTICES_PER_TRIANGLE;
            draws.push((vertices, first..slots.len() as u32));
        }
        Self { slots, draws }
    }
}

impl Rasterizer {
    pub fn new(gpu: &Gpu) -> Self {
        let module = shaders::module(gpu, shaders::RASTER);
        let slot = wgpu::VertexBufferLayout {
            array_stride: 4,
            step_mode: wgpu::VertexStepMode::Instance,
            attributes: &wgpu::vertex_attr_array![0 => Uint32],
        };
        let pipeline = gpu
            .device
            .create_render_pipeline(&wgpu::RenderPipelineDescriptor {
                label: Some("range images"),
                layout: None,
                vertex: wgpu::VertexState {
                    module: &module,
                    entry_point: Some("cover"),
                    compilation_options: wgpu::PipelineCompilationOptions::default(),
                    buffers: &[Some(slot)],
                },
                primitive: wgpu::PrimitiveState::default(),
                depth_stencil: Some(wgpu::DepthStencilState {
                    format: DEPTH,
                    depth_write_enabled: Some(true),
                    depth_compare: Some(wgpu::CompareFunction::Less),
                    stencil: wgpu::StencilState::default(),
                    bias: wgpu::DepthBiasState::default(),
                }),
                multisample: wgpu::MultisampleState::default(),
                fragment: Some(wgpu::FragmentState {
                    module: &module,
                    entry_point: Some("cast_pixel"),
                    compilation_options: wgpu::PipelineCompilationOptions::default(),
                    targets: &[Some(RANGES.into())],
                }),
                multiview_mask: None,
                cache: None,
            });
        Self {
            pipeline,
            comparison: shaders::pipeline(gpu, shaders::PIXELS, "compare_pixels"),
            summation: Summation::new(gpu),
        }
    }

    /// Whether an image fits a texture.
    pub fn fits(gpu: &Gpu, model: &LidarModel) -> bool {
        AtlasLayout::fitting(1, model, gpu.limits.max_texture_dimension_2d).is_some()
    }

    /// Ranges of all pixels, one image per pose; [`FAR`] or more where no surface is nearer than
    /// the upper limit of the model.
    pub fn draw(
        &self,
        gpu: &Gpu,
        map: &DeviceMap,
        poses: &[Pose],
        model: &LidarModel,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let drawing = Drawing::new(gpu, map, poses.len(), model)?;
        let atlas_layout = &drawing.atlas;
        let mut images = Vec::with_capacity(poses.len());
        batches::run(
            gpu,
            poses.chunks(atlas_layout.images()),
            |batch| {
                let staging = gpu.staging(atlas_layout.bytes());
                let encoder = self.encode(gpu, map, batch, (&drawing, &staging));
                gpu.submit(encoder, staging, atlas_layout.bytes())
            },
            |batch, texels| {
                images
                    .extend((0..batch.len()).map(|slot| atlas_layout.image(&texels, slot, model)));
            },
        )?;
        Ok(images)
    }

    /// Mean cost of the pixels of a measured image that have a return, one number per pose; 0 without returns.
    pub fn compare(
        &self,
        gpu: &Gpu,
        map: &DeviceMap,
        poses: &[Pose],
        (measured, difference): (&RangeImage, &RangeDifference),
    ) -> Result<Vec<f32>, RenderError> {
        let drawing = Drawing::new(gpu, map, poses.len(), &measured.model)?;
        let pixels: Vec<Pixel> = (0..measured.ranges.len())
            .filter(|&index| measured.has_return(index))
            .map(|index| Pixel {
                index: index as u32,
                range_m: measured.ranges[index],
            })
            .collect();
        let comparison = layout::Comparison::new(&drawing, pixels.len(), difference);
        let count = pixels.len().max(1) as f64;
        let pixels = gpu.upload("pixels", &pixels, BufferUsages::STORAGE);
        let mut costs = Vec::with_capacity(poses.len());
        batches::run(
            gpu,
            poses.chunks(drawing.atlas.images()),
            |batch| self.start_compare(gpu, map, batch, (&drawing, &pixels, comparison)),
            |_, sums| costs.extend(sums.iter().map(|sum| (f64::from(*sum) / count) as f32)),
        )?;
        Ok(costs)
    }

    fn start_compare(
        &self,
        gpu: &Gpu,
        map: &DeviceMap,
        poses: &[Pose],
        (drawing, pixels, comparison): (&Drawing, &Buffer, layout::Comparison),
    ) -> InFlight {
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let ranges = gpu.buffer("ranges", drawing.atlas.bytes(), usage);
        let mut encoder = self.encode(gpu, map, poses, (drawing, &ranges));
        let sums = PartialSums::new(gpu, poses.len(), comparison.pixels as usize);
        let comparison = layout::Comparison {
            groups: sums.groups,
            ..comparison
        };
        let comparison = gpu.upload("comparison", &[comparison], BufferUsages::UNIFORM);
        let layout = self.comparison.get_bind_group_layout(0);
        let buffers = [&comparison, &ranges, pixels, &sums.buffer];
        let bound = shaders::bind(gpu, &layout, &buffers);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.comparison);
        pass.set_bind_group(0, &bound, &[]);
        pass.dispatch_workgroups(sums.groups, poses.len() as u32, 1);
        drop(pass);
        self.summation.submit(gpu, encoder, &sums)
    }

    /// Draws the images of a batch and copies them to a buffer.
    fn encode(
        &self,
        gpu: &Gpu,
        map: &DeviceMap,
        poses: &[Pose],
        (drawing, target): (&Drawing, &Buffer),
    ) -> CommandEncoder {
        let (model, atlas_layout) = (drawing.model, &drawing.atlas);
        let far_m = model.max_range.min(MAX_LIMIT_M);
        let instances = Instances::of(map, poses, far_m);
        let slots = gpu.upload("slots", &instances.slots, BufferUsages::VERTEX);
        let atlas = layout::Atlas::new(
            model,
            atlas_layout.columns,
            [atlas_layout.width, atlas_layout.height],
            far_m,
        );
        let atlas = gpu.upload("atlas", &[atlas], BufferUsages::UNIFORM);
        let poses = gpu.upload("poses", poses, BufferUsages::STORAGE);
        let buffers = [&map.triangles, &atlas, &poses, &drawing.directions];
        let bound = shaders::bind(gpu, &self.pipeline.get_bind_group_layout(0), &buffers);

        let ranges = texture(gpu, atlas_layout, RANGES);
        let depths = texture(gpu, atlas_layout, DEPTH);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        {
            let mut pass = begin(&mut encoder, &ranges, &depths);
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &bound, &[]);
            pass.set_vertex_buffer(0, slots.slice(..));
            for (vertices, slots) in instances.draws {
                if !slots.is_empty() {
                    pass.draw(vertices, slots);
                }
            }
        }
        encoder.copy_texture_to_buffer(
            ranges.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: target,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(atlas_layout.width * 4),
                    rows_per_image: None,
                },
            },
            ranges.size(),
        );
        encoder
    }
}

impl<'a> Drawing<'a> {
    /// Cuts the images of so many poses into atlases.
    fn new(
        gpu: &Gpu,
        map: &DeviceMap,
        poses: usize,
        model: &'a LidarModel,
    ) -> Result<Self, RenderError> {
        let largest = gpu.limits.max_texture_dimension_2d;
        let sizes = &gpu.batch_sizes;
        let vertices = map.triangle_count() * VERTICES_PER_TRIANGLE as usize;
        let images = sizes
            .poses_per_batch(poses, model.len(), sizes.ranges.max(PIXELS_PER_ATLAS))
            .min(sizes.vertices / vertices.max(1))
            .min(sizes.images);
        let atlas = AtlasLayout::fitting(images, model, largest).ok_or_else(|| {
            let (width, height) = (model.width, model.height);
            RenderError::DeviceRefused {
                reason: format!("images of {width}x{height} pixels, textures have {largest}"),
            }
        })?;
        gpu.memory_budget
            .require(
                "the range images on the graphics device",
                (IN_FLIGHT * atlas.pixels() * PIXEL_BYTES) as f64,
                "set method to cast, render on the CPU",
            )
            .map_err(RenderError::DeviceMemory)?;
        let directions: Vec<[f32; 4]> = model
            .directions()
            .iter()
            .map(|direction| direction.extend(0.0).to_array())
            .collect();
        Ok(Self {
            model,
            atlas,
            directions: gpu.upload("directions", &directions, BufferUsages::STORAGE),
        })
    }
}

impl layout::Comparison {
    fn new(drawing: &Drawing, pixels: usize, difference: &RangeDifference) -> Self {
        let Drawing { model, atlas, .. } = drawing;
        Self {
            pixels: pixels as u32,
            groups: 0,
            width: model.width as u32,
            height: model.height as u32,
            columns: atlas.columns as u32,
            stride: atlas.width,
            min_m: model.min_range,
            max_m: model.max_range.min(FAR),
            short_m: difference.short_m.min(FAR),
            long_m: difference.long_m.min(FAR),
            no_surface_m: difference.no_surface_m.min(FAR),
            unused: 0,
        }
    }
}

impl layout::Atlas {
    fn new(model: &LidarModel, columns: usize, size: [u32; 2], far_m: f32) -> Self {
        Self {
            width: model.width as u32,
            height: model.height as u32,
            columns: columns as u32,
            unused: 0,
            atlas_size: size.map(|pixels| pixels as f32),
            fov_up_rad: model.fov_up_rad(),
            fov_rad: model.fov_rad(),
            far_m,
            unused_end: [0; 3],
        }
    }
}

fn texture(gpu: &Gpu, atlas_layout: &AtlasLayout, format: TextureFormat) -> wgpu::Texture {
    gpu.device.create_texture(&wgpu::TextureDescriptor {
        label: Some("atlas"),
        size: wgpu::Extent3d {
            width: atlas_layout.width,
            height: atlas_layout.height,
            depth_or_array_layers: 1,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: TextureUsages::RENDER_ATTACHMENT | TextureUsages::COPY_SRC,
        view_formats: &[],
    })
}

/// Begins a render pass on an atlas without surfaces.
fn begin<'a>(
    encoder: &'a mut wgpu::CommandEncoder,
    ranges: &wgpu::Texture,
    depths: &wgpu::Texture,
) -> wgpu::RenderPass<'a> {
    let nothing = wgpu::Color {
        r: f64::from(FAR.to_bits()),
        ..wgpu::Color::BLACK
    };
    let (ranges, depths) = (
        ranges.create_view(&Default::default()),
        depths.create_view(&Default::default()),
    );
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: None,
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view: &ranges,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations {
                load: wgpu::LoadOp::Clear(nothing),
                store: wgpu::StoreOp::Store,
            },
        })],
        depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
            view: &depths,
            depth_ops: Some(wgpu::Operations {
                load: wgpu::LoadOp::Clear(1.0),
                store: wgpu::StoreOp::Discard,
            }),
            stencil_ops: None,
        }),
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_atlas_fits_its_texture_and_holds_all_images_where_that_is_possible() {
        let model = LidarModel::default();
        for images in [1, 2, 9, 10, 64] {
            let atlas_layout = AtlasLayout::fitting(images, &model, 8192).unwrap();
            assert!(atlas_layout.images() >= images && atlas_layout.images() < images + 9);
            assert!(atlas_layout.width <= 8192 && atlas_layout.height <= 8192);
            assert_eq!(atlas_layout.width % 64, 0);
        }
        let wide = LidarModel {
            width: 8193,
            ..model
        };
        assert!(AtlasLayout::fitting(1, &wide, 8192).is_none());
    }

    #[test]
    fn images_are_cut_out_where_they_were_put() {
        let model = LidarModel {
            height: 2,
            width: 3,
            ..LidarModel::default()
        };
        let atlas_layout = AtlasLayout::fitting(4, &model, 64).unwrap();
        let texels: Vec<f32> = (0..atlas_layout.pixels())
            .map(|texel| texel as f32)
            .collect();
        assert_eq!(
            atlas_layout.image(&texels, 1, &model),
            [3.0, 4.0, 5.0, 67.0, 68.0, 69.0]
        );
    }
}
