//! Ground segmentation: the confidence, 0 to 1, that each point of a scan is ground.
//!
//! [`FuzzyGround`] fuzzifies three or five features of a point and infers the confidence from a
//! rule base in words, which can be explained. [`PcaGround`] and [`RansacGround`] are baselines.

// The interface, and the choice between its implementations.
mod classifier;
mod config;
// Fuzzy rules over features of points.
mod features;
mod fuzzy;
// Fuzzy inference.
mod defuzzification;
mod inference;
mod membership;
mod rules;
// Geometry of a scan.
mod direction_image;
mod polar_grid;
mod surface;
mod terrain;
// Baselines.
mod pca;
mod ransac;
// The ground plane below the sensor.
mod road;
#[cfg(test)]
mod scenes_for_tests;
#[cfg(test)]
mod tests;

pub use classifier::GroundClassifier;
pub use config::{GroundConfig, GroundMethod};
pub use features::{FeatureConfig, Features};
pub use fuzzy::{Explanation, FuzzyConfig, FuzzyGround};
pub use inference::Inference;
pub use membership::{MembershipFunction, Operators};
pub use pca::{PcaGround, ReportRule};
pub use ransac::RansacGround;
pub use road::{RoadConfig, RoadPlane, road_plane};
pub use rules::Vocabulary;
pub use terrain::TerrainConfig;
