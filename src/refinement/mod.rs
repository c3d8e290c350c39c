//! A trajectory polished: a particle swarm over every pose, a finishing step, then smoothing.
//!
//! > [`refiner`] takes the estimate of a frame, lets a [`swarm`] look for a better one by the
//! > [`objective`], and Gauss-Newton ([`registration`](crate::registration)) finishes; [`smoothing`] fits the whole trajectory to what
//! > the frames and the odometry say.
//!
//! No step makes an estimate worse by its own measure: what does not improve is not taken.

pub mod objective;
pub mod refiner;
pub mod smoothing;
pub mod swarm;

pub use objective::FrameObjective;
pub use refiner::{Method, RefinedFrame, RefinementConfig, refine_frame};
pub use smoothing::{FramePrior, SmoothingConfig, smooth};

#[cfg(test)]
impl crate::rendering::test_world::TestWorld {
    /// The objective of a scan from the street.
    fn objective<'a>(&'a self, beams: &'a [crate::lidar::Beam]) -> FrameObjective<'a> {
        FrameObjective {
            renderer: self,
            ground: &self.ground,
            beams,
            level_m: None,
            stance: crate::map::Stance::default(),
            difference: crate::rendering::RangeDifference::truncated(0.5),
        }
    }
}
