//! From oriented points to a triangle mesh: screened Poisson reconstruction, and what it invents
//! cut off again.

// The method.
pub mod poisson;
pub mod simplify;
pub mod trimming;
// What it stands on, in the order in which it is needed.
mod base_grid;
mod block;
mod cell_table;
mod collapse;
mod density;
mod fan;
mod isosurface;
mod manifold;
mod morton;
mod octree;
mod samples;
mod solver;

pub use manifold::split_fans;
pub use poisson::{MeshingError, PoissonConfig, Surface, reconstruct};
pub use simplify::simplify_ground;
pub use trimming::{trim_by_density, trim_by_distance};

#[cfg(test)]
mod shapes;
#[cfg(test)]
mod simplify_tests;
#[cfg(test)]
mod tests;
