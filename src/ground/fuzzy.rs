//! The fuzzy ground classifier: features of a point, rules in words, a confidence that can be
//! explained.

use std::fmt;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::classifier::GroundClassifier;
use super::features::{FeatureConfig, Features, Scene};
use super::inference::{FuzzySystem, Inference};
use super::membership::{Membership, Operators};
use super::rules::{RuleError, Vocabulary};
use crate::validation::{InvalidValue, Validate, in_range, nested};

/// Points that are judged together.
const BLOCK: usize = 32;
/// The output variable of the rules.
const OUTPUT: &str = "ground";

/// Features, sets, rules and words of the fuzzy classifier.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FuzzyConfig {
    /// How features are computed.
    pub features: FeatureConfig,
    /// How AND and OR are computed.
    pub operators: Operators,
    /// How rules become a confidence.
    pub inference: Inference,
    /// Linguistic sets of the features `slope` [deg], `height_variance` [m], `curvature` [deg],
    /// `height` [m], and of the output `ground` [0, 1].
    pub variables: Vocabulary,
    /// `IF slope IS gentle AND curvature IS flat THEN ground IS high`.
    pub rules: Vec<String>,
    /// A confidence this near to 0 or 1 is definite, unitless.
    pub definitely: f32,
    /// A confidence this near to 0 or 1 is probable; below, it is uncertain, unitless.
    pub probably: f32,
}

impl Default for FuzzyConfig {
    /// Four features; fixed on the even-numbered of 21 labelled scans and on simulated streets.
    fn default() -> Self {
        Self {
            features: FeatureConfig::default(),
            operators: Operators::MinMax,
            inference: Inference::Mamdani,
            variables: vocabulary(&[
                ("slope", "gentle", Membership::LeftShoulder([13.0, 23.0])),
                ("slope", "moderate", Membership::Triangle([13.0, 23.0, 100.0])),
                ("slope", "steep", Membership::RightShoulder([23.0, 100.0])),
                ("height_variance", "low", Membership::LeftShoulder([0.01, 0.11])),
                ("height_variance", "medium", Membership::Triangle([0.01, 0.11, 0.4])),
                ("height_variance", "high", Membership::RightShoulder([0.11, 0.4])),
                ("curvature", "flat", Membership::LeftShoulder([12.0, 55.0])),
                ("curvature", "curved", Membership::Triangle([12.0, 55.0, 65.0])),
                ("curvature", "sharp", Membership::RightShoulder([55.0, 65.0])),
                ("height", "sunken", Membership::LeftShoulder([-0.45, -0.15])),
                ("height", "level", Membership::Trapezoid([-0.45, -0.15, 0.03, 0.11])),
                ("height", "raised", Membership::Triangle([0.03, 0.11, 0.22])),
                ("height", "above", Membership::RightShoulder([0.11, 0.22])),
            ]),
            rules: [
                "IF height IS level AND slope IS gentle AND curvature IS NOT sharp THEN ground IS high",
                "IF height IS level AND slope IS moderate AND curvature IS flat THEN ground IS high",
                "IF height IS level AND slope IS moderate AND curvature IS curved THEN ground IS medium",
                "IF height IS level AND slope IS steep AND height_variance IS low THEN ground IS high",
                "IF height IS level AND slope IS steep AND height_variance IS NOT low THEN ground IS low",
                "IF height IS level AND curvature IS sharp THEN ground IS low",
                "IF height IS sunken AND slope IS gentle THEN ground IS high",
                "IF height IS sunken AND slope IS NOT gentle THEN ground IS low",
                "IF height IS raised AND slope IS gentle AND curvature IS flat AND height_variance IS NOT high THEN ground IS high",
                "IF height IS raised AND height_variance IS high THEN ground IS low",
                "IF height IS raised AND curvature IS NOT flat THEN ground IS low",
                "IF height IS raised AND slope IS NOT gentle THEN ground IS low",
                "IF height IS above THEN ground IS low",
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
        FuzzyGround::new(self.clone())?;
        Ok(())
    }
}

impl FuzzyConfig {
    /// The three features of the report, without the height over the local ground.
    pub fn three_features() -> Self {
        Self {
            variables: vocabulary(&[
                ("slope", "gentle", Membership::LeftShoulder([3.0, 16.0])),
                ("slope", "moderate", Membership::Triangle([3.0, 16.0, 100.0])),
                ("slope", "steep", Membership::RightShoulder([16.0, 100.0])),
                ("height_variance", "low", Membership::LeftShoulder([0.08, 0.21])),
                ("height_variance", "medium", Membership::Triangle([0.08, 0.21, 0.9])),
                ("height_variance", "high", Membership::RightShoulder([0.21, 0.9])),
                ("curvature", "flat", Membership::LeftShoulder([25.0, 50.0])),
                ("curvature", "curved", Membership::Triangle([25.0, 50.0, 65.0])),
                ("curvature", "sharp", Membership::RightShoulder([50.0, 65.0])),
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
}

/// The sets of the features, and low, medium and high of the output.
fn vocabulary(sets: &[(&str, &str, Membership)]) -> Vocabulary {
    let output = [
        (OUTPUT, "low", Membership::Triangle([0.0, 0.0, 0.4])),
        (OUTPUT, "medium", Membership::Triangle([0.2, 0.5, 0.8])),
        (OUTPUT, "high", Membership::Triangle([0.6, 1.0, 1.0])),
    ];
    let mut vocabulary = Vocabulary::new();
    for &(variable, set, membership) in sets.iter().chain(&output) {
        let sets = vocabulary.entry(variable.to_owned()).or_default();
        sets.insert(set.to_owned(), membership);
    }
    vocabulary
}

/// Classifies points by fuzzy rules.
#[derive(Clone, Debug)]
pub struct FuzzyGround {
    config: FuzzyConfig,
    system: FuzzySystem,
}

/// A confidence in a word.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "they are the words themselves")]
pub enum Verdict {
    DefinitelyGround,
    ProbablyGround,
    Uncertain,
    ProbablyNotGround,
    DefinitelyNotGround,
}

/// Why a point has its confidence.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Explanation {
    /// What was computed of the point.
    pub features: Features,
    /// Per feature the degrees of its sets.
    pub memberships: Vec<(String, Vec<(String, f32)>)>,
    /// The rules that fired, strongest first.
    pub fired: Vec<FiredRule>,
    /// Confidence that the point is ground, 0 to 1.
    pub confidence: f32,
    /// The same in a word.
    pub verdict: Verdict,
}

/// A rule and how strongly it fired.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FiredRule {
    /// As it is written in the configuration.
    pub rule: String,
    /// 0 to 1.
    pub strength: f32,
    /// The set of `ground` that it speaks for.
    pub consequence: String,
}

/// A membership function as points to draw.
#[derive(Clone, Debug, PartialEq)]
pub struct MembershipCurve {
    /// The variable.
    pub variable: String,
    /// Its linguistic set.
    pub set: String,
    /// Value and degree, by ascending value.
    pub points: Vec<(f32, f32)>,
}

impl FuzzyGround {
    /// Reads the rules of the configuration.
    pub fn new(config: FuzzyConfig) -> Result<Self, RuleError> {
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

    /// The features of every point; `None` for points that are not finite, under the car or too
    /// far away.
    pub fn features(&self, points: &[Vec3]) -> Vec<Option<Features>> {
        Scene::new(points, &self.config.features).features()
    }

    /// The confidence that a point with these features is ground, 0 to 1.
    #[inline]
    pub fn confidence(&self, features: &Features) -> f32 {
        self.system.infer(&features.to_array())
    }

    /// Why a point with these features has its confidence.
    pub fn explain(&self, features: &Features) -> Explanation {
        let inputs = features.to_array();
        let confidence = self.system.infer(&inputs);
        let strengths = self.system.strengths(&inputs);
        let mut fired: Vec<FiredRule> = strengths
            .into_iter()
            .zip(&self.config.rules)
            .filter(|((strength, _), _)| *strength > 0.0)
            .map(|((strength, consequence), rule)| FiredRule {
                rule: rule.clone(),
                strength,
                consequence: consequence.to_owned(),
            })
            .collect();
        fired.sort_by(|a, b| b.strength.total_cmp(&a.strength));
        Explanation {
            features: *features,
            memberships: self.system.memberships(&inputs),
            fired,
            confidence,
            verdict: self.verdict(confidence),
        }
    }

    /// A confidence in a word.
    pub fn verdict(&self, confidence: f32) -> Verdict {
        let (definitely, probably) = (self.config.definitely, self.config.probably);
        if confidence >= definitely {
            Verdict::DefinitelyGround
        } else if confidence >= probably {
            Verdict::ProbablyGround
        } else if confidence > 1.0 - probably {
            Verdict::Uncertain
        } else if confidence > 1.0 - definitely {
            Verdict::ProbablyNotGround
        } else {
            Verdict::DefinitelyNotGround
        }
    }

    /// All membership functions over the span of their variable, `samples` points each.
    pub fn membership_curves(&self, samples: usize) -> Vec<MembershipCurve> {
        let mut curves = Vec::new();
        for (variable, sets) in &self.config.variables {
            let spans = || sets.values().map(Membership::span);
            let from = spans().map(|(from, _)| from).fold(f32::INFINITY, f32::min);
            let to = spans().map(|(_, to)| to).fold(f32::NEG_INFINITY, f32::max);
            let margin = if variable == OUTPUT {
                0.0
            } else {
                0.2 * (to - from)
            };
            let (from, to) = (from - margin, to + margin);
            for (set, membership) in sets {
                let points = (0..samples).map(|sample| {
                    let share = sample as f32 / (samples.max(2) - 1) as f32;
                    let value = from + share * (to - from);
                    (value, membership.degree(value))
                });
                curves.push(MembershipCurve {
                    variable: variable.clone(),
                    set: set.clone(),
                    points: points.collect(),
                });
            }
        }
        curves
    }
}

impl GroundClassifier for FuzzyGround {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        let scene = Scene::new(points, &self.config.features);
        scene.judge::<BLOCK>(|features| self.system.infer_block(features))
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::DefinitelyGround => "definitely ground",
            Self::ProbablyGround => "probably ground",
            Self::Uncertain => "uncertain",
            Self::ProbablyNotGround => "probably not ground",
            Self::DefinitelyNotGround => "definitely not ground",
        })
    }
}

impl fmt::Display for Explanation {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let values = Features::NAMES.iter().zip(self.features.to_array());
        for ((name, value), unit) in values.zip(Features::UNITS) {
            write!(f, "{name:>16} {value:8.3} {unit:<4}")?;
            let sets = self
                .memberships
                .iter()
                .find(|(variable, _)| variable == name);
            for (set, degree) in sets.iter().flat_map(|(_, sets)| sets) {
                write!(f, " {set} {degree:.2}")?;
            }
            writeln!(f)?;
        }
        for rule in &self.fired {
            writeln!(f, "{:16.2} {}", rule.strength, rule.rule)?;
        }
        write!(
            f,
            "{:>16} {:8.3}      {}",
            OUTPUT, self.confidence, self.verdict
        )
    }
}
