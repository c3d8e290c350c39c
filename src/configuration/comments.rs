//! A configuration with its documentation: every key with its default, below the docs of its field.

use schemars::schema_for;
use serde_json::Value;

use super::yaml::{keys, to_yaml};
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

/// The docs of a key in a schema.
fn description(schema: &Value, key: &str) -> Option<String> {
    let mut field = schema;
    for part in key.split('.') {
        field = &properties(schema, field)?[part];
    }
    let docs = field.get("description")?.as_str()?;
    let docs = docs.replace("[`", "`").replace("`]", "`");
    Some(docs.replace("`None`", "null"))
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
