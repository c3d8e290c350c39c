//! The commands: files, progress and pictures around the library.

// The commands, in the order of their use.
pub mod benchmark;
pub mod build_map;
pub mod demo;
pub mod doctor;
pub mod evaluate;
pub mod export;
pub mod ground;
pub mod info;
pub mod live;
pub mod localize;
pub mod odometry;
pub mod refine;
pub mod simulate;
// What they share.
pub mod motion_source;
pub mod pose_remedy;
pub mod stages;
pub mod trajectory;
