//! A node of ROS 2, without ROS.

pub mod arguments;
#[cfg(feature = "ros2")]
mod cdr;
#[cfg(feature = "ros2")]
mod drive;
#[cfg(feature = "ros2")]
mod frames;
#[cfg(feature = "ros2")]
mod node;
#[cfg(feature = "ros2")]
mod pose_buffer;
#[cfg(feature = "ros2")]
mod publisher;
#[cfg(feature = "ros2")]
mod receiver;
#[cfg(feature = "ros2")]
mod shared;

#[cfg(feature = "ros2")]
pub use drive::{check, drive};
