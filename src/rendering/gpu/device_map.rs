//! The map on the device.

use nalgebra::Vector3;
use wgpu::{Buffer, BufferUsages};

use super::device::Gpu;
use super::layout::Pose;
use super::two_level::{DeviceTile, TwoLevelBvh};
use crate::geometry::Pose3;
use crate::rendering::RenderError;

/// Buffers of the map and their layout.
pub(super) struct DeviceMap {
    pub nodes: Buffer,
    pub triangles: Buffer,
    pub tiles: Vec<DeviceTile>,
    pub root: u32,
    pub depth: usize,
    center: Vector3<f64>,
}

impl DeviceMap {
    /// Uploads a hierarchy.
    pub fn upload(gpu: &Gpu, bvh: TwoLevelBvh) -> Result<Self, RenderError> {
        let sizes = [
            size_of_val(bvh.triangles.as_slice()) as u64,
            size_of_val(bvh.nodes.as_slice()) as u64,
        ];
        check_sizes(&sizes, gpu.max_binding_bytes())?;
        // Here, on the way to the device, and on a device that shares the memory.
        gpu.memory_budget
            .require(
                "the graphics device",
                3.0 * (sizes[0] + sizes[1]) as f64 + gpu.batch_sizes.bytes(),
                "choose a smaller map, render on the CPU",
            )
            .map_err(RenderError::DeviceMemory)?;
        let map = Self {
            nodes: gpu.upload("nodes", &bvh.nodes, BufferUsages::STORAGE),
            triangles: gpu.upload("triangles", &bvh.triangles, BufferUsages::STORAGE),
            tiles: bvh.tiles,
            root: bvh.root,
            depth: bvh.depth,
            center: Vector3::new(bvh.center.x, bvh.center.y, bvh.center.z),
        };
        gpu.check()?;
        Ok(map)
    }

    /// Number of triangles in all tiles.
    pub fn triangle_count(&self) -> usize {
        self.tiles.iter().map(|tile| tile.triangles.len()).sum()
    }

    /// Poses for the shaders, relative to the centre of the map.
    pub fn poses(&self, map_from_lidar: &[Pose3]) -> Vec<Pose> {
        map_from_lidar
            .iter()
            .map(|pose| Pose::new(pose, self.center))
            .collect()
    }
}

/// Checks that shaders can bind each buffer as a whole [bytes].
fn check_sizes(sizes: &[u64], limit: u64) -> Result<(), RenderError> {
    match sizes.iter().copied().max() {
        Some(needed) if needed > limit => Err(RenderError::MapTooLarge { needed, limit }),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_buffer_decides_whether_a_map_can_be_bound() {
        assert!(check_sizes(&[100, 128], 128).is_ok());
        assert!(check_sizes(&[], 128).is_ok());
        let error = check_sizes(&[129, 300], 128).unwrap_err();
        assert!(matches!(
            error,
            RenderError::MapTooLarge {
                needed: 300,
                limit: 128
            }
        ));
        let message = error.to_string();
        for part in ["300 bytes", "at most 128", "CPU"] {
            assert!(message.contains(part), "{message}");
        }
    }
}
