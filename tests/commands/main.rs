//! The program from outside, the library as others use it, and the documentation. One program: it is linked once, and its tests
//! run side by side. Tests that measure times or memory, or that need a machine of their own, are other programs.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

#[cfg(feature = "bags")]
#[path = "../bag_writers/mod.rs"]
mod bag_writers;
#[path = "../common/mod.rs"]
mod common;

mod any_recording;
mod architecture;
mod bad_input;
mod benchmark;
mod build_jobs;
mod caches;
mod calibration;
mod cli;
mod clouds;
mod compare;
mod config_files;
mod documentation;
mod documented_commands;
mod examples;
mod export;
mod foreign_maps;
mod gnss;
mod ground;
mod ground_labels;
mod inertial;
mod json;
mod layouts;
mod limits;
mod messages;
mod names;
mod never_destroy;
mod odometry;
mod pipeline;
mod point_columns;
mod recordings;
mod robustness;
mod seams;
mod sensor_samples;
mod silent_errors;
mod soft_ground;
mod trajectories;
