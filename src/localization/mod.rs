//! Where the car is: Monte Carlo localization in the mesh map.
//!
//! > [`initialization`] spreads [`particles`], [`odometry`] says how the car moved, [`motion`]
//! > moves every particle so, [`observation`] weighs them by what the map would look like from
//! > there, [`resampling`] keeps the good ones, [`convergence`] says when a few are enough and
//! > [`vigilance`] when none is right; [`panorama`] finds the places to begin (again) at;
//! > [`localizer`] is the loop. [`likelihood`] shows how sharp the peak is.
//!
//! Poses are `map_from_lidar` in the plane; the map's ground lifts them into space.
//!
//! Dellaert et al., *Monte Carlo Localization for Mobile Robots*, ICRA 1999; Chen et al.,
//! *Range Image-based LiDAR Localization for Autonomous Vehicles*, ICRA 2021.

// What is estimated, and from what.
pub mod initialization;
pub mod odometry;
pub mod particles;
// One step of the filter.
pub mod motion;
pub mod observation;
pub mod proposal;
pub mod resampling;
pub mod tempering;
// Knowing how sure it is.
pub mod convergence;
pub mod likelihood;
pub mod panorama;
pub mod vigilance;
// The loop.
pub mod estimate;
pub mod localizer;
pub mod settings;

pub use estimate::FrameEstimate;
pub use localizer::{Localizer, Surroundings};
pub use particles::{Particle, ParticleSet};
pub use settings::LocalizerConfig;
pub use vigilance::State;

#[cfg(test)]
impl crate::rendering::test_world::TestWorld {
    /// The street as the localizer sees it.
    fn surroundings(&self) -> Surroundings<'_> {
        Surroundings {
            renderer: self,
            ground: &self.ground,
            tiles: &self.tiles,
            panoramas: None,
        }
    }
}
