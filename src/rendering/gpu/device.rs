//! A graphics device: enumeration, opening, errors, buffers and read-back.
//!
//! wgpu reports errors to callbacks, by default by a panic. Here the callbacks record the first
//! error, which is checked before any result is read, so that no result of a failed device is ever
//! taken for a range. An error stays: the device is not used again.

use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytemuck::{NoUninit, Pod};
use wgpu::{Buffer, BufferUsages};

use super::batch_sizes::BatchSizes;
use crate::memory::MemoryBudget;
use crate::rendering::RenderError;
use crate::rendering::backend::{AdapterKind, AdapterReport, Backend, best_adapter};

/// Time after which a batch is considered lost; each should take a fraction of a second.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Size of the largest element of any array in the shaders [bytes].
const MIN_BUFFER_BYTES: u64 = 64;

/// All graphics adapters of this machine, best first.
pub fn adapters() -> Vec<AdapterReport> {
    enumerate_adapters().iter().map(report).collect()
}

/// Best first. OpenGL is only enumerated if Vulkan has no adapter: it would list the same ones
/// again. Without a display, Mesa's libraries print warnings on standard error; for Vulkan its
/// device selection layer does, which `NODEVICE_SELECT=1` disables.
fn enumerate_adapters() -> Vec<wgpu::Adapter> {
    let mut found = enumerate(wgpu::Backends::PRIMARY);
    if found.is_empty() {
        found = enumerate(wgpu::Backends::SECONDARY);
    }
    found.sort_by_key(|adapter| kind(adapter.get_info().device_type));
    found
}

fn enumerate(backends: wgpu::Backends) -> Vec<wgpu::Adapter> {
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

/// First errors that the device reported.
#[derive(Default)]
struct DeviceErrors {
    lost: Mutex<Option<String>>,
    refused: Mutex<Option<String>>,
}

fn record(slot: &Mutex<Option<String>>, reason: String) {
    slot.lock()
        .unwrap_or_else(PoisonError::into_inner)
        .get_or_insert(reason);
}

fn recorded(slot: &Mutex<Option<String>>) -> Option<String> {
    slot.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// An open device.
pub(super) struct Gpu {
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
    pub report: AdapterReport,
    pub limits: wgpu::Limits,
    pub batch_sizes: BatchSizes,
    /// Memory for what is on the device.
    pub memory_budget: MemoryBudget,
    /// Whether vertex and fragment shaders can read the map.
    pub can_rasterize: bool,
    errors: Arc<DeviceErrors>,
}

impl Gpu {
    /// Opens the best adapter that the backend allows, with its own limits.
    pub fn open(backend: Backend) -> Result<Self, RenderError> {
        let adapters = enumerate_adapters();
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
        let errors = Arc::new(DeviceErrors::default());
        let recorder = Arc::clone(&errors);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            record(&recorder.refused, error.to_string());
        }));
        let recorder = Arc::clone(&errors);
        device.set_device_lost_callback(move |reason, message| {
            record(&recorder.lost, format!("{reason:?}: {message}"));
        });
        let stages = wgpu::DownlevelFlags::VERTEX_STORAGE | wgpu::DownlevelFlags::FRAGMENT_STORAGE;
        Ok(Self {
            device,
            queue,
            batch_sizes: BatchSizes::of(report.kind),
            memory_budget: MemoryBudget::default(),
            report,
            limits,
            can_rasterize: adapter.get_downlevel_capabilities().flags.contains(stages),
            errors,
        })
    }

    /// Returns the first error that the device has reported.
    pub fn check(&self) -> Result<(), RenderError> {
        let refused = recorded(&self.errors.refused);
        if refused.is_some() {
            // A lost device refuses all work, and reports the loss only when polled.
            let _ = self.device.poll(wgpu::PollType::Poll);
        }
        match (recorded(&self.errors.lost), refused) {
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

    /// A buffer of zeros with room for at least one element, because none can be empty.
    pub fn buffer(&self, label: &str, bytes: u64, usage: BufferUsages) -> Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes.max(MIN_BUFFER_BYTES).next_multiple_of(16),
            usage,
            mapped_at_creation: false,
        })
    }

    /// A buffer that results are copied to for reading on the host.
    pub fn staging(&self, bytes: u64) -> Buffer {
        let usage = BufferUsages::COPY_DST | BufferUsages::MAP_READ;
        self.buffer("results", bytes, usage)
    }

    /// Starts the work that ends in a staging buffer.
    pub fn submit(&self, encoder: wgpu::CommandEncoder, staging: Buffer, bytes: u64) -> InFlight {
        let submission = self.queue.submit([encoder.finish()]);
        let (sender, done) = sync_channel(1);
        staging.map_async(wgpu::MapMode::Read, 0..bytes, move |result| {
            // The receiver is gone if an earlier batch has failed.
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
            timeout: Some(TIMEOUT),
        });
        self.check()?;
        let lost = |reason: String| RenderError::DeviceLost { reason };
        waited.map_err(|error| lost(error.to_string()))?;
        let mapped = work.done.recv_timeout(TIMEOUT);
        let mapped = mapped.map_err(|_timeout| lost("no answer".to_owned()))?;
        self.check()?;
        mapped.map_err(|error| lost(error.to_string()))?;
        let view = work.staging.get_mapped_range(0..work.bytes);
        let view = view.map_err(|error| lost(error.to_string()))?;
        Ok(bytemuck::pod_collect_to_vec(&view))
    }
}

/// Work that was submitted to the device.
pub(super) struct InFlight {
    staging: Buffer,
    bytes: u64,
    submission: wgpu::SubmissionIndex,
    done: Receiver<Result<(), wgpu::BufferAsyncError>>,
}
