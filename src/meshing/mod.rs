//! Triangle meshes from oriented points: screened Poisson reconstruction, trimming of unsupported
//! surface, simplification of the ground.

// The pipeline.
pub(crate) mod poisson;
pub(crate) mod simplify;
pub(crate) mod trimming;
// Its parts, in the order of their use.
mod adjacency;
mod base_grid;
mod case_table;
mod collapse;
mod density;
mod error;
mod fan;
mod isosurface;
mod manifold;
mod normal_field;
mod octree;
mod samples;
mod solver;
mod stencil;
mod weights;

pub use error::MeshingError;
pub use poisson::{PoissonConfig, Reconstruction, reconstruct, reconstruct_resolved};

pub(crate) use manifold::split_fans;
pub(crate) use simplify::simplify;
pub(crate) use trimming::{trim_by_density, trim_by_distance};

#[cfg(test)]
mod reconstruction_tests;
#[cfg(test)]
mod shapes_for_tests;
#[cfg(test)]
mod simplification_tests;
