//! A graphics device: found, opened, its faults remembered, results read back.
//!
//! wgpu reports faults to callbacks, by default by a panic. Here the callbacks write the first
//! fault down, and whoever reads a result asks for it first, so that no result of a device that
//! has failed is ever taken for a range. A fault stays: the device is not used again.

use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytemuck::{NoUninit, Pod};
use wgpu::{Buffer, BufferUsages};

use super::batch_sizes::BatchSizes;
use crate::rendering::RenderError;
use crate::rendering::backend::{AdapterKind, AdapterReport, Backend, best_adapter};

/// After this long a batch is taken for lost; each is meant to take a fraction of a second.
const PATIENCE: Duration = Duration::from_secs(120);

/// As large as the largest element of any array in the shaders [bytes].
const SMALLEST_BUFFER: u64 = 64;

/// All graphics adapters of this machine, best first.
pub fn adapters() -> Vec<AdapterReport> {
    found_adapters().iter().map(report).collect()
}

/// Best first. OpenGL is only asked where Vulkan knows no adapter: it would name the same ones
/// again. Where there is no display, Mesa's libraries complain on standard error; for Vulkan that
/// is its layer that chooses among devices, which `NODEVICE_SELECT=1` leaves out.
fn found_adapters() -> Vec<wgpu::Adapter> {
    let mut found = found_through(wgpu::Backends::PRIMARY);
    if found.is_empty() {
        found = found_through(wgpu::Backends::SECONDARY);
    }
    found.sort_by_key(|adapter| kind(adapter.get_info().device_type));
    found
}

fn found_through(backends: wgpu::Backends) -> Vec<wgpu::Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    pollster::block_on(instance.enumerate_adapters(backends))
}

fn kind(device_type: wgpu::DeviceType) -> AdapterKind {
    match device_type {
        wgpu::DeviceType::DiscreteGpu => AdapterKind::Discrete,
        wgpu::DeviceType::IntegratedGpu => AdapterKind::Integrated,
        wgpu::DeviceType::VirtualGpu => AdapterKind::Virtual,
        wgpu::DeviceType::Other => AdapterKind::Unknown,
        wgpu::DeviceType::Cpu => AdapterKind::Software,
    }
}

fn report(adapter: &wgpu::Adapter) -> AdapterReport {
    let info = adapter.get_info();
    let limits = adapter.limits();
    AdapterReport {
        name: info.name,
        kind: kind(info.device_type),
        api: info.backend.to_string(),
        driver: format!("{} {}", info.driver, info.driver_info),
        max_binding_bytes: limits.max_storage_buffer_binding_size,
        max_buffer_bytes: limits.max_buffer_size,
        max_texture_size: limits.max_texture_dimension_2d,
        obstacle: obstacle(adapter),
    }
}

fn obstacle(adapter: &wgpu::Adapter) -> Option<&'static str> {
    let flags = adapter.get_downlevel_capabilities().flags;
    let limits = adapter.limits();
    if !flags.contains(wgpu::DownlevelFlags::COMPUTE_SHADERS) {
        Some("it has no compute shaders")
    } else if limits.max_storage_buffers_per_shader_stage < 6 {
        Some("its shaders read fewer than 6 buffers")
    } else {
        None
    }
}

/// What went wrong first.
#[derive(Default)]
struct Faults {
    lost: Mutex<Option<String>>,
    refused: Mutex<Option<String>>,
}

fn note(slot: &Mutex<Option<String>>, reason: String) {
    slot.lock()
        .unwrap_or_else(PoisonError::into_inner)
        .get_or_insert(reason);
}

fn noted(slot: &Mutex<Option<String>>) -> Option<String> {
    slot.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// An open device.
pub(super) struct Gpu {
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
    pub report: AdapterReport,
    pub limits: wgpu::Limits,
    pub batch_sizes: BatchSizes,
    /// Whether the stages of the rasterizer can read the map.
    pub can_rasterize: bool,
    faults: Arc<Faults>,
}

impl Gpu {
    /// Opens the best adapter that the backend allows, with all that it can bind.
    pub fn open(backend: Backend) -> Result<Self, RenderError> {
        let adapters = found_adapters();
        let reports: Vec<AdapterReport> = adapters.iter().map(report).collect();
        let index = best_adapter(&reports, backend).ok_or(RenderError::NoAdapter)?;
        let (adapter, report) = (&adapters[index], reports[index].clone());
        let limits = adapter.limits();
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("fpmcl"),
            required_limits: limits.clone(),
            ..wgpu::DeviceDescriptor::default()
        }))
        .map_err(|error| RenderError::DeviceRefused {
            reason: error.to_string(),
        })?;
        let faults = Arc::new(Faults::default());
        let heard = Arc::clone(&faults);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            note(&heard.refused, error.to_string());
        }));
        let heard = Arc::clone(&faults);
        device.set_device_lost_callback(move |reason, message| {
            note(&heard.lost, format!("{reason:?}: {message}"));
        });
        let stages = wgpu::DownlevelFlags::VERTEX_STORAGE | wgpu::DownlevelFlags::FRAGMENT_STORAGE;
        Ok(Self {
            device,
            queue,
            batch_sizes: BatchSizes::of(report.kind),
            report,
            limits,
            can_rasterize: adapter.get_downlevel_capabilities().flags.contains(stages),
            faults,
        })
    }

    /// An error if anything went wrong so far.
    pub fn check(&self) -> Result<(), RenderError> {
        let refused = noted(&self.faults.refused);
        if refused.is_some() {
            // A lost device refuses everything, and says only when polled that it is lost.
            let _ = self.device.poll(wgpu::PollType::Poll);
        }
        match (noted(&self.faults.lost), refused) {
            (Some(reason), _) => Err(RenderError::DeviceLost { reason }),
            (None, Some(reason)) => Err(RenderError::DeviceRefused { reason }),
            (None, None) => Ok(()),
        }
    }

    /// The largest buffer that shaders can read [bytes].
    pub fn max_binding_bytes(&self) -> u64 {
        self.limits
            .max_storage_buffer_binding_size
            .min(self.limits.max_buffer_size)
    }

    /// A buffer with these contents.
    pub fn upload<T: NoUninit>(&self, label: &str, contents: &[T], usage: BufferUsages) -> Buffer {
        let bytes: &[u8] = bytemuck::cast_slice(contents);
        let buffer = self.buffer(label, bytes.len() as u64, usage | BufferUsages::COPY_DST);
        self.queue.write_buffer(&buffer, 0, bytes);
        buffer
    }

    /// A buffer of zeros, with room for one element of what it is for: none can be empty.
    pub fn buffer(&self, label: &str, bytes: u64, usage: BufferUsages) -> Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes.max(SMALLEST_BUFFER).next_multiple_of(16),
            usage,
            mapped_at_creation: false,
        })
    }

    /// A buffer that results are copied to, to be read here.
    pub fn staging(&self, bytes: u64) -> Buffer {
        let usage = BufferUsages::COPY_DST | BufferUsages::MAP_READ;
        self.buffer("results", bytes, usage)
    }

    /// Starts the work that ends in a staging buffer.
    pub fn submit(&self, encoder: wgpu::CommandEncoder, staging: Buffer, bytes: u64) -> InFlight {
        let submission = self.queue.submit([encoder.finish()]);
        let (sender, done) = sync_channel(1);
        staging.map_async(wgpu::MapMode::Read, 0..bytes, move |result| {
            // Nobody waits any more where an earlier batch has failed.
            let _ = sender.try_send(result);
        });
        InFlight {
            staging,
            bytes,
            submission,
            done,
        }
    }

    /// Waits for the work and reads its result.
    pub fn fetch<T: Pod>(&self, work: &InFlight) -> Result<Vec<T>, RenderError> {
        let waited = self.device.poll(wgpu::PollType::Wait {
            submission_index: Some(work.submission.clone()),
            timeout: Some(PATIENCE),
        });
        self.check()?;
        let lost = |reason: String| RenderError::DeviceLost { reason };
        waited.map_err(|error| lost(error.to_string()))?;
        let mapped = work.done.recv_timeout(PATIENCE);
        let mapped = mapped.map_err(|_timeout| lost("no answer".to_owned()))?;
        self.check()?;
        mapped.map_err(|error| lost(error.to_string()))?;
        let view = work.staging.get_mapped_range(0..work.bytes);
        let view = view.map_err(|error| lost(error.to_string()))?;
        Ok(bytemuck::pod_collect_to_vec(&view))
    }
}

/// Work that was given to the device.
pub(super) struct InFlight {
    staging: Buffer,
    bytes: u64,
    submission: wgpu::SubmissionIndex,
    done: Receiver<Result<(), wgpu::BufferAsyncError>>,
}
