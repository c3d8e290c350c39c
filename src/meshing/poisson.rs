//! Screened Poisson surface reconstruction: a closed surface from oriented points.
//!
//! ```text
//! χ = argmin ∫ |∇χ − V|² + α Σ_s a_s χ(s)² / h        surface = { χ = mean of χ at the samples }
//! ```
//!
//! V is the vector field of the samples' normals, each splatted at the depth of its sampling density
//! and weighted with the surface area of the sample. χ is a sum of degree-1 B-splines on an adaptive
//! octree with Neumann boundary, solved from coarse to fine. It increases along the normals, which
//! point to the front of the surface. Kazhdan and Hoppe, *Screened Poisson Surface Reconstruction*,
//! ACM Transactions on Graphics 32(3), 2013.

use std::ops::RangeInclusive;

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::base_grid;
use super::density::DensityField;
use super::error::MeshingError;
use super::isosurface::{self, NodalFunction, UnitMesh};
use super::normal_field::CoarseField;
use super::octree::{Level, Octree};
use super::samples::Samples;
use super::solver;
use super::stencil::{CORNER_OFFSETS, CornerValues, corner_index, interpolate, trilinear};
use super::weights::SampleWeights;
use crate::geometry::{PointCloud, TriangleMesh};
use crate::memory::{MemoryBudget, MemoryError};
use crate::validation::{InvalidValue, Validate, in_range, not_negative, positive};

/// Settings of the reconstruction.
///
/// Defaults: `scale` and `samples_per_node` are Open3D's values, `depth` is range-mcl's. α is per area of a
/// cell face here; in `benches/poisson.rs` 10 is the best compromise of error and coverage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PoissonConfig {
    /// Edge of the finest cells, 0.01 to 1.5 [m]; without effect where `depth` is given.
    #[default(0.1)]
    pub cell_m: f32,
    /// Depth of the finest cells, the number of bisections of the cube, 3 to 12; null: that of `cell_m`.
    pub depth: Option<u32>,
    /// Edge of the cube over the longest edge of the points' bounding box, 1.05 to 10 (unitless).
    #[default(1.1)]
    pub scale: f32,
    /// Screening weight α, 0 or more (unitless).
    #[default(10.0)]
    pub point_weight: f32,
    /// Desired number of samples per cell face; higher values smooth noise.
    #[default(1.5)]
    pub samples_per_node: f32,
    /// Conjugate gradient iterations per depth.
    #[default(8)]
    pub iterations: usize,
}

impl PoissonConfig {
    /// Allowed depths.
    pub(crate) const DEPTHS: RangeInclusive<u32> = 3..=12;

    /// Depth of the finest cells and edge of the cube [m], for the longest edge of the points' bounding box [m].
    fn cube(&self, extent_m: f32) -> (u32, f32) {
        let least_m = self.scale * extent_m;
        if let Some(depth) = self.depth {
            return (depth, least_m);
        }
        let depth = (least_m / self.cell_m).log2().ceil().max(0.0) as u32;
        let depth = depth.clamp(*Self::DEPTHS.start(), *Self::DEPTHS.end());
        (depth, least_m.max(self.cell_m * (1_u32 << depth) as f32))
    }
}

impl Validate for PoissonConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("cell_m", self.cell_m, 0.01..=MAX_CELL_M)?;
        in_range(
            "depth",
            self.depth.unwrap_or(*Self::DEPTHS.end()),
            Self::DEPTHS,
        )?;
        in_range("scale", self.scale, 1.05..=10.0)?;
        not_negative("point_weight", self.point_weight)?;
        positive("samples_per_node", self.samples_per_node)?;
        in_range("iterations", self.iterations, 1..=1000)
    }
}

/// A reconstructed surface.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reconstruction {
    /// Mesh, closed inside the cube, with unit vertex normals that point to the front.
    pub mesh: TriangleMesh,
    /// Sampling density per vertex: the depth at which a cell face has `samples_per_node` samples;
    /// one more is four times the samples. Low where the surface is not supported by samples.
    pub densities: Vec<f32>,
    /// Number of points ignored: not finite, without a normal, or without weight.
    pub dropped_points: usize,
    /// Edge of the finest cells [m].
    pub cell_m: f32,
}

/// Largest edge of the finest cells [m]: coarser ones show no road.
const MAX_CELL_M: f32 = 1.5;

/// Levels between the finest cells and the kernel of the density estimation, as in Kazhdan's program.
const KERNEL_LEVELS: u32 = 2;

/// Reconstructs the surface of oriented points, in the frame of the points [m].
///
/// Points without a finite position and normal are ignored. The result does not depend on the number of threads.
///
/// # Errors
/// If fewer than four points are usable, the finest cells are too large, the memory does not suffice, or
/// a setting is out of its range.
pub fn reconstruct(
    cloud: &PointCloud,
    config: &PoissonConfig,
    memory_budget: MemoryBudget,
) -> Result<Reconstruction, MeshingError> {
    reconstruct_resolved(cloud, config, |_| 0.0, memory_budget)
}

/// As [`reconstruct`], with cells that are at least half of the `resolution_m` at their position [m].
///
/// # Errors
/// As [`reconstruct`].
pub fn reconstruct_resolved(
    cloud: &PointCloud,
    config: &PoissonConfig,
    resolution_m: impl Fn(Vec3) -> f32 + Sync,
    memory_budget: MemoryBudget,
) -> Result<Reconstruction, MeshingError> {
    config.validate()?;
    let samples = Samples::new(cloud, |extent_m| config.cube(extent_m))?;
    let cell_m = samples.cell_m();
    if cell_m > MAX_CELL_M {
        return Err(MeshingError::CellsTooLarge {
            extent_m: samples.side_m / config.scale,
            cell_m,
            limit_m: MAX_CELL_M,
            depth: samples.depth,
        });
    }
    let kernel_depth = samples.depth.saturating_sub(KERNEL_LEVELS).max(2);
    let density = DensityField::new(&samples, kernel_depth, config.samples_per_node);
    let depths = density.sample_depths(&samples);
    let finest: Vec<f32> = (samples.positions.par_iter())
        .zip(&depths)
        .map(|(&position, &depth)| {
            let cells = (resolution_m(samples.to_cloud(position)) / cell_m).max(1.0);
            depth.min(samples.depth as f32 - cells.log2())
        })
        .collect();
    let tree = Octree::build(&samples, samples.depth, |sample, depth| {
        finest[sample] > (depth - 1) as f32
    });
    require_memory(&tree, &samples, memory_budget)?;
    let values = solve(&samples, [&depths, &finest], &tree, config);
    let function = NodalFunction {
        tree: &tree,
        values: &values,
    };
    let iso_value = mean_at_samples(&samples, &function);
    let surface = isosurface::extract(&function, iso_value);
    Ok(in_cloud_frame(surface, &samples, &density))
}

/// Requires the memory of the solver: per node its tables, the solution at 125 corners, the normal field
/// and five vectors of the conjugate gradients at 64; per sample its constraint.
fn require_memory(
    tree: &Octree,
    samples: &Samples,
    budget: MemoryBudget,
) -> Result<(), MemoryError> {
    const NODE_BYTES: f64 = 4096.0;
    const SAMPLE_BYTES: f64 = 256.0;
    let nodes: usize = tree.levels.iter().map(Level::len).sum();
    budget.require(
        "the octree of the surface",
        nodes as f64 * NODE_BYTES + samples.len() as f64 * SAMPLE_BYTES,
        "lower depth, or mesh fewer points at a time",
    )
}

/// The values of χ at the corners of all nodes, per level.
fn solve(
    samples: &Samples,
    depths: [&[f32]; 2],
    tree: &Octree,
    config: &PoissonConfig,
) -> Vec<Vec<CornerValues>> {
    let base = &tree.levels[0];
    // Samples that are sparser than the base level are splatted at the base level.
    let [depths, finest] = depths.map(|depths| -> Vec<f32> {
        (depths.iter().map(|depth| depth.max(base.depth as f32))).collect()
    });
    let weights = SampleWeights::new(
        &depths,
        &finest,
        config.samples_per_node,
        config.point_weight,
    );
    let mut coarse = CoarseField::base(samples, base, &weights);
    let mut values = vec![base_grid::solve(samples, base.depth, &weights).into_nodes(base)];
    for (index, levels) in tree.levels.windows(2).enumerate() {
        let (parents, level) = (&levels[0], &levels[1]);
        values.push(solver::refine(
            (parents, &values[index]),
            level,
            samples,
            &weights,
            &coarse,
            config.iterations,
        ));
        if index + 2 < tree.levels.len() {
            coarse = coarse.refined(level, samples, &weights);
        }
    }
    values
}

/// Mean of χ(s).
fn mean_at_samples(samples: &Samples, function: &NodalFunction<'_>) -> f32 {
    const CHUNK: usize = 4096;
    let value = |sample| f64::from(value_at_sample(samples, function, sample));
    let parts: Vec<f64> = (samples.codes.par_chunks(CHUNK).enumerate())
        .map(|(chunk, codes)| {
            let samples = (chunk * CHUNK..).take(codes.len());
            samples.fold(0.0, |sum, sample| sum + value(sample))
        })
        .collect();
    let sum: f64 = parts.iter().fold(0.0, |sum, part| sum + part);
    (sum / samples.len() as f64) as f32
}

fn value_at_sample(samples: &Samples, function: &NodalFunction<'_>, sample: usize) -> f32 {
    for (level, nodes) in function.tree.levels.iter().enumerate().rev() {
        let (cell, inside) = samples.cell(sample, nodes.depth);
        if let Some(node) = function.tree.node_at(level, cell) {
            let values = &function.values[level][node];
            let corner = corner_index(cell.map(|x| (x & 3) as usize));
            return interpolate(values, corner, &CORNER_OFFSETS, &trilinear(inside));
        }
    }
    0.0
}

/// The surface in the frame of the cloud, with normals and densities.
fn in_cloud_frame(surface: UnitMesh, samples: &Samples, density: &DensityField) -> Reconstruction {
    let vertices = surface.vertices.par_iter();
    let densities = (vertices.clone().with_min_len(1024))
        .map(|&vertex| density.depth_at(vertex))
        .collect();
    let mut mesh = TriangleMesh {
        vertices: vertices.map(|&v| samples.to_cloud(v)).collect(),
        triangles: surface.triangles,
        ..TriangleMesh::default()
    };
    mesh.compute_normals();
    Reconstruction {
        mesh,
        densities,
        dropped_points: samples.dropped,
        cell_m: samples.cell_m(),
    }
}
