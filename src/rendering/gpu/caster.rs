//! Rays and beams cast by compute shaders; twin of `caster.wgsl` and `reduce.wgsl`.

use std::ops::Range;

use wgpu::{BindGroup, Buffer, BufferUsages, CommandEncoder, ComputePipeline};

use super::batches;
use super::device::{Gpu, InFlight};
use super::device_map::DeviceMap;
use super::layout::{BEAMS_PER_GROUP, FAR, LANES, Pose, Query, Reduction};
use super::shaders;
use crate::geometry::Vec3;
use crate::lidar::Beam;
use crate::rendering::order::coherent_order;
use crate::rendering::{RangeDifference, RenderError};

/// Compute pipelines with the map bound to them.
pub(super) struct Caster {
    cast: Kernel,
    compare: Kernel,
    reduce: ComputePipeline,
}

/// A pipeline and the map bound to it.
struct Kernel {
    pipeline: ComputePipeline,
    map: BindGroup,
}

/// Some of the poses with some of the directions.
struct Batch {
    poses: Range<usize>,
    rays: usize,
    /// Index of the part of the directions.
    part: usize,
}

impl Caster {
    pub fn new(gpu: &Gpu, map: &DeviceMap) -> Self {
        let source = shaders::caster(map.depth);
        let kernel = |entry_point| {
            let pipeline = pipeline(gpu, &source, entry_point);
            let buffers = [&map.nodes, &map.triangles];
            let map = bind(gpu, &pipeline, 0, &buffers);
            Kernel { pipeline, map }
        };
        Self {
            cast: kernel("cast_rays"),
            compare: kernel("compare_beams"),
            reduce: pipeline(gpu, shaders::REDUCE, "reduce"),
        }
    }

    /// Ranges along directions of the lidar frame, one row per pose; [`FAR`] or more where no
    /// surface is nearer than `far_m`.
    pub fn cast(
        &self,
        gpu: &Gpu,
        map: &DeviceMap,
        poses: &[Pose],
        (directions, far_m): (&[Vec3], f32),
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let parts = parts(gpu, directions, |_, place| f32::from_bits(place));
        let query = Query {
            far_m: far_m.min(FAR),
            ..Query::new(map, &RangeDifference::UNLIMITED)
        };
        let mut rows = vec![Vec::with_capacity(directions.len()); poses.len()];
        batches::run(
            gpu,
            batches_of(gpu, poses.len(), &parts, gpu.batch_sizes.ranges),
            |batch| {
                let rays = (&parts[batch.part].buffer, batch.rays);
                self.start_cast(gpu, query, &poses[batch.poses.clone()], rays)
            },
            |batch, ranges| {
                for (pose, row) in batch.poses.zip(ranges.chunks(batch.rays)) {
                    rows[pose].extend_from_slice(row);
                }
            },
        )?;
        Ok(rows)
    }

    /// Mean cost of the beams, one number per pose; 0 without beams.
    pub fn compare(
        &self,
        gpu: &Gpu,
        map: &DeviceMap,
        poses: &[Pose],
        (beams, difference): (&[Beam], &RangeDifference),
    ) -> Result<Vec<f32>, RenderError> {
        let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
        let parts = parts(gpu, &directions, |index, _| beams[index].range_m);
        let query = Query::new(map, difference);
        let mut totals = vec![0.0_f64; poses.len()];
        batches::run(
            gpu,
            batches_of(gpu, poses.len(), &parts, gpu.batch_sizes.beams),
            |batch| {
                let rays = (&parts[batch.part].buffer, batch.rays);
                self.start_compare(gpu, query, &poses[batch.poses.clone()], rays)
            },
            |batch, sums| {
                for (pose, sum) in batch.poses.zip(sums) {
                    totals[pose] += f64::from(sum);
                }
            },
        )?;
        let count = beams.len().max(1) as f64;
        Ok(totals.iter().map(|total| (total / count) as f32).collect())
    }

    fn start_cast(
        &self,
        gpu: &Gpu,
        query: Query,
        poses: &[Pose],
        (rays, count): (&Buffer, usize),
    ) -> InFlight {
        let groups = (count as u32).div_ceil(LANES);
        let bytes = (poses.len() * count * size_of::<f32>()) as u64;
        let ranges = results(gpu, bytes);
        let query = Query {
            rays: count as u32,
            groups,
            ..query
        };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        self.cast
            .encode(gpu, &mut encoder, query, poses, [rays, &ranges]);
        read_back(gpu, encoder, &ranges, bytes)
    }

    fn start_compare(
        &self,
        gpu: &Gpu,
        query: Query,
        poses: &[Pose],
        (rays, count): (&Buffer, usize),
    ) -> InFlight {
        let groups = (count as u32).div_ceil(BEAMS_PER_GROUP);
        let per_number = size_of::<f32>() as u64;
        let sums = results(gpu, poses.len() as u64 * u64::from(groups) * per_number);
        let bytes = poses.len() as u64 * per_number;
        let totals = results(gpu, bytes);
        let query = Query {
            rays: count as u32,
            groups,
            ..query
        };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        self.compare
            .encode(gpu, &mut encoder, query, poses, [rays, &sums]);
        let reduction = Reduction {
            terms: groups,
            unused: [0; 3],
        };
        let reduction = gpu.upload("reduction", &[reduction], BufferUsages::UNIFORM);
        let bound = bind(gpu, &self.reduce, 0, &[&reduction, &sums, &totals]);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.reduce);
        pass.set_bind_group(0, &bound, &[]);
        pass.dispatch_workgroups(poses.len() as u32, 1, 1);
        drop(pass);
        read_back(gpu, encoder, &totals, bytes)
    }
}

impl Kernel {
    /// One work group of the query per pose and group.
    fn encode(
        &self,
        gpu: &Gpu,
        encoder: &mut CommandEncoder,
        query: Query,
        poses: &[Pose],
        [rays, results]: [&Buffer; 2],
    ) {
        let groups = query.groups;
        let query = gpu.upload("query", &[query], BufferUsages::UNIFORM);
        let buffer = gpu.upload("poses", poses, BufferUsages::STORAGE);
        let bound = bind(gpu, &self.pipeline, 1, &[&query, &buffer, rays, results]);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.map, &[]);
        pass.set_bind_group(1, &bound, &[]);
        pass.dispatch_workgroups(groups, poses.len() as u32, 1);
    }
}

impl Query {
    fn new(map: &DeviceMap, difference: &RangeDifference) -> Self {
        Self {
            rays: 0,
            groups: 0,
            root: map.root,
            unused: 0,
            far_m: FAR,
            short_m: difference.short_m.min(FAR),
            long_m: difference.long_m.min(FAR),
            no_surface_m: difference.no_surface_m.min(FAR),
        }
    }
}

/// Some of the directions, on the device.
struct RayPart {
    buffer: Buffer,
    rays: usize,
}

/// Uploads directions in parts, each in a coherent order. `fourth` makes the fourth number of a
/// direction from its index and its place in its part.
fn parts(gpu: &Gpu, directions: &[Vec3], fourth: impl Fn(usize, u32) -> f32) -> Vec<RayPart> {
    let size = gpu
        .batch_sizes
        .directions
        .min((gpu.max_binding_bytes() / 16) as usize);
    let part = |(number, part): (usize, &[Vec3])| {
        let rays: Vec<[f32; 4]> = coherent_order(part)
            .into_iter()
            .map(|place| {
                let fourth = fourth(number * size + place as usize, place);
                part[place as usize].extend(fourth).to_array()
            })
            .collect();
        RayPart {
            buffer: gpu.upload("rays", &rays, BufferUsages::STORAGE),
            rays: rays.len(),
        }
    };
    directions.chunks(size).enumerate().map(part).collect()
}

/// All poses with all parts, at most `rays_per_batch` unless a single pose has more.
fn batches_of(gpu: &Gpu, poses: usize, parts: &[RayPart], rays_per_batch: usize) -> Vec<Batch> {
    let mut batches = Vec::new();
    for (number, part) in parts.iter().enumerate() {
        let step = (rays_per_batch / part.rays).clamp(1, gpu.batch_sizes.poses);
        for first in (0..poses).step_by(step) {
            batches.push(Batch {
                poses: first..poses.min(first + step),
                rays: part.rays,
                part: number,
            });
        }
    }
    batches
}

fn pipeline(gpu: &Gpu, source: &str, entry_point: &str) -> ComputePipeline {
    let module = shaders::module(gpu, source);
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

/// Binds buffers to the bindings 0, 1, 2 … of a group.
fn bind(gpu: &Gpu, pipeline: &ComputePipeline, group: u32, buffers: &[&Buffer]) -> BindGroup {
    let layout = pipeline.get_bind_group_layout(group);
    shaders::bind(gpu, &layout, buffers)
}

fn results(gpu: &Gpu, bytes: u64) -> Buffer {
    let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC;
    gpu.buffer("results", bytes, usage)
}

fn read_back(gpu: &Gpu, mut encoder: CommandEncoder, results: &Buffer, bytes: u64) -> InFlight {
    let staging = gpu.staging(bytes);
    encoder.copy_buffer_to_buffer(results, 0, &staging, 0, bytes);
    gpu.submit(encoder, staging, bytes)
}
