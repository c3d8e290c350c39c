//! Result files on disk: streamed in and out, one particle at a time.

mod read;
#[cfg(test)]
mod tests;
mod write;

pub use write::write_poses_npy;
