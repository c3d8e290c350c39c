//! Fuzzy rules in words: `IF slope IS gentle AND curvature IS NOT sharp THEN ground IS high`.
//!
//! ```text
//! rule      = IF condition THEN output IS set
//! condition = all { OR all }        all = clause { AND clause }
//! clause    = variable IS [NOT] set
//! ```
//!
//! Keywords are read in upper and lower case, names as they are written.

use std::collections::BTreeMap;

use super::membership::Membership;

use crate::validation::InvalidValue;

/// The linguistic sets of each variable.
pub type Vocabulary = BTreeMap<String, BTreeMap<String, Membership>>;

/// What is wrong with a rule base.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum RuleError {
    /// Rules are counted from 1.
    #[error("rule {number} `{rule}`: {fault}")]
    Rule {
        number: usize,
        rule: String,
        fault: RuleFault,
    },
    #[error("variables: `{name}` is no feature; the nearest is `{nearest}`")]
    UnknownFeature { name: String, nearest: String },
    #[error("variables: the output `{name}` is missing; give it sets such as low, medium and high")]
    NoOutput { name: String },
    #[error("variables: set `{set}` of `{variable}` is {membership}: {}", membership.law())]
    BadSet {
        variable: String,
        set: String,
        membership: Membership,
    },
    #[error(
        "variables: {found} input sets and {outputs} output sets; at most {limit} of each are possible"
    )]
    TooManySets {
        found: usize,
        outputs: usize,
        limit: usize,
    },
    #[error("rules: there are none; write at least one")]
    NoRules,
}

impl From<RuleError> for InvalidValue {
    /// Names the rule or the set by its own key, so that its line can be found.
    fn from(error: RuleError) -> Self {
        match &error {
            RuleError::Rule {
                number,
                rule,
                fault,
            } => Self::new(
                &format!("rules[{number}]"),
                format_args!("`{rule}`"),
                fault.to_string(),
            ),
            RuleError::BadSet {
                variable,
                set,
                membership,
            } => Self::new(
                &format!("variables.{variable}.{set}"),
                membership,
                membership.law(),
            ),
            RuleError::UnknownFeature { name, nearest } => Self::new(
                &format!("variables.{name}"),
                "no feature",
                format!("the nearest is `{nearest}`"),
            ),
            RuleError::NoRules => Self::new("rules", "empty", error.to_string()),
            RuleError::NoOutput { .. } | RuleError::TooManySets { .. } => {
                Self::new("variables", "not usable", error.to_string())
            }
        }
    }
}

/// What is wrong with a rule.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum RuleFault {
    #[error("`{found}` where {expected} belongs")]
    Grammar {
        found: String,
        expected: &'static str,
    },
    #[error("unknown variable `{name}`; the nearest is `{nearest}`")]
    UnknownVariable { name: String, nearest: String },
    #[error("`{variable}` has no set `{name}`; the nearest is `{nearest}`")]
    UnknownSet {
        variable: String,
        name: String,
        nearest: String,
    },
}

/// `variable IS set`, by position of the set among all sets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Clause {
    pub(super) set: usize,
    pub(super) negated: bool,
}

/// A rule whose names have been looked up.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Rule {
    /// Any of these, each of which wants all its clauses.
    pub(super) condition: Vec<Vec<Clause>>,
    /// Position of the output set.
    pub(super) output: usize,
}

/// Names of variables and their sets, in the order in which sets are counted.
pub(super) struct Names<'a> {
    pub(super) inputs: &'a [(String, Vec<String>)],
    pub(super) output: &'a (String, Vec<String>),
}

/// Reads a rule; `number` counts from 1, for messages.
pub(super) fn parse(text: &str, number: usize, names: &Names) -> Result<Rule, RuleError> {
    let reader = Reader {
        words: text.split_whitespace().peekable(),
        names,
    };
    reader.rule().map_err(|fault| RuleError::Rule {
        number,
        rule: text.to_owned(),
        fault,
    })
}

struct Reader<'a> {
    words: std::iter::Peekable<std::str::SplitWhitespace<'a>>,
    names: &'a Names<'a>,
}

impl<'a> Reader<'a> {
    fn rule(mut self) -> Result<Rule, RuleFault> {
        self.keyword("IF")?;
        let mut condition = vec![vec![self.clause()?]];
        loop {
            let word = self.next("AND, OR or THEN")?;
            if is(word, "AND") {
                let clause = self.clause()?;
                if let Some(all) = condition.last_mut() {
                    all.push(clause);
                }
            } else if is(word, "OR") {
                condition.push(vec![self.clause()?]);
            } else if is(word, "THEN") {
                break;
            } else {
                return Err(self.grammar(word, "AND, OR or THEN"));
            }
        }
        let output = self.consequence()?;
        match self.words.next() {
            None => Ok(Rule { condition, output }),
            Some(word) => Err(self.grammar(word, "the end of the rule")),
        }
    }

    fn next(&mut self, expected: &'static str) -> Result<&'a str, RuleFault> {
        match self.words.next() {
            Some(word) => Ok(word),
            None => Err(self.grammar("the end of the rule", expected)),
        }
    }

    fn keyword(&mut self, keyword: &'static str) -> Result<(), RuleFault> {
        let word = self.next(keyword)?;
        if is(word, keyword) {
            Ok(())
        } else {
            Err(self.grammar(word, keyword))
        }
    }

    fn clause(&mut self) -> Result<Clause, RuleFault> {
        let variable = self.next("a variable")?;
        self.keyword("IS")?;
        let negated = self.words.peek().is_some_and(|word| is(word, "NOT"));
        if negated {
            self.words.next();
        }
        let set = self.next("a set")?;
        let mut first_set = 0;
        for (name, sets) in self.names.inputs {
            if name == variable {
                let set = first_set + self.position(variable, set, sets)?;
                return Ok(Clause { set, negated });
            }
            first_set += sets.len();
        }
        Err(self.unknown_variable(variable, self.names.inputs.iter().map(|(name, _)| name)))
    }

    fn consequence(&mut self) -> Result<usize, RuleFault> {
        let variable = self.next("the output")?;
        let (name, sets) = self.names.output;
        if name != variable {
            return Err(self.unknown_variable(variable, [name]));
        }
        self.keyword("IS")?;
        let set = self.next("a set")?;
        self.position(variable, set, sets)
    }

    fn position(&self, variable: &str, set: &str, sets: &[String]) -> Result<usize, RuleFault> {
        sets.iter()
            .position(|name| name == set)
            .ok_or_else(|| RuleFault::UnknownSet {
                variable: variable.to_owned(),
                name: set.to_owned(),
                nearest: nearest(set, sets),
            })
    }

    fn unknown_variable<'n>(
        &self,
        name: &str,
        known: impl IntoIterator<Item = &'n String>,
    ) -> RuleFault {
        RuleFault::UnknownVariable {
            name: name.to_owned(),
            nearest: nearest(name, known),
        }
    }

    fn grammar(&self, found: &str, expected: &'static str) -> RuleFault {
        RuleFault::Grammar {
            found: found.to_owned(),
            expected,
        }
    }
}

fn is(word: &str, keyword: &str) -> bool {
    word.eq_ignore_ascii_case(keyword)
}

/// The known name that `name` was most likely meant to be.
pub(super) fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a String>) -> String {
    known
        .into_iter()
        .min_by_key(|other| strsim::damerau_levenshtein(name, other))
        .cloned()
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse_one(text: &str) -> Result<Rule, RuleError> {
        let list = |sets: &[&str]| sets.iter().map(|&set| set.to_owned()).collect();
        parse(
            text,
            3,
            &Names {
                inputs: &[
                    ("curvature".to_owned(), list(&["curved", "flat"])),
                    ("slope".to_owned(), list(&["gentle", "steep"])),
                ],
                output: &("ground".to_owned(), list(&["high", "low"])),
            },
        )
    }

    #[test]
    fn and_binds_tighter_than_or_and_case_does_not_matter() {
        let rule = parse_one(
            "if slope is gentle and curvature is NOT curved OR curvature IS flat then ground IS low",
        );
        let clause = |set, negated| Clause { set, negated };
        let expected = Rule {
            condition: vec![
                vec![clause(2, false), clause(0, true)],
                vec![clause(1, false)],
            ],
            output: 1,
        };
        assert_eq!(rule, Ok(expected));
    }

    #[test]
    fn a_mistyped_name_is_quoted_with_its_rule_and_the_nearest_known() {
        let message = |text| parse_one(text).unwrap_err().to_string();
        let variable = message("IF slop IS gentle THEN ground IS low");
        assert_eq!(
            variable,
            "rule 3 `IF slop IS gentle THEN ground IS low`: unknown variable `slop`; the nearest is `slope`"
        );
        let set = message("IF slope IS gentel THEN ground IS low");
        assert!(
            set.contains("`slope` has no set `gentel`; the nearest is `gentle`"),
            "{set}"
        );
        let output = message("IF slope IS gentle THEN grund IS low");
        assert!(
            output.contains("`grund`; the nearest is `ground`"),
            "{output}"
        );
    }

    #[test]
    fn a_rule_that_is_no_sentence_is_told_where_it_breaks() {
        for (text, found, expected) in [
            ("slope IS gentle THEN ground IS low", "`slope`", "IF"),
            ("IF slope gentle THEN ground IS low", "`gentle`", "IS"),
            ("IF slope IS gentle ground IS low", "`ground`", "THEN"),
            (
                "IF slope IS gentle THEN ground IS",
                "`the end of the rule`",
                "a set",
            ),
            (
                "IF slope IS gentle THEN ground IS low now",
                "`now`",
                "the end",
            ),
            ("", "`the end of the rule`", "IF"),
        ] {
            let message = parse_one(text).unwrap_err().to_string();
            assert!(
                message.contains(found) && message.contains(expected),
                "{message}"
            );
        }
    }
}
