//! Fuzzy inference: from crisp inputs over memberships and rules to one number between 0 and 1.
//!
//! ```text
//! firing strength     s = AND of the clauses' degrees      min or product; OR is max or a + b − ab
//! Mamdani             µ(y) = maxᵢ (sᵢ ∧ µᵢ(y)),  result = ∫ y µ(y) dy / ∫ µ(y) dy
//! Sugeno, order zero  result = Σ sᵢ yᵢ / Σ sᵢ,   yᵢ the peak of the output set
//! ```
//!
//! Mamdani and Assilian (1975); Takagi and Sugeno (1985). `∧` is min, or the product with the
//! product operators.

use serde::{Deserialize, Serialize};

use super::defuzzification::{CentroidDefuzzifier, UNDECIDED};
use super::membership::{MembershipFunction, Operators};
use super::rules::{self, Clause, Then, Variable, Vocabulary};
use crate::validation::InvalidValue;

/// Method of inference and defuzzification.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Inference {
    /// Implied output sets, and the centroid of their union.
    #[default]
    Mamdani,
    /// Mean of the output sets' peaks, weighted by firing strength.
    Sugeno,
}

/// Maximum number of sets of all inputs together, and of the output.
const MAX_SETS: usize = 32;

/// A fuzzy inference system with named inputs and one output between 0 and 1.
#[derive(Clone, Debug)]
pub struct FuzzySystem {
    inputs: Vec<Variable>,
    /// Input index and membership function of every input set, in the order of [`Clause::set`].
    sets: Vec<(usize, MembershipFunction)>,
    /// Whether a rule contains the input set.
    is_used: Vec<bool>,
    /// The clauses of all rules in one list, for locality in memory.
    clauses: Vec<Clause>,
    operators: Operators,
    inference: Inference,
    pub(super) defuzzifier: CentroidDefuzzifier,
    /// Peaks of the output sets.
    peaks: Vec<f32>,
}

impl FuzzySystem {
    /// Parses the rules. Every variable of the vocabulary must be one of `input_names`, which
    /// define the order of the inputs, or `output_name`.
    pub fn new(
        vocabulary: &Vocabulary,
        rules: &[String],
        input_names: &[&str],
        output_name: &str,
        operators: Operators,
        inference: Inference,
    ) -> Result<Self, InvalidValue> {
        check(vocabulary, input_names, output_name)?;
        let variable = |name: &str| {
            let sets = vocabulary.get(name).into_iter().flatten();
            Variable {
                name: name.to_owned(),
                sets: sets
                    .map(|(set, &function)| (set.clone(), function))
                    .collect(),
            }
        };
        let inputs: Vec<Variable> = input_names.iter().map(|name| variable(name)).collect();
        let output = variable(output_name);
        let mut clauses = Vec::new();
        for (index, rule) in rules.iter().enumerate() {
            let parsed = rules::parse(rule, &inputs, &output).map_err(|error| {
                let key = format!("rules[{}]", index + 1);
                InvalidValue::new(&key, format_args!("`{rule}`"), error)
            })?;
            clauses.extend(parsed);
        }
        let functions = |variable: &Variable| -> Vec<MembershipFunction> {
            variable
                .sets
                .iter()
                .map(|&(_, function)| function)
                .collect()
        };
        let in_input = |(index, input)| functions(input).into_iter().map(move |f| (index, f));
        let sets: Vec<_> = inputs.iter().enumerate().flat_map(in_input).collect();
        let in_rule = |set| clauses.iter().any(|clause: &Clause| clause.set == set);
        let is_used = (0..sets.len()).map(in_rule).collect();
        let outputs = functions(&output);
        if sets.len() > MAX_SETS || outputs.len() > MAX_SETS {
            let (inputs, outputs) = (sets.len(), outputs.len());
            return Err(unusable_variables(format!(
                "{inputs} input sets and {outputs} output sets; at most {MAX_SETS} of each are possible"
            )));
        }
        if rules.is_empty() {
            let remedy = "rules: the list is empty; write at least one rule";
            return Err(InvalidValue::new("rules", "empty", remedy));
        }
        let peaks = outputs
            .iter()
            .map(MembershipFunction::peak_in_unit_interval);
        Ok(Self {
            inputs,
            sets,
            is_used,
            clauses,
            operators,
            inference,
            defuzzifier: CentroidDefuzzifier::new(&outputs, operators),
            peaks: peaks.collect(),
        })
    }

    /// Infers the output, 0 to 1, from one value per input; 0.5 where no rule fires.
    pub fn infer(&self, inputs: &[f32]) -> f32 {
        let [output] = self.infer_block(&columns(inputs));
        output
    }

    /// Infers `N` outputs from `inputs[input][column]`. The inner loops run over the block, so that
    /// they are vectorized; nothing is allocated.
    #[inline]
    pub fn infer_block<const N: usize>(&self, inputs: &[[f32; N]]) -> [f32; N] {
        debug_assert_eq!(inputs.len(), self.inputs.len());
        let degrees = self.fuzzify(inputs);
        match self.inference {
            Inference::Mamdani => self.infer_mamdani(&degrees),
            Inference::Sugeno => self.infer_sugeno(&degrees),
        }
    }

    /// Returns set name and degree of membership of every set, per input.
    pub fn memberships(&self, inputs: &[f32]) -> Vec<Vec<(String, f32)>> {
        let degrees = |(variable, &x): (&Variable, &f32)| {
            let sets = variable.sets.iter();
            sets.map(|(set, function)| (set.clone(), function.degree(x)))
                .collect()
        };
        self.inputs.iter().zip(inputs).map(degrees).collect()
    }

    /// Returns the firing strength of every rule.
    pub fn firing_strengths(&self, inputs: &[f32]) -> Vec<f32> {
        let mut strengths = Vec::new();
        self.fire(&self.fuzzify(&columns(inputs)), |_, &[strength]| {
            strengths.push(strength);
        });
        strengths
    }

    /// Returns the degrees of membership in the input sets that rules contain.
    #[inline]
    fn fuzzify<const N: usize>(&self, inputs: &[[f32; N]]) -> [[f32; N]; MAX_SETS] {
        let mut degrees = [[0.0; N]; MAX_SETS];
        let sets = self.sets.iter().zip(&self.is_used);
        for (degrees, ((input, function), is_used)) in degrees.iter_mut().zip(sets) {
            if *is_used {
                function.degrees(&inputs[*input], degrees);
            }
        }
        degrees
    }

    /// Calls `visit` with output set and firing strengths of every rule, in order.
    #[inline]
    fn fire<const N: usize>(
        &self,
        degrees: &[[f32; N]; MAX_SETS],
        mut visit: impl FnMut(usize, &[f32; N]),
    ) {
        let (mut any, mut all) = ([0.0_f32; N], [1.0_f32; N]);
        for clause in &self.clauses {
            let (offset, sign) = if clause.negated {
                (1.0, -1.0)
            } else {
                (0.0, 1.0)
            };
            let degrees = &degrees[clause.set % MAX_SETS];
            for (all, &degree) in all.iter_mut().zip(degrees) {
                let degree = offset + sign * degree;
                *all = match self.operators {
                    Operators::MinMax => min(*all, degree),
                    Operators::Product => *all * degree,
                };
            }
            if let Then::And = clause.then {
                continue;
            }
            for (any, &all) in any.iter_mut().zip(&all) {
                *any = match self.operators {
                    Operators::MinMax => max(*any, all),
                    Operators::Product => *any + all - *any * all,
                };
            }
            all = [1.0; N];
            if let Then::Consequent(output) = clause.then {
                visit(output, &any);
                any = [0.0; N];
            }
        }
    }

    #[inline]
    fn infer_sugeno<const N: usize>(&self, degrees: &[[f32; N]; MAX_SETS]) -> [f32; N] {
        let (mut sums, mut weights) = ([0.0_f32; N], [0.0_f32; N]);
        self.fire(degrees, |output, strengths| {
            let peak = self.peaks[output];
            for ((sum, weight), &strength) in sums.iter_mut().zip(&mut weights).zip(strengths) {
                *sum += strength * peak;
                *weight += strength;
            }
        });
        let mean = |i: usize| sums[i] / weights[i];
        std::array::from_fn(|i| if weights[i] > 0.0 { mean(i) } else { UNDECIDED })
    }

    #[inline]
    fn infer_mamdani<const N: usize>(&self, degrees: &[[f32; N]; MAX_SETS]) -> [f32; N] {
        let mut strongest = [[0.0_f32; N]; MAX_SETS];
        // Rules of one output set are joined by max before implication: the same as after, because
        // implication is monotone.
        self.fire(degrees, |output, strengths| {
            let strongest = &mut strongest[output % MAX_SETS];
            for (strongest, &strength) in strongest.iter_mut().zip(strengths) {
                *strongest = max(*strongest, strength);
            }
        });
        self.defuzzifier.defuzzify(&strongest[..self.peaks.len()])
    }
}

/// A block of one column.
fn columns(inputs: &[f32]) -> Vec<[f32; 1]> {
    inputs.iter().map(|&input| [input]).collect()
}

/// The smaller of two numbers, neither NaN: one instruction, unlike `f32::min`.
#[inline]
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// The larger of two numbers, neither NaN.
#[inline]
fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

fn check(vocabulary: &Vocabulary, inputs: &[&str], output: &str) -> Result<(), InvalidValue> {
    for (variable, sets) in vocabulary {
        if variable != output && !inputs.contains(&variable.as_str()) {
            let nearest = rules::nearest(variable, inputs.iter().copied().chain([output]));
            return Err(InvalidValue::new(
                &format!("variables.{variable}"),
                "no feature",
                format!("the nearest is `{nearest}`"),
            ));
        }
        if let Some((set, function)) = sets.iter().find(|(_, function)| !function.is_valid()) {
            let key = format!("variables.{variable}.{set}");
            return Err(InvalidValue::new(&key, function, function.requirement()));
        }
    }
    if vocabulary.get(output).is_none_or(|sets| sets.is_empty()) {
        return Err(unusable_variables(format!(
            "the output `{output}` is missing; add it with sets such as low, medium and high"
        )));
    }
    Ok(())
}

fn unusable_variables(reason: String) -> InvalidValue {
    InvalidValue::new("variables", "not usable", format!("variables: {reason}"))
}

#[cfg(test)]
#[path = "inference_tests.rs"]
mod tests;
