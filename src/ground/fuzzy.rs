//! Ground segmentation by fuzzy rules over the features of each point.
//!
//! Where nothing around stands up from the ground (low relief) every point is ground: road, kerb,
//! grass. Where something does, slope and curvature separate it from the ground at its foot.

use std::fmt;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::classifier::GroundClassifier;
use super::features::{FeatureConfig, Features, ScanFeatures};
use super::inference::{FuzzySystem, Inference};
use super::membership::{MembershipFunction, Operators};
use super::rules::Vocabulary;
use crate::validation::{InvalidValue, Validate, in_range, nested};

/// The output variable of the rules.
const OUTPUT: &str = "ground";

/// Features, linguistic variables and rule base of the fuzzy classifier.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct FuzzyConfig {
    /// Parameters of the features.
    pub features: FeatureConfig,
    /// Fuzzy operators for AND and OR.
    pub operators: Operators,
    /// Method of inference.
    pub inference: Inference,
    /// Fuzzy sets of the features `slope` [deg], `height_variance` [m], `curvature` [deg],
    /// `height` [m], `relief` [m], and of the output `ground` [0, 1].
    pub variables: Vocabulary,
    /// The rule base: `IF slope IS gentle AND curvature IS flat THEN ground IS high`.
    pub rules: Vec<String>,
    /// Confidence from which on a point is definitely ground, unitless.
    pub definitely: f32,
    /// Confidence from which on a point is probably ground, unitless.
    pub probably: f32,
}

impl Default for FuzzyConfig {
    /// All features; see [`TerrainConfig`](super::TerrainConfig) for how the values were chosen.
    fn default() -> Self {
        Self {
            features: FeatureConfig::default(),
            operators: Operators::MinMax,
            inference: Inference::Mamdani,
            variables: vocabulary(&[
                ("slope", "gentle", MembershipFunction::LeftShoulder([20.0, 40.0])),
                ("slope", "moderate", MembershipFunction::Triangle([20.0, 40.0, 100.0])),
                ("slope", "steep", MembershipFunction::RightShoulder([40.0, 100.0])),
                ("height_variance", "low", MembershipFunction::LeftShoulder([0.01, 0.11])),
                ("height_variance", "medium", MembershipFunction::Triangle([0.01, 0.11, 0.4])),
                ("height_variance", "high", MembershipFunction::RightShoulder([0.11, 0.4])),
                ("curvature", "flat", MembershipFunction::LeftShoulder([12.0, 55.0])),
                ("curvature", "curved", MembershipFunction::Triangle([12.0, 55.0, 65.0])),
                ("curvature", "sharp", MembershipFunction::RightShoulder([55.0, 65.0])),
                ("height", "sunken", MembershipFunction::LeftShoulder([-0.45, -0.15])),
                ("height", "level", MembershipFunction::Trapezoid([-0.45, -0.15, 0.03, 0.11])),
                ("height", "raised", MembershipFunction::RightShoulder([0.03, 0.11])),
                ("relief", "low", MembershipFunction::LeftShoulder([0.15, 0.3])),
                ("relief", "high", MembershipFunction::RightShoulder([0.15, 0.3])),
            ]),
            rules: [
                "IF relief IS low AND height IS NOT sunken THEN ground IS high",
                "IF height IS level AND slope IS gentle AND curvature IS NOT sharp THEN ground IS high",
                "IF height IS level AND slope IS moderate AND curvature IS flat THEN ground IS high",
                "IF relief IS high AND height IS level AND slope IS moderate AND curvature IS curved THEN ground IS medium",
                "IF height IS level AND slope IS steep AND height_variance IS low THEN ground IS high",
                "IF relief IS high AND height IS level AND slope IS steep AND height_variance IS NOT low THEN ground IS low",
                "IF relief IS high AND height IS level AND curvature IS sharp THEN ground IS low",
                "IF relief IS high AND height IS raised THEN ground IS low",
                "IF relief IS low AND height IS sunken AND slope IS gentle THEN ground IS high",
                "IF relief IS high AND height IS sunken THEN ground IS low",
                "IF height IS sunken AND slope IS NOT gentle THEN ground IS low",
            ]
            .map(str::to_owned)
            .to_vec(),
            definitely: 0.8,
            probably: 0.65,
        }
    }
}

impl Validate for FuzzyConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("features", &self.features)?;
        in_range("definitely", self.definitely, 0.5..=1.0)?;
        in_range("probably", self.probably, 0.5..=self.definitely)?;
        FuzzyGround::new(self.clone()).map(|_| ())
    }
}

impl FuzzyConfig {
    /// A rule base of three features, without height and relief.
    pub fn three_features() -> Self {
        Self {
            variables: vocabulary(&[
                ("slope", "gentle", MembershipFunction::LeftShoulder([3.0, 16.0])),
                ("slope", "moderate", MembershipFunction::Triangle([3.0, 16.0, 100.0])),
                ("slope", "steep", MembershipFunction::RightShoulder([16.0, 100.0])),
                ("height_variance", "low", MembershipFunction::LeftShoulder([0.08, 0.21])),
                ("height_variance", "medium", MembershipFunction::Triangle([0.08, 0.21, 0.9])),
                ("height_variance", "high", MembershipFunction::RightShoulder([0.21, 0.9])),
                ("curvature", "flat", MembershipFunction::LeftShoulder([25.0, 50.0])),
                ("curvature", "curved", MembershipFunction::Triangle([25.0, 50.0, 65.0])),
                ("curvature", "sharp", MembershipFunction::RightShoulder([50.0, 65.0])),
            ]),
            rules: [
                "IF slope IS gentle AND height_variance IS low AND curvature IS NOT sharp THEN ground IS high",
                "IF slope IS moderate AND height_variance IS low AND curvature IS flat THEN ground IS high",
                "IF slope IS moderate AND height_variance IS low AND curvature IS NOT flat THEN ground IS medium",
                "IF slope IS gentle AND height_variance IS medium AND curvature IS flat THEN ground IS high",
                "IF slope IS moderate AND height_variance IS medium THEN ground IS low",
                "IF curvature IS NOT flat AND height_variance IS medium THEN ground IS low",
                "IF curvature IS sharp THEN ground IS low",
                "IF slope IS steep THEN ground IS low",
                "IF height_variance IS high THEN ground IS low",
            ]
            .map(str::to_owned)
            .to_vec(),
            ..Self::default()
        }
    }

    /// The interval in which the sets of a variable differ, with a margin; for charts.
    pub(crate) fn chart_range(&self, variable: &str) -> (f32, f32) {
        let sets = self.variables.get(variable).into_iter().flatten();
        let (from, to) = sets
            .map(|(_, function)| function.span())
            .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
            .unwrap_or_default();
        let share = if variable == OUTPUT { 0.0 } else { 0.2 };
        let margin = share * (to - from);
        (from - margin, to + margin)
    }
}

/// The fuzzy ground classifier.
#[derive(Clone, Debug)]
pub struct FuzzyGround {
    config: FuzzyConfig,
    system: FuzzySystem,
}

/// The derivation of a point's confidence.
#[derive(Clone, Debug, PartialEq)]
pub struct Explanation {
    /// The inputs of the fuzzy system.
    pub features: Features,
    /// Set name and degree of membership of every set, per feature.
    pub memberships: Vec<Vec<(String, f32)>>,
    /// Firing strength, 0 to 1, and text of the rules that fired; by descending strength.
    pub fired: Vec<(f32, String)>,
    /// Confidence that the point is ground, 0 to 1.
    pub confidence: f32,
    /// The confidence in words.
    pub verdict: &'static str,
}

impl FuzzyGround {
    /// Parses the rule base of the configuration.
    ///
    /// # Errors
    /// A rule or a membership function cannot be used.
    pub fn new(config: FuzzyConfig) -> Result<Self, InvalidValue> {
        let system = FuzzySystem::new(
            &config.variables,
            &config.rules,
            &Features::NAMES,
            OUTPUT,
            config.operators,
            config.inference,
        )?;
        Ok(Self { config, system })
    }

    /// Computes the features of every point; `None` for points that are not finite, on the own car
    /// or out of range.
    pub fn features(&self, points: &[Vec3]) -> Vec<Option<Features>> {
        ScanFeatures::new(points, &self.config.features).features()
    }

    /// Infers the confidence, 0 to 1, that a point with these features is ground.
    pub fn confidence(&self, features: &Features) -> f32 {
        self.system.infer(&features.to_array())
    }

    /// Explains the confidence of a point with these features.
    pub fn explain(&self, features: &Features) -> Explanation {
        let inputs = features.to_array();
        let strengths = self.system.firing_strengths(&inputs).into_iter();
        let mut fired: Vec<(f32, String)> = strengths.zip(self.config.rules.clone()).collect();
        fired.retain(|(strength, _)| *strength > 0.0);
        fired.sort_by(|a, b| b.0.total_cmp(&a.0));
        let confidence = self.confidence(features);
        Explanation {
            features: *features,
            memberships: self.system.memberships(&inputs),
            fired,
            confidence,
            verdict: self.verdict(confidence),
        }
    }

    /// Expresses a confidence in words.
    pub(crate) fn verdict(&self, confidence: f32) -> &'static str {
        let (definitely, probably) = (self.config.definitely, self.config.probably);
        if confidence >= definitely {
            "definitely ground"
        } else if confidence >= probably {
            "probably ground"
        } else if confidence > 1.0 - probably {
            "uncertain"
        } else if confidence > 1.0 - definitely {
            "probably not ground"
        } else {
            "definitely not ground"
        }
    }
}

impl GroundClassifier for FuzzyGround {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        let features = ScanFeatures::new(points, &self.config.features);
        features.infer(&self.system)
    }
}

impl fmt::Display for Explanation {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let values = self.features.to_array().into_iter().zip(Features::UNITS);
        let rows = Features::NAMES.iter().zip(values).zip(&self.memberships);
        for ((name, (value, unit)), sets) in rows {
            write!(f, "{name:>16} {value:8.3} {unit:<4}")?;
            for (set, degree) in sets {
                write!(f, " {set} {degree:.2}")?;
            }
            writeln!(f)?;
        }
        for (strength, rule) in &self.fired {
            writeln!(f, "{strength:16.2} {rule}")?;
        }
        let (confidence, verdict) = (self.confidence, self.verdict);
        write!(f, "{OUTPUT:>16} {confidence:8.3}      {verdict}")
    }
}

/// Collects the sets of the features, and the sets low, medium and high of the output.
fn vocabulary(sets: &[(&str, &str, MembershipFunction)]) -> Vocabulary {
    let output = [
        (OUTPUT, "low", MembershipFunction::Triangle([0.0, 0.0, 0.4])),
        (
            OUTPUT,
            "medium",
            MembershipFunction::Triangle([0.2, 0.5, 0.8]),
        ),
        (
            OUTPUT,
            "high",
            MembershipFunction::Triangle([0.6, 1.0, 1.0]),
        ),
    ];
    let mut vocabulary = Vocabulary::new();
    for &(variable, set, function) in sets.iter().chain(&output) {
        let sets = vocabulary.entry(variable.to_owned()).or_default();
        sets.insert(set.to_owned(), function);
    }
    vocabulary
}
