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
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
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
    #[inline(always)]
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
    #[inline(always)]
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
    #[inline(always)]
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
            combine(&mut all, degrees, |all, degree| {
                let degree = offset + sign * degree;
                match self.operators {
                    Operators::MinMax => all.min(degree),
                    Operators::Product => all * degree,
                }
            });
            if let Then::And = clause.then {
                continue;
            }
            combine(&mut any, &all, |any, all| match self.operators {
                Operators::MinMax => any.max(all),
                Operators::Product => any + all - any * all,
            });
            all = [1.0; N];
            if let Then::Consequent(output) = clause.then {
                visit(output, &any);
                any = [0.0; N];
            }
        }
    }

    #[inline(always)]
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

    #[inline(always)]
    fn infer_mamdani<const N: usize>(&self, degrees: &[[f32; N]; MAX_SETS]) -> [f32; N] {
        let mut strongest = [[0.0_f32; N]; MAX_SETS];
        // Rules of one output set are joined by max before implication: the same as after, because
        // implication is monotone.
        self.fire(degrees, |output, strengths| {
            let strongest = &mut strongest[output % MAX_SETS];
            combine(strongest, strengths, f32::max);
        });
        self.defuzzifier.defuzzify(&strongest[..self.peaks.len()])
    }
}

/// A block of one column.
fn columns(inputs: &[f32]) -> Vec<[f32; 1]> {
    inputs.iter().map(|&input| [input]).collect()
}

/// Combines each number of `a` with that of `b`. With the minima and maxima of the standard library
/// all are stored; a comparison stores only some, which the next load would have to wait for.
#[inline(always)]
fn combine<const N: usize>(a: &mut [f32; N], b: &[f32; N], f: impl Fn(f32, f32) -> f32) {
    for (a, &b) in a.iter_mut().zip(b) {
        *a = f(*a, b);
    }
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
