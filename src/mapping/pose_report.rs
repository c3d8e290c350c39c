//! What the scans of a recording say about its poses.

use std::fmt;

use crate::odometry::{MotionDifference, PoseCheck, PoseFit, PoseMeaning};

/// Checks of the poses of a recording against its scans.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseReport {
    /// The first and the last frame whose motion was compared.
    pub frames: [usize; 2],
    /// The comparison of the motions; `None` if the sensor stands or its motion is uncertain.
    pub motion: Option<PoseCheck>,
    /// The ground in the map; `None` where too little is visible.
    pub tilt: Option<Tilt>,
}

/// Normal of the ground in the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tilt {
    /// Angle to the z axis [rad].
    pub tilt_rad: f64,
    /// Median deviation of single scans [rad].
    pub spread_rad: f64,
}

impl Tilt {
    /// Whether single scans deviate by more than 10 degrees.
    pub fn is_uneven(&self) -> bool {
        self.spread_rad.to_degrees() > 10.0
    }

    /// Whether the map is tilted by more than 15 degrees.
    pub fn is_steep(&self) -> bool {
        self.tilt_rad.to_degrees() > 15.0
    }
}

impl PoseReport {
    /// Whether the poses fit the scans; unknown motion counts as a fit.
    pub fn fit(&self) -> PoseFit {
        self.motion.as_ref().map_or(PoseFit::Fits, |it| it.fit)
    }

    /// Another interpretation of the poses, with which they fit.
    pub fn better(&self) -> Option<PoseMeaning> {
        Some(self.motion.as_ref()?.better.as_ref()?.0)
    }
}

impl fmt::Display for PoseReport {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let difference = |difference: &MotionDifference| {
            format!(
                "{:.2} m and {:.1} degrees",
                difference.translation_m,
                difference.rotation_rad.to_degrees()
            )
        };
        let [first, last] = self.frames;
        let Some(motion) = &self.motion else {
            return formatter.write_str("the sensor is stationary, or its motion is uncertain");
        };
        write!(
            formatter,
            "between frames {first} and {last}, their motion differs by {} per frame from that of the scans, which is {}",
            difference(&motion.given),
            difference(&motion.motion)
        )?;
        match &motion.better {
            Some((meaning, better)) => write!(
                formatter,
                "; as {} they differ by {}",
                name(*meaning),
                difference(better)
            ),
            None => Ok(()),
        }
    }
}

fn name(meaning: PoseMeaning) -> &'static str {
    match meaning {
        PoseMeaning::Given => "given",
        PoseMeaning::Camera => "poses of a camera",
        PoseMeaning::Lidar => "poses of the lidar itself",
        PoseMeaning::Mirrored => "poses of left-handed frames, mirrored at y",
        PoseMeaning::Inverse => "inverse poses (lidar_from_world)",
        PoseMeaning::Turned(_) => "poses of a body about whose z axis the lidar is turned",
    }
}
