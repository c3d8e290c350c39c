//! Messages of ROS 2 in plain CDR, little-endian: numbers aligned to their size, counted from after a header of four bytes that
//! the transport adds.

use nalgebra::{Matrix6, Vector3};

use crate::geometry::Pose3;

/// The bytes of a message.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cdr(Vec<u8>);

impl Cdr {
    /// A message that begins with `std_msgs/Header`; the stamp in nanoseconds.
    pub fn with_header(stamp_ns: u64, frame: &str) -> Self {
        Self::default().header(stamp_ns, frame)
    }

    /// `std_msgs/Header`.
    pub fn header(self, stamp_ns: u64, frame: &str) -> Self {
        let seconds = (stamp_ns / 1_000_000_000) as u32;
        let nanoseconds = (stamp_ns % 1_000_000_000) as u32;
        self.u32(seconds).u32(nanoseconds).text(frame)
    }

    /// A number of one byte, or a truth value.
    pub fn u8(mut self, number: impl Into<u8>) -> Self {
        self.0.push(number.into());
        self
    }

    /// A number, also that of the elements that follow.
    pub fn u32(self, number: u32) -> Self {
        self.number(&number.to_le_bytes())
    }

    /// Numbers.
    pub fn f64s(self, numbers: impl IntoIterator<Item = f64>) -> Self {
        (numbers.into_iter()).fold(self, |cdr, number| cdr.number(&number.to_le_bytes()))
    }

    /// A text.
    pub fn text(self, text: &str) -> Self {
        let mut cdr = self.u32(text.len() as u32 + 1);
        cdr.0.extend(text.bytes().chain([0]));
        cdr
    }

    /// A number of bytes, and these.
    pub fn bytes(self, bytes: &[u8]) -> Self {
        let mut cdr = self.u32(bytes.len() as u32);
        cdr.0.extend(bytes);
        cdr
    }

    /// Bytes of a fixed number.
    pub fn array(mut self, bytes: &[u8]) -> Self {
        self.0.extend(bytes);
        self
    }

    /// `geometry_msgs/Pose` and `Transform`.
    pub fn pose(self, pose: &Pose3) -> Self {
        let position = pose.translation.vector;
        let quaternion = pose.rotation.coords;
        self.f64s(position.iter().chain(quaternion.iter()).copied())
    }

    /// The covariance of a pose or a velocity, row-major.
    pub fn covariance(self, covariance: &Matrix6<f64>) -> Self {
        self.f64s(covariance.transpose().iter().copied())
    }

    /// `geometry_msgs/Twist`: velocity [m/s] and turn rate [rad/s].
    pub fn twist(self, linear: Vector3<f64>, angular: Vector3<f64>) -> Self {
        self.f64s(linear.iter().chain(angular.iter()).copied())
    }

    /// Names and values of `diagnostic_msgs/KeyValue`.
    pub fn values(self, values: &[(&str, String)]) -> Self {
        let cdr = self.u32(values.len() as u32);
        values
            .iter()
            .fold(cdr, |cdr, (key, value)| cdr.text(key).text(value))
    }

    /// The bytes.
    pub fn finish(self) -> Vec<u8> {
        self.0
    }

    fn number(mut self, bytes: &[u8]) -> Self {
        self.0.resize(self.0.len().next_multiple_of(bytes.len()), 0);
        self.0.extend(bytes);
        self
    }
}
