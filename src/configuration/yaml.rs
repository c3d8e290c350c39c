//! YAML text of configurations, and the lines of its keys.

use std::ops::Range;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::error::{self, ConfigError};
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

/// A key of a YAML text in block style, or an item of a list.
pub(super) struct Key {
    /// Dotted (`range_image.width`); an item has its number, from 1 (`fuzzy.rules[2]`).
    pub(super) name: String,
    /// The line that it starts on, from 0.
    pub(super) line: usize,
    /// Twice the indentation, and one more for an item, which may stand below its list unindented.
    depth: usize,
    items: usize,
}

/// Lists the keys and the items of a text in order; what is in braces is part of a value.
pub(super) fn keys(text: &str) -> Vec<Key> {
    let mut keys: Vec<Key> = Vec::new();
    let mut open: Vec<usize> = Vec::new();
    for (line, text) in text.lines().enumerate() {
        let content = text.trim_start();
        let is_item = content == "-" || content.starts_with("- ");
        let name = key_of(content);
        if !is_item && name.is_none() {
            continue;
        }
        let depth = 2 * (text.len() - content.len()) + usize::from(is_item);
        open.retain(|&parent| keys[parent].depth < depth);
        let parent = open.last().map(|&parent| &mut keys[parent]);
        let name = match (name, parent) {
            (Some(name), None) => name.to_owned(),
            (Some(name), Some(parent)) => format!("{}.{name}", parent.name),
            (None, Some(list)) => {
                list.items += 1;
                format!("{}[{}]", list.name, list.items)
            }
            (None, None) => continue,
        };
        open.push(keys.len());
        keys.push(Key {
            name,
            line,
            depth,
            items: 0,
        });
    }
    keys
}

/// A text whose keys have their full names, and the lines of the original text.
#[derive(Debug, Default)]
pub(super) struct FullText {
    pub(super) text: String,
    /// For each line, that of the original, from 0.
    lines: Vec<usize>,
    original: Vec<String>,
}

impl FullText {
    /// Replaces the names of all keys by their full ones. A text without keys in block style stays as it is.
    pub(super) fn new(name: &str, text: &str, names: &Names) -> Result<Self, ConfigError> {
        let original: Vec<String> = text.lines().map(str::to_owned).collect();
        let found = keys(text);
        let first = found.first().map_or(original.len(), |key| key.line);
        let is_code =
            |line: &&String| !line.trim().is_empty() && !line.starts_with(['#', '-', '%']);
        let mut full = Self {
            text: text.to_owned(),
            lines: (0..original.len()).collect(),
            original,
        };
        if found.is_empty() || full.original[..first].iter().any(|line| is_code(&line)) {
            return Ok(full);
        }
        let mut root = Node::default();
        for (index, key) in found.iter().enumerate() {
            let is_inner =
                |it: &&Key| it.name.len() > key.name.len() && is_within(&it.name, &key.name);
            let later = &found[index + 1..];
            let mut inner = later.iter().take_while(is_inner);
            if key.name.contains('[') || inner.any(|it| !it.name[key.name.len()..].starts_with('['))
            {
                continue;
            }
            let end = later.iter().find(|it| !is_inner(it));
            let end = end.map_or(full.original.len(), |next| next.line);
            let place = error::place(name, Some(key.line));
            match names.meaning(&key.name) {
                Meaning::Key(name) => root.insert(&name, key.line..end, place)?,
                Meaning::Nothing => (),
                meaning => return Err(error::unknown(place, &key.name, meaning, names)),
            }
        }
        (full.text, full.lines) = (String::new(), Vec::new());
        root.write(0, &full.original, &mut full.text, &mut full.lines);
        Ok(full)
    }

    /// The line of the original text, from 0.
    pub(super) fn original_line(&self, line: usize) -> usize {
        let last = self.lines.last().copied().unwrap_or(line);
        self.lines.get(line).copied().unwrap_or(last)
    }

    /// The value on a line of the original text, without its key and its comment.
    pub(super) fn value(&self, line: usize) -> String {
        let line = self.original.get(line).map_or("", String::as_str);
        let value = line.split_once(':').map_or(line, |(_, value)| value);
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
        let line = self.original_line(line);
        let at_line = key.map(|key| (key.name, self.value(line)));
        error::describe(error::place(name, Some(line)), at_line, source)
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
                error::place(name, innermost.map(|key| self.original_line(key.line)))
            }
        };
        ConfigError::InvalidValue { place, invalid }
    }
}

/// A key with its lines in the original text, or a block of keys.
#[derive(Default)]
struct Node {
    name: String,
    lines: Range<usize>,
    inner: Vec<Node>,
}

impl Node {
    fn insert(
        &mut self,
        name: &str,
        lines: Range<usize>,
        place: String,
    ) -> Result<(), ConfigError> {
        let mut node = self;
        for part in name.split('.') {
            let known = node.inner.iter().position(|it| it.name == part);
            let index = known.unwrap_or(node.inner.len());
            if known.is_none() {
                node.inner.push(Self {
                    name: part.to_owned(),
                    ..Self::default()
                });
            }
            node = &mut node.inner[index];
            // A value where a block is wanted, or the other way round.
            if !node.lines.is_empty() {
                break;
            }
        }
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
        for node in &self.inner {
            let start = &original[node.lines.start];
            let value = start.split_once(':').map_or("", |(_, value)| value);
            let value = if node.inner.is_empty() { value } else { "" };
            *text += &format!("{:indentation$}{}:{value}\n", "", node.name);
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
        self.inner
            .first()
            .map_or(self.lines.start, Self::first_line)
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

/// The key that a line without its indentation starts with.
fn key_of(content: &str) -> Option<&str> {
    let (name, rest) = content.split_once(':')?;
    let is_name = |c: char| c.is_alphanumeric() || c == '_' || c == '-';
    let is_key = !name.is_empty() && name.chars().all(is_name);
    (is_key && (rest.is_empty() || rest.starts_with(' '))).then_some(name)
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
