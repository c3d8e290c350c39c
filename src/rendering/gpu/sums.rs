//! Sums of the costs of a pose, on the device; twin of `reduce.wgsl`.

use wgpu::{Buffer, BufferUsages, CommandEncoder, ComputePipeline};

use super::device::{Gpu, InFlight};
use super::layout::{BEAMS_PER_GROUP, Reduction};
use super::shaders;

/// Adds up what the work groups of each pose have summed.
#[derive(Clone)]
pub(super) struct Summation {
    pipeline: ComputePipeline,
}

/// Sums of the work groups, pose by pose.
pub(super) struct PartialSums {
    pub buffer: Buffer,
    /// Work groups per pose.
    pub groups: u32,
    poses: usize,
}

impl PartialSums {
    /// Room for the sums of so many beams or pixels of each pose.
    pub fn new(gpu: &Gpu, poses: usize, beams: usize) -> Self {
        let groups = (beams as u32).div_ceil(BEAMS_PER_GROUP);
        let bytes = (poses * groups as usize * size_of::<f32>()) as u64;
        Self {
            buffer: results(gpu, bytes),
            groups,
            poses,
        }
    }
}

impl Summation {
    pub fn new(gpu: &Gpu) -> Self {
        Self {
            pipeline: shaders::pipeline(gpu, shaders::REDUCE, "reduce"),
        }
    }

    /// Starts the work with a sum per pose at its end.
    pub fn submit(&self, gpu: &Gpu, mut encoder: CommandEncoder, sums: &PartialSums) -> InFlight {
        let bytes = (sums.poses * size_of::<f32>()) as u64;
        let totals = results(gpu, bytes);
        let reduction = Reduction {
            terms: sums.groups,
            unused: [0; 3],
        };
        let reduction = gpu.upload("reduction", &[reduction], BufferUsages::UNIFORM);
        let layout = self.pipeline.get_bind_group_layout(0);
        let bound = shaders::bind(gpu, &layout, &[&reduction, &sums.buffer, &totals]);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &bound, &[]);
        pass.dispatch_workgroups(sums.poses as u32, 1, 1);
        drop(pass);
        read_back(gpu, encoder, &totals, bytes)
    }
}

/// A buffer for results.
pub(super) fn results(gpu: &Gpu, bytes: u64) -> Buffer {
    let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC;
    gpu.buffer("results", bytes, usage)
}

/// Starts the work whose results are read.
pub(super) fn read_back(
    gpu: &Gpu,
    mut encoder: CommandEncoder,
    results: &Buffer,
    bytes: u64,
) -> InFlight {
    let staging = gpu.staging(bytes);
    encoder.copy_buffer_to_buffer(results, 0, &staging, 0, bytes);
    gpu.submit(encoder, staging, bytes)
}
