//! Rays and beams cast by compute shaders; twin of `caster.wgsl`.

use std::ops::Range;

use wgpu::{BindGroup, Buffer, BufferUsages, CommandEncoder, ComputePipeline};

use super::batches;
use super::device::{Gpu, InFlight};
use super::device_map::DeviceMap;
use super::layout::{FAR, LANES, Pose, Query};
use super::shaders;
use super::sums::{PartialSums, Summation, read_back, results};
use crate::geometry::Vec3;
use crate::lidar::Beam;
use crate::rendering::order::coherent_order;
use crate::rendering::{RangeDifference, RenderError};

/// Compute pipelines with the map bound to them.
pub(super) struct Caster {
    cast: Kernel,
    compare: Kernel,
    summation: Summation,
    pipelines: Pipelines,
}

/// A pipeline and the map bound to it.
struct Kernel {
    pipeline: ComputePipeline,
    map: BindGroup,
}

/// Pipelines for maps of a depth.
#[derive(Clone)]
struct Pipelines {
    cast: ComputePipeline,
    compare: ComputePipeline,
    /// Longest path to a leaf that they can follow [nodes].
    depth: usize,
}

impl Pipelines {
    /// For hierarchies that are a little deeper, too: tiles that follow need no others.
    fn new(gpu: &Gpu, depth: usize) -> Self {
        let depth = depth.next_multiple_of(8);
        let source = shaders::caster(depth);
        Self {
            cast: shaders::pipeline(gpu, &source, "cast_rays"),
            compare: shaders::pipeline(gpu, &source, "compare_beams"),
            depth,
        }
    }
}

/// Some of the poses with some of the directions.
struct Batch {
    poses: Range<usize>,
    rays: usize,
    /// Index of the part of the directions.
    part: usize,
}

impl Caster {
    /// For a map; with the pipelines of the previous one, if any, where they serve.
    pub fn new(gpu: &Gpu, map: &DeviceMap, previous: Option<&Self>) -> Self {
        let pipelines = previous.map(|previous| previous.pipelines.clone());
        let pipelines = pipelines
            .filter(|pipelines| pipelines.depth >= map.depth)
            .unwrap_or_else(|| Pipelines::new(gpu, map.depth));
        let kernel = |pipeline: &ComputePipeline| Kernel {
            map: bind(gpu, pipeline, 0, &[&map.nodes, &map.triangles]),
            pipeline: pipeline.clone(),
        };
        let summation = previous.map(|previous| previous.summation.clone());
        Self {
            cast: kernel(&pipelines.cast),
            compare: kernel(&pipelines.compare),
            summation: summation.unwrap_or_else(|| Summation::new(gpu)),
            pipelines,
        }
    }

    /// Ranges along directions of the lidar frame, one row per pose; [`FAR`] or more where no
    /// surface is nearer than `far_m`, and negative where one is seen from behind.
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

    /// Mean cost of the beams, one number per pose; 0 without beams. Surfaces outside of the range limits are not seen [m].
    pub fn compare(
        &self,
        gpu: &Gpu,
        map: &DeviceMap,
        poses: &[Pose],
        (beams, difference, [min_m, max_m]): (&[Beam], &RangeDifference, [f32; 2]),
    ) -> Result<Vec<f32>, RenderError> {
        let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
        let parts = parts(gpu, &directions, |index, _| beams[index].range_m);
        let query = Query {
            min_m,
            far_m: max_m.min(FAR),
            ..Query::new(map, difference)
        };
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
        let sums = PartialSums::new(gpu, poses.len(), count);
        let query = Query {
            rays: count as u32,
            groups: sums.groups,
            ..query
        };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        self.compare
            .encode(gpu, &mut encoder, query, poses, [rays, &sums.buffer]);
        self.summation.submit(gpu, encoder, &sums)
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
            min_m: 0.0,
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
        let step = gpu
            .batch_sizes
            .poses_per_batch(poses, part.rays, rays_per_batch);
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

/// Binds buffers to the bindings 0, 1, 2 … of a group.
fn bind(gpu: &Gpu, pipeline: &ComputePipeline, group: u32, buffers: &[&Buffer]) -> BindGroup {
    let layout = pipeline.get_bind_group_layout(group);
    shaders::bind(gpu, &layout, buffers)
}
