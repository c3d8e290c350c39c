//! Choice and parameters of the ground classifier.

use serde::{Deserialize, Serialize};

use super::classifier::GroundClassifier;
use super::fuzzy::{FuzzyConfig, FuzzyGround};
use super::pca::{PcaGround, ReportRule};
use super::ransac::RansacGround;
use super::road::RoadConfig;
use crate::validation::{InvalidValue, Validate, nested};

/// Method of ground segmentation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
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

/// The method of ground segmentation and the parameters of every method.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct GroundConfig {
    /// Method.
    pub method: GroundMethod,
    /// Features, sets and rules of the fuzzy method.
    pub fuzzy: FuzzyConfig,
    /// Parameters of principal components.
    pub pca: PcaGround,
    /// Parameters of the RANSAC plane.
    pub ransac: RansacGround,
    /// Ground from which localization and refinement compute the plane of the road, for the attitude of the sensor; labels
    /// do not depend on it.
    pub road: RoadConfig,
}

/// A classifier with its name for tables.
pub type NamedClassifier = (&'static str, Box<dyn GroundClassifier>);

impl GroundConfig {
    /// Builds the configured classifier for a sensor at a height above the ground [m]; `None` where it is unknown.
    ///
    /// # Errors
    /// A field of the configured method is out of its range.
    pub fn classifier(
        &self,
        height_m: Option<f64>,
    ) -> Result<Box<dyn GroundClassifier>, InvalidValue> {
        self.validate()?;
        Ok(match self.method {
            GroundMethod::Fuzzy => Box::new(FuzzyGround::new(self.fuzzy.clone())?),
            GroundMethod::Pca => Box::new(self.pca.mounted(height_m)),
            GroundMethod::Ransac => Box::new(self.ransac),
        })
    }

    /// Builds the classifiers of all methods with their names for tables: the configured one first.
    pub(crate) fn all_classifiers(&self) -> Result<Vec<NamedClassifier>, InvalidValue> {
        let three_features = FuzzyConfig::three_features();
        let mut all: Vec<NamedClassifier> = vec![
            ("fuzzy", Box::new(FuzzyGround::new(self.fuzzy.clone())?)),
            (
                "fuzzy, three features",
                Box::new(FuzzyGround::new(three_features)?),
            ),
            ("PCA", Box::new(self.pca)),
            ("RANSAC plane", Box::new(self.ransac)),
            ("rule of the report", Box::new(ReportRule)),
        ];
        let configured = match self.method {
            GroundMethod::Fuzzy => 0,
            GroundMethod::Pca => 2,
            GroundMethod::Ransac => 3,
        };
        all[..=configured].rotate_right(1);
        Ok(all)
    }
}

impl Validate for GroundConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("fuzzy", &self.fuzzy)?;
        nested("pca", &self.pca)?;
        nested("ransac", &self.ransac)?;
        nested("road", &self.road)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_impossible_limit_of_the_ground_is_named() {
        let mut config = GroundConfig::default();
        config.road.min_width_m2 = 0.0;
        assert_eq!(config.validate().unwrap_err().key, "road.min_width_m2");
        config.fuzzy.features.terrain.plane_share = 1.5;
        let error = config.validate().unwrap_err();
        assert_eq!(error.key, "fuzzy.features.terrain.plane_share");
    }

    #[test]
    fn the_configured_method_comes_first_of_all() {
        for (method, first) in [
            (GroundMethod::Fuzzy, "fuzzy"),
            (GroundMethod::Pca, "PCA"),
            (GroundMethod::Ransac, "RANSAC plane"),
        ] {
            let config = GroundConfig {
                method,
                ..GroundConfig::default()
            };
            let all = config.all_classifiers().unwrap();
            assert_eq!((all[0].0, all.len()), (first, 5));
        }
    }
}
