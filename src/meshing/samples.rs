//! The input of the solver: oriented points in the unit cube, in Morton order.

use glam::Vec3;
use rayon::prelude::*;

use super::error::MeshingError;
use crate::geometry::morton;
use crate::geometry::{Aabb, PointCloud};

/// Points in the unit cube, sorted by the Morton codes of their cells.
pub struct Samples {
    /// Depth of the cells of the codes.
    pub depth: u32,
    /// Morton codes, ascending.
    pub codes: Vec<u64>,
    /// Positions in the unit cube.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals.
    pub normals: Vec<[f32; 3]>,
    /// Lower corner of the cube in the frame of the cloud [m].
    origin: Vec3,
    /// Edge length of the cube [m].
    pub side_m: f32,
    /// Number of points ignored: not finite, or without a normal.
    pub dropped: usize,
}

impl Samples {
    /// Minimum number of usable points.
    const MIN_POINTS: usize = 4;

    /// The usable points of a cloud; `cube` returns the depth of the cells and the edge of the cube [m] for the longest edge
    /// of the points' bounding box [m].
    pub fn new(cloud: &PointCloud, cube: impl Fn(f32) -> (u32, f32)) -> Result<Self, MeshingError> {
        let usable: Vec<u32> = (0..cloud.len())
            .filter(|&index| is_usable(cloud, index))
            .map(|index| index as u32)
            .collect();
        let at = |index: u32| cloud.positions[index as usize];
        let bounds = Aabb::from_points(usable.iter().map(|&index| at(index)));
        let extent_m = bounds.size().max_element();
        if usable.len() < Self::MIN_POINTS || extent_m <= 0.0 {
            return Err(MeshingError::TooFewPoints {
                usable: usable.len(),
                given: cloud.len(),
                needed: Self::MIN_POINTS,
            });
        }
        let (depth, side_m) = cube(extent_m);
        let origin = bounds.center() - Vec3::splat(0.5 * side_m);
        let unit = |index: u32| (at(index) - origin) / side_m;
        let cells = (1_u32 << depth) as f32;
        let mut order: Vec<(u64, u32)> = usable
            .par_iter()
            .map(|&index| {
                let cell = (unit(index) * cells).as_uvec3();
                (morton::encode(cell.to_array()), index)
            })
            .collect();
        order.par_sort_unstable();
        let indices = || order.par_iter().map(|&(_, index)| index);
        Ok(Self {
            depth,
            codes: order.iter().map(|&(code, _)| code).collect(),
            positions: indices().map(|index| unit(index).to_array()).collect(),
            normals: indices()
                .map(|index| cloud.normals[index as usize].normalize().to_array())
                .collect(),
            origin,
            side_m,
            dropped: cloud.len() - usable.len(),
        })
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.codes.len()
    }

    /// Edge of the finest cells [m].
    pub fn cell_m(&self) -> f32 {
        self.side_m / (1_u32 << self.depth) as f32
    }

    /// Transforms a point from the unit cube to the frame of the cloud [m].
    pub fn to_cloud(&self, unit: [f32; 3]) -> Vec3 {
        self.origin + self.side_m * Vec3::from(unit)
    }

    /// The cell of a point at a depth, and the position in the cell, 0 to 1 per axis.
    #[inline]
    pub fn cell(&self, index: usize, depth: u32) -> ([i32; 3], [f32; 3]) {
        let cells = (1_u32 << depth) as f32;
        let scaled = self.positions[index].map(|x| x * cells);
        let cell = scaled.map(|x| x as i32);
        (cell, [0, 1, 2].map(|axis| scaled[axis] - cell[axis] as f32))
    }
}

fn is_usable(cloud: &PointCloud, index: usize) -> bool {
    let normal = cloud.normals[index];
    cloud.positions[index].is_finite() && normal.is_finite() && normal.length_squared() > 1e-12
}
