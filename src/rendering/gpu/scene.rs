//! The map on the device.

use nalgebra::Vector3;
use wgpu::{Buffer, BufferUsages};

use super::device::Gpu;
use super::forest::{Forest, Tile};
use super::layout::Pose;
use crate::geometry::{Pose3, TriangleMesh};
use crate::rendering::RenderError;

/// Buffers of the map and what is known about them here.
pub(super) struct Scene {
    pub nodes: Buffer,
    pub triangles: Buffer,
    pub tiles: Vec<Tile>,
    pub root: u32,
    pub depth: usize,
    pub bytes: u64,
    center: Vector3<f64>,
}

impl Scene {
    /// Grows the hierarchy and sends it to the device.
    pub fn upload(gpu: &Gpu, tiles: &[TriangleMesh]) -> Result<Self, RenderError> {
        let forest = Forest::grow(tiles);
        let sizes = [
            size_of_val(forest.triangles.as_slice()) as u64,
            size_of_val(forest.nodes.as_slice()) as u64,
        ];
        check_sizes(&sizes, gpu.max_binding_bytes())?;
        let scene = Self {
            nodes: gpu.upload("nodes", &forest.nodes, BufferUsages::STORAGE),
            triangles: gpu.upload("triangles", &forest.triangles, BufferUsages::STORAGE),
            tiles: forest.tiles,
            root: forest.root,
            depth: forest.depth,
            bytes: sizes.iter().sum(),
            center: Vector3::new(forest.center.x, forest.center.y, forest.center.z),
        };
        gpu.check()?;
        Ok(scene)
    }

    /// Number of triangles of all tiles.
    pub fn triangle_count(&self) -> usize {
        self.tiles.iter().map(|tile| tile.triangles.len()).sum()
    }

    /// Poses as the shaders read them, relative to the centre of the map.
    pub fn poses(&self, map_from_lidar: &[Pose3]) -> Vec<Pose> {
        map_from_lidar
            .iter()
            .map(|pose| Pose::new(pose, self.center))
            .collect()
    }
}

/// An error where a shader could not read one of the buffers as a whole [bytes].
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
        let told = error.to_string();
        for part in ["300 bytes", "at most 128", "--backend cpu"] {
            assert!(told.contains(part), "{told}");
        }
    }
}
