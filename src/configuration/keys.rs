//! The lines of a YAML text in block style that are keys, or items of lists.

/// Stands for a dot that is part of a key.
pub(super) const DOT: &str = "\u{1}";

/// A key of a YAML text in block style, or an item of a list.
pub(super) struct Key {
    /// Dotted (`range_image.width`); an item has its number, from 1 (`fuzzy.rules[2]`).
    pub(super) name: String,
    /// The same, with [`DOT`] where a key itself contains a dot.
    pub(super) given: String,
    /// The line that it starts on, from 0.
    pub(super) line: usize,
    /// Twice the indentation, and one more for an item, which may stand below its list unindented.
    pub(super) depth: usize,
    items: usize,
}

/// Lists the keys and the items of a text in order; what is in brackets, quotes or a block of text is part of a value.
pub(super) fn keys(text: &str) -> Vec<Key> {
    let mut keys: Vec<Key> = Vec::new();
    let mut open: Vec<usize> = Vec::new();
    let mut value = Value::default();
    for (line, text) in text.lines().enumerate() {
        let content = text.trim_start();
        let indentation = text.len() - content.len();
        if value.continues_on(content, indentation) {
            continue;
        }
        let is_item = content == "-" || content.starts_with("- ");
        let key = key_of(content);
        if !is_item && key.is_none() {
            continue;
        }
        value = Value::begin(
            key.as_ref().map_or(content, |(_, value)| value),
            indentation,
        );
        let depth = 2 * indentation + usize::from(is_item);
        open.retain(|&parent| keys[parent].depth < depth);
        let parent = open.last().map(|&parent| &mut keys[parent]);
        let key = key.map(|(name, _)| name.replace('.', DOT));
        let given = match (key, parent) {
            (Some(name), None) => name,
            (Some(name), Some(parent)) => format!("{}.{name}", parent.given),
            (None, Some(list)) => {
                list.items += 1;
                format!("{}[{}]", list.given, list.items)
            }
            (None, None) => continue,
        };
        open.push(keys.len());
        keys.push(Key {
            name: given.replace(DOT, "."),
            given,
            line,
            depth,
            items: 0,
        });
    }
    keys
}

/// The key that a line without its indentation starts with, and the rest of the line.
pub(super) fn key_of(content: &str) -> Option<(String, &str)> {
    let is_name = |c: char| c.is_alphanumeric() || "_-.".contains(c);
    let (name, rest) = match content.chars().next()? {
        quote @ ('"' | '\'') => content[1..].split_once(quote)?,
        _ => content.split_at(content.find(|c| !is_name(c))?),
    };
    let value = rest.trim_start().strip_prefix(':')?;
    let is_key = !name.is_empty() && (value.is_empty() || value.starts_with([' ', '\t']));
    is_key.then(|| (name.to_owned(), value))
}

/// A value that may go on in the next lines.
#[derive(Default)]
struct Value {
    /// Number of open brackets.
    brackets: usize,
    /// The open quote.
    quote: Option<char>,
    /// Indentation of the key of a block of text.
    block_of: Option<usize>,
}

impl Value {
    /// A value by its first line.
    fn begin(line: &str, indentation: usize) -> Self {
        let mut value = Self::default();
        if line.trim_start().starts_with(['|', '>']) {
            value.block_of = Some(indentation);
        } else {
            value.read(line);
        }
        value
    }

    /// Whether a line is part of it.
    fn continues_on(&mut self, content: &str, indentation: usize) -> bool {
        if let Some(key) = self.block_of {
            if content.is_empty() || indentation > key {
                return true;
            }
            self.block_of = None;
        }
        let is_open = self.brackets > 0 || self.quote.is_some();
        if is_open {
            self.read(content);
        }
        is_open
    }

    fn read(&mut self, line: &str) {
        let mut before = ' ';
        for c in line.chars() {
            match (self.quote, c) {
                (Some('"'), '"') if before == '\\' => (),
                (Some(quote), c) if c == quote => self.quote = None,
                (Some(_), _) => (),
                (None, '"' | '\'') if " [{,:".contains(before) => self.quote = Some(c),
                (None, '#') if before == ' ' => return,
                (None, '[' | '{') if self.brackets > 0 || before == ' ' => self.brackets += 1,
                (None, ']' | '}') => self.brackets = self.brackets.saturating_sub(1),
                _ => (),
            }
            before = c;
        }
    }
}
