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

use super::membership::Membership;
use super::rules::{self, Names, Rule, RuleError, Vocabulary};

/// How AND, OR and implication are computed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Operators {
    /// AND is the smaller degree, OR the larger.
    #[default]
    MinMax,
    /// AND is the product, OR the probabilistic sum.
    Product,
}

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
/// Intervals of the output's universe, 0 to 1, over which a centroid is integrated.
const INTERVALS: usize = 64;
/// Strengths along each axis of the table of centroids.
const NODES: usize = 33;
/// Below this greatest strength the centroid changes too fast for a table.
const MIN_TABLED: f32 = 0.1;
/// The result where no rule fires: nothing is known.
const UNKNOWN: f32 = 0.5;

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
    /// Degrees of the output sets over the universe.
    curves: Vec<[f32; INTERVALS + 1]>,
    peaks: Vec<f32>,
    /// The centroid by the strengths of three output sets, on a grid of `NODES`³; empty for
    /// another number of sets.
    centroids: Vec<f32>,
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
        let mut system = Self {
            sets,
            steps: rules.iter().flat_map(steps_of).collect(),
            operators,
            inference,
            centroids: Vec::new(),
            curves: outputs
                .iter()
                .map(|shape| std::array::from_fn(|i| shape.degree(i as f32 / INTERVALS as f32)))
                .collect(),
            peaks: outputs
                .iter()
                .map(Membership::peak_in_unit_interval)
                .collect(),
            inputs,
            output,
        };
        system.tabulate();
        Ok(system)
    }

    /// The result for inputs in the order of the names, 0 to 1; 0.5 where no rule fires.
    #[inline]
    pub fn infer(&self, inputs: &[f32]) -> f32 {
        debug_assert_eq!(inputs.len(), self.inputs.len());
        let mut degrees = [0.0; MAX_SETS];
        for (degree, (input, shape)) in degrees.iter_mut().zip(&self.sets) {
            *degree = shape.degree(inputs[*input]);
        }
        match self.inference {
            Inference::Mamdani => self.centroid(&degrees),
            Inference::Sugeno => self.weighted_peaks(&degrees),
        }
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
        let mut degrees = [0.0; MAX_SETS];
        for (degree, (input, shape)) in degrees.iter_mut().zip(&self.sets) {
            *degree = shape.degree(inputs[*input]);
        }
        let mut strengths = Vec::new();
        self.fire(&degrees, |output, strength| {
            strengths.push((strength, self.output.1[output].as_str()));
        });
        strengths
    }

    /// Calls `speak` with the output set and the strength of every rule, in order.
    #[inline]
    fn fire(&self, degrees: &[f32; MAX_SETS], mut speak: impl FnMut(usize, f32)) {
        let (mut any, mut all) = (0.0_f32, 1.0_f32);
        for step in &self.steps {
            let degree = degrees[step.set % MAX_SETS];
            let degree = if step.negated { 1.0 - degree } else { degree };
            all = match self.operators {
                Operators::MinMax => all.min(degree),
                Operators::Product => all * degree,
            };
            if let Then::And = step.then {
                continue;
            }
            any = match self.operators {
                Operators::MinMax => any.max(all),
                Operators::Product => any + all - any * all,
            };
            all = 1.0;
            if let Then::Output(output) = step.then {
                speak(output, any);
                any = 0.0;
            }
        }
    }

    #[inline]
    fn weighted_peaks(&self, degrees: &[f32; MAX_SETS]) -> f32 {
        let (mut sum, mut strengths) = (0.0, 0.0);
        self.fire(degrees, |output, strength| {
            sum += strength * self.peaks[output];
            strengths += strength;
        });
        if strengths > 0.0 {
            sum / strengths
        } else {
            UNKNOWN
        }
    }

    #[inline]
    fn centroid(&self, degrees: &[f32; MAX_SETS]) -> f32 {
        let mut strongest = [0.0_f32; MAX_SETS];
        // Rules of one output set are joined by max before the set is clipped: the same as
        // after, because clipping and scaling are monotone.
        self.fire(degrees, |output, strength| {
            let strongest = &mut strongest[output % MAX_SETS];
            *strongest = strongest.max(strength);
        });
        let [a, b, c, ..] = strongest;
        if self.centroids.is_empty() || a.max(b).max(c) < MIN_TABLED {
            self.integrate(&strongest)
        } else {
            self.look_up([a, b, c])
        }
    }

    /// The centroid of the union of the clipped output sets.
    fn integrate(&self, strengths: &[f32; MAX_SETS]) -> f32 {
        let mut union = [0.0_f32; INTERVALS + 1];
        for (curve, &strength) in self.curves.iter().zip(strengths) {
            for (joined, &degree) in union.iter_mut().zip(curve) {
                let implied = match self.operators {
                    Operators::MinMax => degree.min(strength),
                    Operators::Product => degree * strength,
                };
                *joined = joined.max(implied);
            }
        }
        center_of_area(&union)
    }

    /// Fills the table of centroids.
    fn tabulate(&mut self) {
        if self.curves.len() != 3 || self.inference != Inference::Mamdani {
            return;
        }
        let node = |index: usize| (index % NODES) as f32 / (NODES - 1) as f32;
        self.centroids = (0..NODES * NODES * NODES)
            .map(|index| {
                let mut strengths = [0.0; MAX_SETS];
                strengths[0] = node(index / (NODES * NODES));
                strengths[1] = node(index / NODES);
                strengths[2] = node(index);
                self.integrate(&strengths)
            })
            .collect();
    }

    /// The centroid between the eight nearest nodes of the table.
    #[inline]
    fn look_up(&self, strengths: [f32; 3]) -> f32 {
        let mut base = 0;
        let mut share = [0.0; 3];
        for (share, strength) in share.iter_mut().zip(strengths) {
            let position = strength * (NODES - 1) as f32;
            let node = (position as usize).min(NODES - 2);
            *share = position - node as f32;
            base = base * NODES + node;
        }
        let along = |base: usize| {
            let (low, high) = (self.centroids[base], self.centroids[base + 1]);
            low + share[2] * (high - low)
        };
        let across = |base: usize| {
            let (low, high) = (along(base), along(base + NODES));
            low + share[1] * (high - low)
        };
        let (low, high) = (across(base), across(base + NODES * NODES));
        low + share[0] * (high - low)
    }
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

/// The centroid of a curve that is straight between its samples over 0 to 1.
fn center_of_area(curve: &[f32; INTERVALS + 1]) -> f32 {
    let (mut area, mut moment) = (0.0, 0.0);
    for (interval, ends) in curve.windows(2).enumerate() {
        let (a, b) = (ends[0], ends[1]);
        area += 0.5 * (a + b);
        // ∫ t (a + (b − a) t) dt = a/2 + (b − a)/3 over the interval, from its left end.
        moment += interval as f32 * 0.5 * (a + b) + a / 6.0 + b / 3.0;
    }
    if area > 0.0 {
        moment / area / INTERVALS as f32
    } else {
        UNKNOWN
    }
}

fn check(vocabulary: &Vocabulary, inputs: &[&str], output: &str) -> Result<(), RuleError> {
    for (variable, sets) in vocabulary {
        if variable != output && !inputs.contains(&variable.as_str()) {
            let known: Vec<String> = inputs.iter().map(|&name| name.to_owned()).collect();
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
mod tests {
    use super::*;

    fn system(rules: &[&str], operators: Operators, inference: Inference) -> FuzzySystem {
        let rules: Vec<String> = rules.iter().map(|&rule| rule.to_owned()).collect();
        let sets = |names: [&str; 2]| {
            [
                (names[0].to_owned(), Membership::LeftShoulder([0.0, 1.0])),
                (names[1].to_owned(), Membership::RightShoulder([0.0, 1.0])),
            ]
            .into()
        };
        let vocabulary = [
            ("a".to_owned(), sets(["small", "large"])),
            ("b".to_owned(), sets(["small", "large"])),
            ("ground".to_owned(), sets(["low", "high"])),
        ]
        .into();
        FuzzySystem::new(
            &vocabulary,
            &rules,
            &["a", "b"],
            "ground",
            operators,
            inference,
        )
        .unwrap()
    }

    /// A line of the table: see scikit_fuzzy.py.
    fn from_table(line: &str) -> (FuzzySystem, [f32; 2], f32) {
        let words: Vec<&str> = line.split(' ').collect();
        let numbers =
            |text: &str| -> Vec<f32> { text.split(',').map(|x| x.parse().unwrap()).collect() };
        let shape = |word: &str| {
            let (kind, corners) = word.split_once(':').unwrap();
            match (kind, &numbers(corners)[..]) {
                ("trapezoid", &[a, b, c, d]) => Membership::Trapezoid([a, b, c, d]),
                ("triangle", &[a, b, c]) => Membership::Triangle([a, b, c]),
                ("gaussian", &[mean, sigma]) => Membership::Gaussian([mean, sigma]),
                other => panic!("{other:?}"),
            }
        };
        let sets = |first: usize| {
            (0..3)
                .map(|set| (format!("s{set}"), shape(words[first + set])))
                .collect()
        };
        let vocabulary = [
            ("a".to_owned(), sets(1)),
            ("b".to_owned(), sets(4)),
            ("out".to_owned(), sets(7)),
        ]
        .into();
        let rules: Vec<String> = words[10..14]
            .iter()
            .map(|rule| {
                let parts: Vec<&str> = rule.split(',').collect();
                let [a, b, out, joint] = parts[..] else {
                    panic!("{rule}")
                };
                format!("IF a IS s{a} {joint} b IS s{b} THEN out IS s{out}")
            })
            .collect();
        let operators = match words[0] {
            "product" => Operators::Product,
            _ => Operators::MinMax,
        };
        let system = FuzzySystem::new(
            &vocabulary,
            &rules,
            &["a", "b"],
            "out",
            operators,
            Inference::Mamdani,
        );
        let number = |index: usize| words[index].parse().unwrap();
        (system.unwrap(), [number(14), number(15)], number(16))
    }

    #[test]
    fn random_systems_infer_what_scikit_fuzzy_infers() {
        let table = include_str!("scikit_fuzzy.txt");
        assert!(table.lines().count() > 50);
        for line in table.lines() {
            let (system, inputs, expected) = from_table(line);
            let result = system.infer(&inputs);
            // The table integrates over 2000 intervals, this module over 64.
            assert!((result - expected).abs() < 2e-3, "{result} for {line}");
        }
    }

    const OPPOSITE: [&str; 2] = [
        "IF a IS small THEN ground IS low",
        "IF a IS large THEN ground IS high",
    ];

    #[test]
    fn the_table_of_centroids_agrees_with_the_integral() {
        let line = include_str!("scikit_fuzzy.txt").lines().next().unwrap();
        let (system, ..) = from_table(line);
        let mut worst: f32 = 0.0;
        for index in 0..1000 {
            let digit = |divisor: usize| (index / divisor % 10) as f32 / 9.0;
            let strengths = [digit(1), digit(10), digit(100)];
            if strengths.iter().any(|&strength| strength >= MIN_TABLED) {
                let mut all = [0.0; MAX_SETS];
                all[..3].copy_from_slice(&strengths);
                worst = worst.max((system.look_up(strengths) - system.integrate(&all)).abs());
            }
        }
        assert!(worst < 6e-3, "{worst}");
    }

    #[test]
    fn sugeno_inference_is_the_weighted_mean_of_the_peaks() {
        let system = system(&OPPOSITE, Operators::MinMax, Inference::Sugeno);
        for a in [0.0, 0.25, 0.5, 1.0] {
            assert!((system.infer(&[a, 0.3]) - a).abs() < 1e-6);
        }
    }

    #[test]
    fn swapping_every_set_for_its_opposite_mirrors_the_result() {
        for operators in [Operators::MinMax, Operators::Product] {
            let system = system(&OPPOSITE, operators, Inference::Mamdani);
            for a in [0.0, 0.1, 0.4, 0.9] {
                let sum = system.infer(&[a, 0.0]) + system.infer(&[1.0 - a, 0.0]);
                assert!((sum - 1.0).abs() < 1e-5, "{a}");
            }
        }
    }

    #[test]
    fn where_no_rule_fires_nothing_is_known() {
        for inference in [Inference::Mamdani, Inference::Sugeno] {
            let system = system(&OPPOSITE[1..], Operators::MinMax, inference);
            assert_eq!(system.infer(&[0.0, 0.0]), 0.5);
            assert_eq!(system.infer(&[f32::NAN, 0.0]), 0.5);
        }
    }

    #[test]
    fn or_and_and_differ_as_their_operators_say() {
        let strength = |joint: &str, operators| {
            let rule = format!("IF a IS large {joint} b IS NOT small THEN ground IS high");
            system(&[&rule], operators, Inference::Sugeno).strengths(&[0.4, 0.5])[0].0
        };
        assert_eq!(strength("AND", Operators::MinMax), 0.4);
        assert_eq!(strength("OR", Operators::MinMax), 0.5);
        assert_eq!(strength("AND", Operators::Product), 0.2);
        assert!((strength("OR", Operators::Product) - 0.7).abs() < 1e-6);
    }
}
