//! A configuration with its documentation: every key with its default, below the docs of its field.

use schemars::schema_for;
use serde_json::Value;

use super::keys::keys;
use super::yaml::to_yaml;
use super::{ConfigError, Configuration};

/// Longest list of values in brackets [bytes].
const LONGEST_LIST: usize = 80;

/// Returns the defaults of a configuration as YAML, with the docs of its fields as comments.
pub fn commented<T: Configuration>() -> Result<String, ConfigError> {
    let schema = schema_for!(T);
    let text = with_short_lists(&to_yaml(&T::default())?);
    let lines: Vec<&str> = text.lines().collect();
    let keys = keys(&text);
    let mut commented = String::new();
    for (row, line) in lines.iter().enumerate() {
        let indentation = &line[..line.len() - line.trim_start().len()];
        let key = keys.iter().find(|key| key.line == row);
        let docs = key.and_then(|key| description(schema.as_value(), &key.name));
        for paragraph in docs.iter().flat_map(|docs| docs.lines()) {
            commented += &format!("{indentation}# {paragraph}\n");
        }
        commented += line;
        commented.push('\n');
    }
    Ok(commented)
}

/// The docs of a key in a schema, with the words that it may be.
fn description(schema: &Value, key: &str) -> Option<String> {
    let mut field = schema;
    for part in key.split('.') {
        field = &properties(schema, field)?[part];
    }
    let docs = field.get("description")?.as_str()?;
    let mut docs = without_links(docs).replace("`None`", "null");
    let words = words(schema, field);
    if !words.is_empty() {
        docs += &format!("\nOne of {}.", words.join(", "));
    }
    Some(docs)
}

/// Links of docs as their text: a bracketed name, with or without a target.
fn without_links(docs: &str) -> String {
    let mut text = String::new();
    let mut rest = docs;
    while let Some((before, link)) = rest.split_once("[`") {
        let (name, after) = link.split_once("`]").unwrap_or((link, ""));
        text += &format!("{before}`{name}`");
        rest = match after.strip_prefix('(') {
            Some(target) => target.split_once(')').map_or("", |(_, after)| after),
            None => after,
        };
    }
    text + rest
}

/// The words that a field may be, where it is a choice.
fn words<'a>(schema: &'a Value, field: &'a Value) -> Vec<&'a str> {
    if let Some(path) = field.get("$ref").and_then(Value::as_str) {
        let target = path.strip_prefix('#').and_then(|path| schema.pointer(path));
        return target.map_or_else(Vec::new, |target| words(schema, target));
    }
    let of = |key: &str| {
        field
            .get(key)
            .and_then(Value::as_array)
            .into_iter()
            .flatten()
    };
    let nested = of("anyOf")
        .chain(of("oneOf"))
        .flat_map(|it| words(schema, it));
    let constant = field.get("const").and_then(Value::as_str);
    let listed = of("enum").filter_map(Value::as_str);
    constant.into_iter().chain(listed).chain(nested).collect()
}

/// The fields of a block, which may be optional or defined elsewhere in the schema.
fn properties<'a>(schema: &'a Value, block: &'a Value) -> Option<&'a Value> {
    if let Some(path) = block.get("$ref").and_then(Value::as_str) {
        return properties(schema, schema.pointer(path.strip_prefix('#')?)?);
    }
    if let Some(choices) = block.get("anyOf").and_then(Value::as_array) {
        return choices.iter().find_map(|it| properties(schema, it));
    }
    block.get("properties")
}

/// The text with short lists of scalars in brackets.
fn with_short_lists(text: &str) -> String {
    let lines: Vec<&str> = text.lines().collect();
    let mut short = String::new();
    let mut row = 0;
    while row < lines.len() {
        let line = lines[row];
        let items: Vec<&str> = (lines[row + 1..].iter())
            .map_while(|it| it.trim_start().strip_prefix("- "))
            .collect();
        let list = items.join(", ");
        let is_list = line.ends_with(':') && !items.is_empty() && list.len() <= LONGEST_LIST;
        if is_list && !list.contains(": ") {
            short += &format!("{line} [{list}]\n");
            row += items.len();
        } else {
            short += line;
            short.push('\n');
        }
        row += 1;
    }
    short
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::localization::TrackerConfig;

    #[test]
    fn a_key_stands_below_the_docs_of_its_field_and_the_words_that_it_may_be() {
        let text = commented::<TrackerConfig>().unwrap();
        assert!(text.contains(
            "  # Largest number of particles while searching.\n  num_particles: 10000\n"
        ));
        assert!(text.contains("# One of fuzzy, pca, ransac.\n    method: fuzzy\n"));
        assert!(text.contains("triangle: [12.0, 55.0, 65.0]"));
        assert!(!text.contains("](") && !text.contains("::"), "{text}");
    }

    #[test]
    fn links_are_their_text() {
        let docs = "What [`build`](Self::build) and [`Map`] do [m].";
        assert_eq!(without_links(docs), "What `build` and `Map` do [m].");
    }
}
