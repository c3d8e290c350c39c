//! The rule base in words: `IF slope IS gentle AND curvature IS NOT sharp THEN ground IS high`.
//!
//! ```text
//! rule       = IF antecedent THEN output IS set
//! antecedent = conjunction { OR conjunction }     conjunction = clause { AND clause }
//! clause     = variable IS [NOT] set
//! ```
//!
//! Keywords are case-insensitive, names are not.

use std::collections::BTreeMap;
use std::iter::Peekable;
use std::str::SplitWhitespace;

use super::membership::MembershipFunction;

/// The fuzzy sets of each linguistic variable.
pub type Vocabulary = BTreeMap<String, BTreeMap<String, MembershipFunction>>;

/// A linguistic variable with its fuzzy sets.
#[derive(Clone, Debug)]
pub(super) struct Variable {
    pub(super) name: String,
    pub(super) sets: Vec<(String, MembershipFunction)>,
}

impl Variable {
    fn set_index(&self, set: &str) -> Result<usize, String> {
        let names = || self.sets.iter().map(|(name, _)| name.as_str());
        names().position(|name| name == set).ok_or_else(|| {
            let (variable, nearest) = (&self.name, nearest(set, names()));
            format!("`{variable}` has no set `{set}`; the nearest is `{nearest}`")
        })
    }
}

/// A clause of an antecedent, and how it is joined to what follows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Clause {
    /// Index of the set among the sets of all inputs.
    pub(super) set: usize,
    pub(super) negated: bool,
    pub(super) then: Then,
}

/// What follows a clause.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Then {
    /// Another clause of the same conjunction.
    And,
    /// The next conjunction.
    Or,
    /// The consequent: the index of its output set.
    Consequent(usize),
}

/// Parses a rule into its clauses; the error is a sentence.
pub(super) fn parse(
    rule: &str,
    inputs: &[Variable],
    output: &Variable,
) -> Result<Vec<Clause>, String> {
    let words = rule.split_whitespace().peekable();
    Parser {
        words,
        inputs,
        output,
    }
    .rule()
}

/// Returns the known name that is most similar to `name`.
pub(super) fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    let distance = |other: &&str| strsim::damerau_levenshtein(name, other);
    let nearest = known.into_iter().min_by_key(distance);
    nearest.unwrap_or_default().to_owned()
}

/// The name of the end of a rule in messages.
const END: &str = "the end of the rule";

struct Parser<'a> {
    words: Peekable<SplitWhitespace<'a>>,
    inputs: &'a [Variable],
    output: &'a Variable,
}

impl<'a> Parser<'a> {
    fn rule(mut self) -> Result<Vec<Clause>, String> {
        self.keyword("IF")?;
        let mut clauses = Vec::new();
        loop {
            let (set, negated) = self.antecedent_clause()?;
            let joint = self.word("AND, OR or THEN")?;
            let then = match joint.to_ascii_uppercase().as_str() {
                "AND" => Then::And,
                "OR" => Then::Or,
                "THEN" => Then::Consequent(self.consequent()?),
                _ => return Err(syntax_error(joint, "AND, OR or THEN")),
            };
            clauses.push(Clause { set, negated, then });
            if matches!(then, Then::Consequent(_)) {
                break;
            }
        }
        match self.words.next() {
            None => Ok(clauses),
            Some(word) => Err(syntax_error(word, END)),
        }
    }

    fn word(&mut self, expected: &'static str) -> Result<&'a str, String> {
        let word = self.words.next();
        word.ok_or_else(|| syntax_error(END, expected))
    }

    fn keyword(&mut self, keyword: &'static str) -> Result<(), String> {
        let word = self.word(keyword)?;
        if word.eq_ignore_ascii_case(keyword) {
            Ok(())
        } else {
            Err(syntax_error(word, keyword))
        }
    }

    /// The index of the set among all input sets, and whether it is negated.
    fn antecedent_clause(&mut self) -> Result<(usize, bool), String> {
        let variable = self.word("a variable")?;
        self.keyword("IS")?;
        let negation = self.words.next_if(|word| word.eq_ignore_ascii_case("NOT"));
        let set = self.word("a set")?;
        let mut first_set = 0;
        for input in self.inputs {
            if input.name == variable {
                return Ok((first_set + input.set_index(set)?, negation.is_some()));
            }
            first_set += input.sets.len();
        }
        Err(unknown_variable(variable, self.inputs))
    }

    /// The index of the output set.
    fn consequent(&mut self) -> Result<usize, String> {
        let variable = self.word("the output")?;
        if self.output.name != variable {
            return Err(unknown_variable(variable, [self.output]));
        }
        self.keyword("IS")?;
        let set = self.word("a set")?;
        self.output.set_index(set)
    }
}

fn unknown_variable<'a>(name: &str, known: impl IntoIterator<Item = &'a Variable>) -> String {
    let nearest = nearest(
        name,
        known.into_iter().map(|variable| variable.name.as_str()),
    );
    format!("unknown variable `{name}`; the nearest is `{nearest}`")
}

fn syntax_error(found: &str, expected: &str) -> String {
    format!("expected {expected}, found `{found}`")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variable(name: &str, sets: [&str; 2]) -> Variable {
        let set = |name: &str| {
            (
                name.to_owned(),
                MembershipFunction::LeftShoulder([0.0, 1.0]),
            )
        };
        Variable {
            name: name.to_owned(),
            sets: sets.map(set).to_vec(),
        }
    }

    fn parse_one(text: &str) -> Result<Vec<Clause>, String> {
        let inputs = [
            variable("curvature", ["curved", "flat"]),
            variable("slope", ["gentle", "steep"]),
        ];
        parse(text, &inputs, &variable("ground", ["high", "low"]))
    }

    #[test]
    fn clauses_are_parsed_in_order_and_the_case_of_keywords_does_not_matter() {
        let clauses = parse_one(
            "if slope is gentle and curvature is NOT curved OR curvature IS flat then ground IS low",
        );
        let clause = |set, negated, then| Clause { set, negated, then };
        let expected = vec![
            clause(2, false, Then::And),
            clause(0, true, Then::Or),
            clause(1, false, Then::Consequent(1)),
        ];
        assert_eq!(clauses, Ok(expected));
    }

    #[test]
    fn an_unknown_name_is_reported_with_the_nearest_known_name() {
        let message = |text| parse_one(text).unwrap_err();
        let variable = message("IF slop IS gentle THEN ground IS low");
        assert_eq!(variable, "unknown variable `slop`; the nearest is `slope`");
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
    fn a_syntax_error_names_what_was_found_and_what_was_expected() {
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
            let message = parse_one(text).unwrap_err();
            assert!(
                message.contains(found) && message.contains(expected),
                "{message}"
            );
        }
    }
}
