//! YAML text of configurations, and the lines of its keys.

use std::ops::Range;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::braces::Lines;
use super::error::{self, ConfigError};
use super::keys::{DOT, Key, key_of, keys};
use super::names::{Meaning, Names};
use crate::validation::InvalidValue;

/// Serializes a configuration in block style, each key on a line of its own.
pub fn to_yaml<T: Serialize>(config: &T) -> Result<String, serde_yaml::SerializeError> {
    let options = serde_yaml::ser_options! { prefer_block_scalars: false };
    serde_yaml::to_string_with_options(config, options)
}

/// Reads a configuration; keys that are missing have their defaults.
pub(super) fn parse<T: DeserializeOwned>(text: &str) -> Result<T, serde_yaml::Error> {
    serde_yaml::from_str_with_options(text, serde_yaml::options! { with_snippet: false })
}

/// The names of the keys of a text.
pub(super) fn names(text: &str) -> Names {
    let names = keys(text).into_iter().map(|key| key.name);
    Names(names.filter(|name| !name.contains('[')).collect())
}

/// A text whose keys have their full names, and the lines of the original text.
#[derive(Debug, Default)]
pub(super) struct FullText {
    pub(super) text: String,
    /// For each line, its row in `original`, from 0.
    lines: Vec<usize>,
    /// The given text, with the blocks in braces as lines.
    original: Vec<String>,
    /// For each of these rows, the line in the given text, from 0.
    numbers: Vec<usize>,
}

impl FullText {
    /// Replaces the names of all keys by their full ones. A text that is no block of keys stays as it is.
    pub(super) fn new(name: &str, text: &str, names: &Names) -> Result<Self, ConfigError> {
        let text = text.trim_start_matches('\u{feff}');
        let mut rows = text.lines();
        let is_content = |row: &&str| row.trim_end() != "...";
        let given: Vec<&str> = rows.by_ref().take_while(is_content).collect();
        let has_second_document = rows.any(|row| !row.trim().is_empty());
        let mut full = Self {
            text: text.to_owned(),
            lines: (0..given.len()).collect(),
            original: given.iter().map(|&line| line.to_owned()).collect(),
            numbers: (0..given.len()).collect(),
        };
        // The parser reports what is no key.
        let has_tabs = |line: &&str| line[..line.len() - line.trim_start().len()].contains('\t');
        if has_second_document || given.iter().any(has_tabs) {
            return Ok(full);
        }
        let values = leaves(text);
        let without_braces = (values.is_some()).then(|| Lines::without_braces(&given, names));
        let rows = (without_braces.as_ref()).map_or(&full.original, |lines| &lines.texts);
        let found = keys(&rows.join("\n"));
        let first = found.first().map_or(rows.len(), |key| key.line);
        let is_code = |line: &String| !line.trim().is_empty() && !line.starts_with(['#', '-', '%']);
        if found.is_empty() || rows[..first].iter().any(is_code) {
            return Ok(full);
        }
        if let Some(lines) = without_braces {
            (full.original, full.numbers) = (lines.texts, lines.numbers);
        }
        let mut root = Node::default();
        // Keys without effect, and empty blocks.
        let mut ignored = 0;
        for (index, key) in found.iter().enumerate() {
            let is_inner =
                |it: &&Key| it.name.len() > key.name.len() && is_within(&it.name, &key.name);
            let later = &found[index + 1..];
            let mut inner = later.iter().take_while(is_inner);
            if key.name.contains('[') {
                continue;
            }
            if inner.any(|it| !it.name[key.name.len()..].starts_with('[')) {
                if let Meaning::Key(full) = names.meaning(&key.name) {
                    root.at(&full).header = Some(key.line);
                }
                continue;
            }
            let end = later.iter().find(|it| !is_inner(it));
            let end = end.map_or(full.original.len(), |next| next.line);
            let is_empty = full.value(key.line).is_empty() && end == key.line + 1;
            if is_empty && names.is_block(&key.name) {
                ignored += 1;
                continue;
            }
            let place = error::place(name, Some(full.number(key.line)));
            match names.meaning(&key.name) {
                Meaning::Key(full) => {
                    // A dot of a key within a map, whose keys are the user's, stays one.
                    let within = full.len() - names.known(&full).len();
                    let given = &key.given[key.given.len() - within..];
                    let name = format!("{}{given}", names.known(&full));
                    root.insert(&name, key.line..end, place)?;
                }
                Meaning::Nothing => ignored += 1,
                meaning => return Err(error::unknown(place, &key.name, meaning, names)),
            }
        }
        (full.text, full.lines) = (String::new(), Vec::new());
        root.write(0, &full.original, &mut full.text, &mut full.lines);
        // Nothing is lost in a style that this module does not know.
        if let (Some(given), Some(kept)) = (values, leaves(&full.text)) {
            let is_same = kept.iter().all(|value| given.contains(value));
            if !is_same || kept.len() + ignored != given.len() {
                let place = name.to_owned();
                return Err(ConfigError::Style { place });
            }
        }
        Ok(full)
    }

    /// The row of `original` of a line, from 0.
    fn original_row(&self, line: usize) -> usize {
        let last = self.lines.last().copied().unwrap_or(line);
        self.lines.get(line).copied().unwrap_or(last)
    }

    /// The line in the given text of a row of `original`, from 0.
    fn number(&self, row: usize) -> usize {
        self.numbers.get(row).copied().unwrap_or(row)
    }

    /// The value in a row of `original`, without its key and its comment.
    fn value(&self, line: usize) -> String {
        let line = self.original.get(line).map_or("", String::as_str);
        let content = line.trim_start();
        let value = key_of(content).map_or(content, |(_, value)| value);
        let value = value.split(" #").next().unwrap_or_default();
        value.trim().to_owned()
    }

    /// The error of the parser, with the key and the value of its line.
    pub(super) fn error(&self, name: &str, source: serde_yaml::Error) -> ConfigError {
        let Some(line) = source
            .location()
            .map(|location| (location.line() as usize).saturating_sub(1))
        else {
            return error::describe(name.to_owned(), None, source);
        };
        let key = keys(&self.text).into_iter().rfind(|key| key.line <= line);
        let row = self.original_row(line);
        let at_line = key.map(|key| (key.name, self.value(row)));
        error::describe(error::place(name, Some(self.number(row))), at_line, source)
    }

    /// The error of an invalid value, at the place where it was given last; settings are keys with their places.
    pub(super) fn invalid(
        &self,
        name: &str,
        settings: &[(String, String)],
        invalid: InvalidValue,
    ) -> ConfigError {
        let set = settings
            .iter()
            .rfind(|(key, _)| is_within(&invalid.key, key) || is_within(key, &invalid.key));
        let place = match set {
            Some((_, place)) => place.clone(),
            None => {
                let keys = keys(&self.text);
                let innermost = keys.iter().rfind(|key| is_within(&invalid.key, &key.name));
                let line = innermost.map(|key| self.number(self.original_row(key.line)));
                error::place(name, line)
            }
        };
        ConfigError::InvalidValue { place, invalid }
    }
}

/// The scalars of a text; `None` if it is no YAML.
fn leaves(text: &str) -> Option<Vec<String>> {
    fn collect(value: &serde_json::Value, leaves: &mut Vec<String>) {
        match value {
            serde_json::Value::Array(items) => items.iter().for_each(|it| collect(it, leaves)),
            serde_json::Value::Object(keys) => keys.values().for_each(|it| collect(it, leaves)),
            scalar => leaves.push(scalar.to_string()),
        }
    }
    let mut leaves = Vec::new();
    collect(&parse(text).ok()?, &mut leaves);
    Some(leaves)
}

/// A key with its lines in the original text, or a block of keys.
#[derive(Default)]
struct Node {
    name: String,
    lines: Range<usize>,
    /// The line on which a block begins, if it was given as one.
    header: Option<usize>,
    inner: Vec<Node>,
}

impl Node {
    /// The node with a name, which is made if there is none; else the value that is in its place.
    fn at(&mut self, name: &str) -> &mut Self {
        let mut node = self;
        for part in name.split('.') {
            if !node.lines.is_empty() {
                break;
            }
            let known = node.inner.iter().position(|it| it.name == part);
            let index = known.unwrap_or(node.inner.len());
            if known.is_none() {
                node.inner.push(Self {
                    name: part.to_owned(),
                    ..Self::default()
                });
            }
            node = &mut node.inner[index];
        }
        node
    }

    fn insert(
        &mut self,
        name: &str,
        lines: Range<usize>,
        place: String,
    ) -> Result<(), ConfigError> {
        let node = self.at(name);
        if !node.lines.is_empty() || !node.inner.is_empty() {
            let key = name.to_owned();
            return Err(ConfigError::DuplicateKey { place, key });
        }
        node.lines = lines;
        Ok(())
    }

    /// Writes what is within it with an indentation, and the original line of each line.
    fn write(
        &self,
        indentation: usize,
        original: &[String],
        text: &mut String,
        lines: &mut Vec<usize>,
    ) {
        let is_given = |node: &&Node| !node.lines.is_empty() || !node.inner.is_empty();
        for node in self.inner.iter().filter(is_given) {
            let start = &original[node.lines.start];
            let value = key_of(start.trim_start()).map_or("", |(_, value)| value);
            let value = if node.inner.is_empty() { value } else { "" };
            let name = node.name.replace(DOT, ".");
            *text += &format!("{:indentation$}{name}:{value}\n", "");
            lines.push(node.first_line());
            let old = start.len() - start.trim_start().len();
            for row in node.lines.clone().skip(1) {
                let line = &original[row];
                let kept = old.min(line.len() - line.trim_start().len());
                *text += &format!("{:indentation$}{}\n", "", &line[kept..]);
                lines.push(row);
            }
            node.write(indentation + 2, original, text, lines);
        }
    }

    fn first_line(&self) -> usize {
        let inner = self.inner.first();
        self.header
            .unwrap_or_else(|| inner.map_or(self.lines.start, Self::first_line))
    }
}

/// Replaces the value of a key in a text of [`to_yaml`]; `None` where the key does not exist.
pub(super) fn with_value(text: &str, key: &str, value: &str) -> Option<String> {
    let keys = keys(text);
    let is_item = key.contains('[');
    let index = keys.iter().position(|it| it.name == key && !is_item)?;
    let Key { line, depth, .. } = keys[index];
    let next = keys[index..].iter().find(|it| !is_within(&it.name, key));
    let lines: Vec<&str> = text.lines().collect();
    let end = next.map_or(lines.len(), |next| next.line);
    let name = key.rsplit('.').next()?;
    let replaced = format!("{}{name}: {value}", " ".repeat(depth / 2));
    Some(
        [&lines[..line], &[replaced.as_str()], &lines[end..]]
            .concat()
            .join("\n"),
    )
}

/// Whether a key is `block`, a key of that block or an item of that list.
pub(super) fn is_within(key: &str, block: &str) -> bool {
    let rest = key.strip_prefix(block);
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "\
# a comment: not a key
first: 1

block:
  inner: 2
  list:
  - name: a
    other: b
  - name: c
  deep:
    deepest: 3
last: 'x: y'
";

    fn line_of(key: &str) -> Option<usize> {
        let keys = keys(TEXT);
        Some(keys.iter().find(|it| it.name == key)?.line)
    }

    #[test]
    fn every_key_and_every_item_has_its_path() {
        let keys = keys(TEXT);
        let names: Vec<&str> = keys.iter().map(|key| key.name.as_str()).collect();
        assert_eq!(
            names,
            [
                "first",
                "block",
                "block.inner",
                "block.list",
                "block.list[1]",
                "block.list[1].other",
                "block.list[2]",
                "block.deep",
                "block.deep.deepest",
                "last"
            ]
        );
    }

    #[test]
    fn keys_and_items_have_their_lines() {
        assert_eq!(line_of("block.list"), Some(5));
        assert_eq!(line_of("block.list[1]"), Some(6));
        assert_eq!(line_of("block.list[2]"), Some(8));
        assert_eq!(line_of("inner"), None);
    }

    #[test]
    fn replacing_a_value_leaves_every_other_line() {
        let replaced = with_value(TEXT, "block.list", "[]").unwrap();
        let expected = TEXT.replace(
            "  list:\n  - name: a\n    other: b\n  - name: c\n",
            "  list: []\n",
        );
        assert_eq!(replaced.trim_end(), expected.trim_end());
        assert_eq!(with_value(TEXT, "inner", "3"), None);
    }
}
