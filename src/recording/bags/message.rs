//! Headers, poses and transforms of messages.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use super::fields::Fields;
use super::index::{Content, Serialization};
use crate::geometry::{FARTHEST_M, Pose3};
use crate::inertial::ImuSample;

/// `std_msgs/Header`.
pub struct Header {
    /// When it was measured [s]; 0 if unknown.
    pub stamp_s: f64,
    /// Name of the frame, without a slash before it.
    pub frame: String,
}

impl Header {
    /// Reads the header at the begin of a message.
    pub fn read(fields: &mut Fields) -> Result<Self, String> {
        if fields.has_sequence_numbers() {
            fields.u32()?;
        }
        let (seconds, nanoseconds) = (fields.u32()?, fields.u32()?);
        Ok(Self {
            stamp_s: f64::from(seconds) + 1e-9 * f64::from(nanoseconds),
            frame: frame(fields)?,
        })
    }
}

fn frame(fields: &mut Fields) -> Result<String, String> {
    Ok(fields.text()?.trim_start_matches('/').to_owned())
}

/// The pose of a frame in another one at a time.
#[derive(Clone, Debug, PartialEq)]
pub struct FramePose {
    /// When it was measured, or logged if that is unknown [s].
    pub time_s: f64,
    /// Name of the frame that the pose is in.
    pub parent: String,
    /// Name of the frame whose pose it is; empty if the message has none.
    pub child: String,
    /// `p_parent = parent_from_child * p_child`.
    pub parent_from_child: Pose3,
}

/// Reads the poses of a message; `log_s` is the moment of those without a stamp.
pub fn read_poses(
    message: &[u8],
    serialization: Serialization,
    content: Content,
    log_s: f64,
) -> Result<Vec<FramePose>, String> {
    let mut fields = Fields::new(message, serialization)?;
    let fields = &mut fields;
    let count = match content {
        Content::TransformTree => fields.u32()?,
        _ => 1,
    };
    let mut poses = Vec::new();
    for _ in 0..count {
        fields.align(4);
        let header = Header::read(fields)?;
        let child = match content {
            Content::Pose => String::new(),
            _ => frame(fields)?,
        };
        poses.push(FramePose {
            time_s: if header.stamp_s == 0.0 {
                log_s
            } else {
                header.stamp_s
            },
            parent: header.frame,
            child,
            parent_from_child: pose(fields)?,
        });
    }
    Ok(poses)
}

/// Reads a pose with its covariance: the standard deviations of its position, along the axis with the larger one [m], and of
/// its heading [rad], as far as they are numbers.
#[cfg(feature = "ros2")]
pub fn read_proposal(fields: &mut Fields) -> Result<(FramePose, [f64; 2]), String> {
    let header = Header::read(fields)?;
    let pose = FramePose {
        time_s: header.stamp_s,
        parent: header.frame,
        child: String::new(),
        parent_from_child: pose(fields)?,
    };
    let mut covariance = [0.0; 36];
    for number in &mut covariance {
        *number = fields.f64()?;
    }
    let variances = [covariance[0].max(covariance[7]), covariance[35]];
    Ok((pose, variances.map(|it| it.max(0.0).sqrt())))
}

/// Reads a `sensor_msgs/Imu`, and the name of its frame; `log_s` is the moment of one without a stamp.
pub fn read_imu(
    message: &[u8],
    serialization: Serialization,
    log_s: f64,
) -> Result<(ImuSample, String), String> {
    /// Orientation, its covariance, rates, their covariance, forces.
    const NUMBERS: usize = 4 + 9 + 3 + 9 + 3;
    let mut fields = Fields::new(message, serialization)?;
    let header = Header::read(&mut fields)?;
    let mut numbers = [0.0; NUMBERS];
    for number in &mut numbers {
        *number = fields.f64()?;
    }
    let sample = ImuSample {
        time_s: if header.stamp_s == 0.0 {
            log_s
        } else {
            header.stamp_s
        },
        rate_rad_s: Vector3::from_column_slice(&numbers[13..16]),
        force_m_s2: Vector3::from_column_slice(&numbers[25..28]),
    };
    Ok((sample, header.frame))
}

/// A position or translation, and a quaternion x, y, z, w.
fn pose(fields: &mut Fields) -> Result<Pose3, String> {
    let mut numbers = [0.0; 7];
    for number in &mut numbers {
        *number = fields.f64()?;
    }
    let [x, y, z, i, j, k, w] = numbers;
    let quaternion = Quaternion::new(w, i, j, k);
    let is_on_earth = [x, y, z].iter().all(|m| m.abs() <= FARTHEST_M);
    if !is_on_earth || !(0.9..1.1).contains(&quaternion.norm()) {
        return Err(format!(
            "has no pose: position {x} {y} {z}, quaternion {i} {j} {k} {w}"
        ));
    }
    Ok(Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_quaternion(quaternion),
    ))
}
