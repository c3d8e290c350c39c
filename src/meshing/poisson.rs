//! Screened Poisson surface reconstruction: the closed surface that oriented points lie on.
//!
//! ```text
//! χ = argmin ∫ |∇χ − V|² + α Σ_s a_s χ(s)² / h        surface = { χ = mean of χ at the samples }
//! ```
//!
//! V is the field of the samples' normals, each as wide as the depth at which the samples are
//! dense, and as strong as the piece of surface it stands for. χ is a sum of degree-1 B-splines
//! on an adaptive octree with Neumann boundary, solved from coarse to fine. It rises along the
//! normals, so the front of the surface is where the normals point. Kazhdan and Hoppe, *Screened
//! Poisson Surface Reconstruction*, ACM Transactions on Graphics 32(3), 2013.

use std::ops::RangeInclusive;

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::base_grid::{self, trilinear};
use super::block::CLOSED;
use super::density::DensityField;
use super::isosurface::{self, NodalFunction};
use super::octree::Octree;
use super::samples::Samples;
use super::solver::{self, CoarseField, ScreeningWeights};
use crate::geometry::{PointCloud, TriangleMesh};
use crate::validation::{InvalidValue, Validate, at_least_one, in_range, not_negative, positive};

/// Settings of the reconstruction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoissonConfig {
    /// Halvings of the cube down to the finest cells, 3 to 12; `depth` of `build_map.yml`.
    #[serde(skip)]
    pub depth: u32,
    /// Edge of the cube over the longest edge of the points' bounding box, 1.05 to 10.
    pub scale: f32,
    /// α: how strongly the samples pull the surface to themselves, 0 or more; unitless.
    pub point_weight: f32,
    /// Samples that a cell's face shall hold: more is smoother in the face of noise.
    pub samples_per_node: f32,
    /// Steps of conjugate gradients per depth.
    pub iterations: usize,
}

impl Default for PoissonConfig {
    /// Scale and samples per node are Open3D's, the depth is range-mcl's. α counts per area of a
    /// cell's face here; `benches/poisson.rs` found 10 to serve error and coverage alike.
    fn default() -> Self {
        Self {
            depth: 9,
            scale: 1.1,
            point_weight: 10.0,
            samples_per_node: 1.5,
            iterations: 8,
        }
    }
}

impl PoissonConfig {
    /// Depths that can be reconstructed.
    pub const DEPTHS: RangeInclusive<u32> = 3..=12;
}

impl Validate for PoissonConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("depth", self.depth, Self::DEPTHS)?;
        in_range("scale", self.scale, 1.05..=10.0)?;
        not_negative("point_weight", self.point_weight)?;
        positive("samples_per_node", self.samples_per_node)?;
        at_least_one("iterations", self.iterations)
    }
}

/// A reconstructed surface.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// Closed inside the cube, with unit vertex normals that point to the front.
    pub mesh: TriangleMesh,
    /// Per vertex the depth at which a cell's face holds `samples_per_node` samples: one more is
    /// four times the samples. Low values are surface that no sample has seen.
    pub densities: Vec<f32>,
    /// Points that were left out because they or their normals were not finite, or had no weight.
    pub dropped_points: usize,
}

/// Why there is no surface.
#[derive(Debug, thiserror::Error, PartialEq)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum MeshingError {
    #[error(
        "only {usable} of {given} points can be meshed, at least {needed} at different places are needed; \
         check crop box and ranges"
    )]
    TooFewPoints {
        usable: usize,
        given: usize,
        needed: usize,
    },
    #[error("{weights} weights were given for {points} points; give one per point")]
    WeightsDoNotMatch { points: usize, weights: usize },
    #[error(transparent)]
    InvalidValue(#[from] InvalidValue),
}

/// Levels between the finest cells and the kernel that counts samples, as in Kazhdan's program.
const KERNEL_LEVELS: u32 = 2;

/// The surface through oriented points, in the frame of the points [m].
///
/// `weights` say per point how many points it counts for; points with weight 0, or without a finite
/// position and normal, are left out. The result is the same at any number of threads.
///
/// # Errors
/// With fewer than four usable points, or settings out of their ranges.
pub fn reconstruct(
    cloud: &PointCloud,
    weights: Option<&[f32]>,
    config: &PoissonConfig,
) -> Result<Surface, MeshingError> {
    config.validate()?;
    let samples = Samples::new(cloud, weights, config.depth, config.scale)?;
    let density = DensityField::new(
        &samples,
        config.depth.saturating_sub(KERNEL_LEVELS).max(2),
        config.samples_per_node,
    );
    let depths = density.sample_depths(&samples);
    let tree = Octree::build(&samples, config.depth, |sample, depth| {
        depths[sample] > (depth - 1) as f32
    });
    let function = solve(&samples, &depths, &tree, config);
    let function = NodalFunction {
        tree: &tree,
        values: &function,
    };
    let iso = mean_at_samples(&samples, &function);
    let unit = isosurface::extract(&function, iso);
    Ok(surface(&unit, &samples, &density))
}

/// The values of χ at the closed corners of all nodes, per level.
fn solve(
    samples: &Samples,
    depths: &[f32],
    tree: &Octree,
    config: &PoissonConfig,
) -> Vec<Vec<f32>> {
    let base = tree.levels[0].depth;
    // What is sparser than the base level is splatted there.
    let depths: Vec<f32> = depths.iter().map(|depth| depth.max(base as f32)).collect();
    let weights = ScreeningWeights {
        depths: &depths,
        weights: &samples.weights,
        samples_per_node: config.samples_per_node,
        point_weight: config.point_weight,
    };
    let mut coarse = CoarseField::base(samples, &tree.levels[0], &weights);
    let mut values = vec![base_grid::solve(samples, base, &weights).into_nodes(&tree.levels[0])];
    for index in 1..tree.levels.len() {
        let (above, level) = (&tree.levels[index - 1], &tree.levels[index]);
        values.push(solver::refine(
            (above, &values[index - 1]),
            level,
            samples,
            &weights,
            &coarse,
            config.iterations,
        ));
        if index + 1 < tree.levels.len() {
            coarse = coarse.refined(level, samples, &weights);
        }
    }
    values
}

/// Σ w χ(s) / Σ w.
fn mean_at_samples(samples: &Samples, function: &NodalFunction<'_>) -> f32 {
    const CHUNK: usize = 4096;
    let indices: Vec<usize> = (0..samples.len()).collect();
    let parts: Vec<(f64, f64)> = indices
        .par_chunks(CHUNK)
        .map(|chunk| {
            chunk.iter().fold((0.0, 0.0), |(sum, total), &sample| {
                let weight = f64::from(samples.weights[sample]);
                let value = f64::from(value_at_sample(samples, function, sample));
                (sum + weight * value, total + weight)
            })
        })
        .collect();
    let (sum, total) = parts
        .iter()
        .fold((0.0, 0.0), |(a, b), part| (a + part.0, b + part.1));
    (sum / total) as f32
}

fn value_at_sample(samples: &Samples, function: &NodalFunction<'_>, sample: usize) -> f32 {
    for (level, nodes) in function.tree.levels.iter().enumerate().rev() {
        let (cell, inside) = samples.cell(sample, nodes.depth);
        let Some(node) = function.tree.node_at(level, cell) else {
            continue;
        };
        let corner = cell.map(|x| (x & 3) as usize);
        let lowest = node * CLOSED + corner[0] + 5 * corner[1] + 25 * corner[2];
        let shape = trilinear(inside);
        return (0..8)
            .map(|i| {
                shape[i]
                    * function.values[level][lowest + (i & 1) + 5 * (i >> 1 & 1) + 25 * (i >> 2)]
            })
            .sum();
    }
    0.0
}

fn surface(unit: &isosurface::UnitMesh, samples: &Samples, density: &DensityField) -> Surface {
    let vertices: Vec<Vec3> = unit
        .vertices
        .par_iter()
        .map(|&vertex| samples.domain.to_metres(vertex))
        .collect();
    let densities = unit
        .vertices
        .par_iter()
        .with_min_len(1024)
        .map(|&vertex| density.depth_at(vertex))
        .collect();
    let mut mesh = TriangleMesh {
        vertices,
        triangles: unit.triangles.clone(),
        ..TriangleMesh::default()
    };
    mesh.compute_normals();
    Surface {
        mesh,
        densities,
        dropped_points: samples.dropped,
    }
}
