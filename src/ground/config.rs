//! Choice and parameters of the ground classifier.

use serde::{Deserialize, Serialize};

use super::classifier::GroundClassifier;
use super::fuzzy::{FuzzyConfig, FuzzyGround};
use super::pca::PcaGround;
use super::ransac::RansacGround;
use crate::validation::{InvalidValue, Validate, nested};

/// Method of ground segmentation.
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

/// The method of ground segmentation and the parameters of every method.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GroundConfig {
    /// The method that [`classifier`](Self::classifier) builds.
    pub method: GroundMethod,
    /// Parameters of [`GroundMethod::Fuzzy`].
    pub fuzzy: FuzzyConfig,
    /// Parameters of [`GroundMethod::Pca`].
    pub pca: PcaGround,
    /// Parameters of [`GroundMethod::Ransac`].
    pub ransac: RansacGround,
}

impl GroundConfig {
    /// Builds the configured classifier.
    pub fn classifier(&self) -> Result<Box<dyn GroundClassifier>, InvalidValue> {
        self.validate()?;
        Ok(match self.method {
            GroundMethod::Fuzzy => Box::new(FuzzyGround::new(self.fuzzy.clone())?),
            GroundMethod::Pca => Box::new(self.pca),
            GroundMethod::Ransac => Box::new(self.ransac),
        })
    }
}

impl Validate for GroundConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("fuzzy", &self.fuzzy)?;
        nested("pca", &self.pca)?;
        nested("ransac", &self.ransac)
    }
}
