//! How well the car's pose is known: what a run left on disk, and how far it is from the truth.
//!
//! [`results`] is the file that `localize` and `refine` write and everything else reads;
//! [`range_mcl`] judges it by the rules of the parent.

mod atomic;
mod npy;
mod npz;
pub mod range_mcl;
pub mod results;

pub use atomic::write_atomically;
pub use npy::NpyError;
pub use npz::write_poses_npy;
pub use results::{LocalizationResults, ParticleLog, ParticleRow, ResultsError};
