//! Fuzzy inference: from numbers over memberships and rules to one number between 0 and 1.
//!
//! ```text
//! strength of a rule  s = AND of its clauses' degrees      min or product; OR is max or a + b − ab
//! Mamdani             µ(y) = maxᵢ (sᵢ ∧ µᵢ(y)),  result = ∫ y µ(y) dy / ∫ µ(y) dy
//! Sugeno, order zero  result = Σ sᵢ yᵢ / Σ sᵢ,   yᵢ the peak of the output set
//! ```
//!
//! Mamdani and Assilian (1975); Takagi and Sugeno (1985). `∧` is min, or the product with the
//! product operators.

use serde::{Deserialize, Serialize};

use super::centroid::{Centroids, UNKNOWN};
use super::membership::{Membership, Operators};
use super::rules::{self, Names, Rule, RuleError, Vocabulary};

/// How the rules' strengths become a number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Inference {
    /// Clipped output sets, their union's centroid.
    #[default]
    Mamdani,
    /// Weighted mean of the output sets' peaks.
    Sugeno,
}

/// The most sets that all inputs together, or the output, may have.
const MAX_SETS: usize = 32;

/// A fuzzy system over named inputs with one output between 0 and 1.
#[derive(Clone, Debug)]
pub struct FuzzySystem {
    inputs: Vec<(String, Vec<String>)>,
    output: (String, Vec<String>),
    /// Input index and shape of every set, in the order in which clauses count them.
    sets: Vec<(usize, Membership)>,
    steps: Vec<Step>,
    operators: Operators,
    inference: Inference,
    pub(super) centroids: Centroids,
    peaks: Vec<f32>,
}

/// A clause of the rules, all of which stand in one list so that nothing is chased in memory.
#[derive(Clone, Copy, Debug)]
struct Step {
    set: usize,
    negated: bool,
    then: Then,
}

#[derive(Clone, Copy, Debug)]
enum Then {
    And,
    Or,
    Output(usize),
}

impl FuzzySystem {
    /// Looks up all names. Inputs are expected in the order of `input_names`; all variables of
    /// the vocabulary must be among them or be the output.
    pub fn new(
        vocabulary: &Vocabulary,
        rule_texts: &[String],
        input_names: &[&str],
        output_name: &str,
        operators: Operators,
        inference: Inference,
    ) -> Result<Self, RuleError> {
        check(vocabulary, input_names, output_name)?;
        let names_of = |name: &str| {
            let sets = vocabulary.get(name);
            sets.map_or_else(Vec::new, |sets| sets.keys().cloned().collect())
        };
        let inputs: Vec<(String, Vec<String>)> = input_names
            .iter()
            .map(|&name| (name.to_owned(), names_of(name)))
            .collect();
        let output = (output_name.to_owned(), names_of(output_name));
        let sets: Vec<(usize, Membership)> = input_names
            .iter()
            .enumerate()
            .filter_map(|(input, &name)| Some((input, vocabulary.get(name)?)))
            .flat_map(|(input, sets)| sets.values().map(move |&shape| (input, shape)))
            .collect();
        let outputs: Vec<Membership> = vocabulary[output_name].values().copied().collect();
        if sets.len() > MAX_SETS || outputs.len() > MAX_SETS {
            return Err(RuleError::TooManySets {
                found: sets.len(),
                outputs: outputs.len(),
                limit: MAX_SETS,
            });
        }
        let names = Names {
            inputs: &inputs,
            output: &output,
        };
        let rules = rule_texts
            .iter()
            .enumerate()
            .map(|(index, text)| rules::parse(text, index + 1, &names))
            .collect::<Result<Vec<_>, _>>()?;
        if rules.is_empty() {
            return Err(RuleError::NoRules);
        }
        Ok(Self {
            sets,
            steps: rules.iter().flat_map(steps_of).collect(),
            operators,
            inference,
            centroids: Centroids::new(&outputs, operators),
            peaks: outputs
                .iter()
                .map(Membership::peak_in_unit_interval)
                .collect(),
            inputs,
            output,
        })
    }

    /// The result for inputs in the order of the names, 0 to 1; 0.5 where no rule fires.
    pub fn infer(&self, inputs: &[f32]) -> f32 {
        let columns: Vec<[f32; 1]> = inputs.iter().map(|&input| [input]).collect();
        self.infer_block(&columns)[0]
    }

    /// The same for `N` times the inputs, `inputs[i]` holding those of name `i`. Loops run over
    /// the block inside, so that they are vectorized; nothing is allocated.
    #[inline]
    pub fn infer_block<const N: usize>(&self, inputs: &[[f32; N]]) -> [f32; N] {
        debug_assert_eq!(inputs.len(), self.inputs.len());
        let degrees = self.degrees(inputs);
        match self.inference {
            Inference::Mamdani => self.centers(&degrees),
            Inference::Sugeno => self.weighted_peaks(&degrees),
        }
    }

    #[inline]
    fn degrees<const N: usize>(&self, inputs: &[[f32; N]]) -> [[f32; N]; MAX_SETS] {
        let mut degrees = [[0.0; N]; MAX_SETS];
        for (degrees, (input, shape)) in degrees.iter_mut().zip(&self.sets) {
            shape.degrees(&inputs[*input], degrees);
        }
        degrees
    }

    /// Degrees of every input's sets: per input its name, and per set name and degree.
    pub fn memberships(&self, inputs: &[f32]) -> Vec<(String, Vec<(String, f32)>)> {
        let mut sets = self.sets.iter();
        self.inputs
            .iter()
            .map(|(name, set_names)| {
                let degrees = set_names
                    .iter()
                    .zip(sets.by_ref())
                    .map(|(set, (input, shape))| (set.clone(), shape.degree(inputs[*input])))
                    .collect();
                (name.clone(), degrees)
            })
            .collect()
    }

    /// How strongly each rule fires, with the name of its output set.
    pub fn strengths(&self, inputs: &[f32]) -> Vec<(f32, &str)> {
        let columns: Vec<[f32; 1]> = inputs.iter().map(|&input| [input]).collect();
        let mut strengths = Vec::new();
        self.fire(&self.degrees(&columns), |output, &[strength]| {
            strengths.push((strength, self.output.1[output].as_str()));
        });
        strengths
    }

    /// Calls `speak` with the output set and the strengths of every rule, in order.
    #[inline]
    fn fire<const N: usize>(
        &self,
        degrees: &[[f32; N]; MAX_SETS],
        mut speak: impl FnMut(usize, &[f32; N]),
    ) {
        let (mut any, mut all) = ([0.0_f32; N], [1.0_f32; N]);
        for step in &self.steps {
            let (offset, sign) = if step.negated {
                (1.0, -1.0)
            } else {
                (0.0, 1.0)
            };
            let degrees = &degrees[step.set % MAX_SETS];
            for (all, &degree) in all.iter_mut().zip(degrees) {
                let degree = offset + sign * degree;
                *all = match self.operators {
                    Operators::MinMax => smaller(*all, degree),
                    Operators::Product => *all * degree,
                };
            }
            if let Then::And = step.then {
                continue;
            }
            for (any, &all) in any.iter_mut().zip(&all) {
                *any = match self.operators {
                    Operators::MinMax => larger(*any, all),
                    Operators::Product => *any + all - *any * all,
                };
            }
            all = [1.0; N];
            if let Then::Output(output) = step.then {
                speak(output, &any);
                any = [0.0; N];
            }
        }
    }

    #[inline]
    fn weighted_peaks<const N: usize>(&self, degrees: &[[f32; N]; MAX_SETS]) -> [f32; N] {
        let (mut sums, mut weights) = ([0.0_f32; N], [0.0_f32; N]);
        self.fire(degrees, |output, strengths| {
            let peak = self.peaks[output];
            for ((sum, weight), &strength) in sums.iter_mut().zip(&mut weights).zip(strengths) {
                *sum += strength * peak;
                *weight += strength;
            }
        });
        let mean = |i: usize| sums[i] / weights[i];
        std::array::from_fn(|i| if weights[i] > 0.0 { mean(i) } else { UNKNOWN })
    }

    #[inline]
    fn centers<const N: usize>(&self, degrees: &[[f32; N]; MAX_SETS]) -> [f32; N] {
        let mut strongest = [[0.0_f32; N]; MAX_SETS];
        // Rules of one output set are joined by max before the set is clipped: the same as
        // after, because clipping and scaling are monotone.
        self.fire(degrees, |output, strengths| {
            let strongest = &mut strongest[output % MAX_SETS];
            for (strongest, &strength) in strongest.iter_mut().zip(strengths) {
                *strongest = larger(*strongest, strength);
            }
        });
        self.centroids.of(&strongest[..self.peaks.len()])
    }
}

/// The smaller of two numbers that are numbers: one instruction, unlike `f32::min`.
#[inline]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// The larger of two numbers that are numbers.
#[inline]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The clauses of a rule, each with what follows it.
fn steps_of(rule: &Rule) -> impl Iterator<Item = Step> {
    let groups = rule.condition.len();
    rule.condition
        .iter()
        .enumerate()
        .flat_map(move |(group, clauses)| {
            let count = clauses.len();
            clauses.iter().enumerate().map(move |(index, clause)| Step {
                set: clause.set,
                negated: clause.negated,
                then: match (index + 1 < count, group + 1 < groups) {
                    (true, _) => Then::And,
                    (false, true) => Then::Or,
                    (false, false) => Then::Output(rule.output),
                },
            })
        })
}

fn check(vocabulary: &Vocabulary, inputs: &[&str], output: &str) -> Result<(), RuleError> {
    for (variable, sets) in vocabulary {
        if variable != output && !inputs.contains(&variable.as_str()) {
            let known = inputs.iter().chain([&output]);
            let known: Vec<String> = known.map(|&name| name.to_owned()).collect();
            return Err(RuleError::UnknownFeature {
                name: variable.clone(),
                nearest: rules::nearest(variable, &known),
            });
        }
        for (set, membership) in sets {
            if !membership.is_valid() {
                return Err(RuleError::BadSet {
                    variable: variable.clone(),
                    set: set.clone(),
                    membership: *membership,
                });
            }
        }
    }
    if vocabulary.get(output).is_none_or(|sets| sets.is_empty()) {
        return Err(RuleError::NoOutput {
            name: output.to_owned(),
        });
    }
    Ok(())
}

#[cfg(test)]
#[path = "inference_tests.rs"]
mod tests;
