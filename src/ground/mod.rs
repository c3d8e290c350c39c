//! Which points are road: a confidence between 0 and 1 per point.
//!
//! Three or four features of a point are fuzzified into linguistic sets, rules in words weigh
//! them, and the answer is soft and can be explained ([`FuzzyGround`]). Two plain methods stand
//! beside it for comparison ([`PcaGround`], [`RansacGround`]).

mod centroid;
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

use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Tells ground from the rest.
pub trait GroundClassifier: Send + Sync {
    /// The confidence, 0 to 1, that each point is ground, in the order of the points.
    ///
    /// `points` are one revolution (or what is left of it) in the lidar frame [m], z about up.
    /// Points that are not finite have confidence 0.
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32>;
}

/// Which classifier tells ground from the rest.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GroundMethod {
    /// [`FuzzyGround`].
    #[default]
    Fuzzy,
    /// [`PcaGround`].
    Pca,
    /// [`RansacGround`].
    Ransac,
}

impl GroundMethod {
    /// The classifier of this method.
    pub fn classifier(
        self,
        fuzzy: &FuzzyConfig,
        pca: &PcaGround,
        ransac: &RansacGround,
    ) -> Result<Box<dyn GroundClassifier>, RuleError> {
        Ok(match self {
            Self::Fuzzy => Box::new(FuzzyGround::new(fuzzy.clone())?),
            Self::Pca => Box::new(*pca),
            Self::Ransac => Box::new(*ransac),
        })
    }
}
