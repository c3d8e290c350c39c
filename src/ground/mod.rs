//! Which points are road: a confidence between 0 and 1 per point.
//!
//! Three or four features of a point are fuzzified into linguistic sets, rules in words weigh
//! them, and the answer is soft and can be explained ([`FuzzyGround`]). Two plain methods stand
//! beside it for comparison ([`PcaGround`], [`RansacGround`]).

mod centroid;
mod classifier;
mod config;
mod features;
mod fuzzy;
mod inference;
mod membership;
mod pca;
mod polar;
mod ransac;
mod road;
mod rules;
#[cfg(test)]
mod scenes;
mod score;
mod surface;
mod terrain;
#[cfg(test)]
mod tests;

pub use classifier::GroundClassifier;
pub use config::{GroundConfig, GroundMethod};
pub use features::{FeatureConfig, Features};
pub use fuzzy::{Explanation, FiredRule, FuzzyConfig, FuzzyGround, MembershipCurve, Verdict};
pub use inference::{FuzzySystem, Inference};
pub use membership::{Membership, Operators};
pub use pca::{PcaGround, ReportRule};
pub use ransac::RansacGround;
pub use road::{RoadPlane, road_plane};
pub use rules::{RuleError, RuleFault, Vocabulary};
pub use score::{GroundScore, Protocol};
pub use terrain::TerrainConfig;
