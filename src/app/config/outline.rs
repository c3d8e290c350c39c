//! Where each key stands in a YAML text of one key per line: enough to name the key of a line
//! and the line of a key, and to replace the value of a key in a text that was written by
//! [`to_yaml`](super::to_yaml).

/// The keys of a text in block style, in order.
pub(super) struct Outline<'a> {
    lines: Vec<&'a str>,
    entries: Vec<Entry>,
}

struct Entry {
    /// Dotted: `range_image.width`.
    key: String,
    indent: usize,
    /// The line of the key, counted from 0.
    line: usize,
    /// One after the last line of the value.
    end: usize,
    /// The lines of the items, where the value is a list.
    items: Vec<usize>,
}

impl<'a> Outline<'a> {
    /// Reads the outline. Keys inside lists and inside braces are part of the value.
    pub(super) fn of(text: &'a str) -> Self {
        let lines: Vec<&str> = text.lines().collect();
        let mut entries: Vec<Entry> = Vec::new();
        let mut open: Vec<usize> = Vec::new();
        let mut list_indent = None;
        for (number, line) in lines.iter().enumerate() {
            let content = line.trim_start();
            if content.is_empty() || content.starts_with('#') {
                continue;
            }
            let indent = line.len() - content.len();
            if content.starts_with("- ") || content == "-" {
                let list = *list_indent.get_or_insert(indent);
                if let Some(&innermost) = open.last()
                    && indent == list
                {
                    entries[innermost].items.push(number);
                }
                continue;
            }
            if list_indent.is_some_and(|list| indent > list) {
                continue;
            }
            list_indent = None;
            let Some(name) = key_of(content) else {
                continue;
            };
            while let Some(last) = open.pop_if(|index| entries[*index].indent >= indent) {
                entries[last].end = number;
            }
            let key = match open.last() {
                Some(&parent) => format!("{}.{name}", entries[parent].key),
                None => name.to_owned(),
            };
            open.push(entries.len());
            entries.push(Entry {
                key,
                indent,
                line: number,
                end: lines.len(),
                items: Vec::new(),
            });
        }
        Self { lines, entries }
    }

    /// All dotted keys.
    pub(super) fn keys(&self) -> impl Iterator<Item = &str> {
        self.entries.iter().map(|entry| entry.key.as_str())
    }

    /// The key whose value a line (counted from 1) belongs to.
    pub(super) fn key_at(&self, line: usize) -> Option<&str> {
        let innermost = self
            .entries
            .iter()
            .rfind(|entry| (entry.line..entry.end).contains(&(line - 1)))?;
        Some(&innermost.key)
    }

    /// The line (counted from 1) of a key; of the item of a list where the key ends in its number
    /// (`fuzzy.rules[2]`, counted from 1).
    pub(super) fn line_of(&self, key: &str) -> Option<usize> {
        let (name, item) = item_of(key);
        let entry = self.entries.iter().find(|entry| entry.key == name)?;
        let line = item.and_then(|item| entry.items.get(item.checked_sub(1)?));
        Some(line.unwrap_or(&entry.line) + 1)
    }

    /// The text with another value for a key; `None` where there is no such key.
    pub(super) fn with_value(&self, key: &str, value: &str) -> Option<String> {
        let entry = self.entries.iter().find(|entry| entry.key == key)?;
        let name = key.rsplit('.').next()?;
        let replaced = format!("{}{name}: {value}", " ".repeat(entry.indent));
        let lines: Vec<&str> = self.lines[..entry.line]
            .iter()
            .copied()
            .chain([replaced.as_str()])
            .chain(self.lines[entry.end..].iter().copied())
            .collect();
        Some(lines.join("\n"))
    }
}

/// A key without the number of an item at its end, and that number.
fn item_of(key: &str) -> (&str, Option<usize>) {
    let item = || {
        let (name, number) = key.strip_suffix(']')?.rsplit_once('[')?;
        Some((name, Some(number.parse().ok()?)))
    };
    item().unwrap_or((key, None))
}

/// The key that a line begins with.
fn key_of(content: &str) -> Option<&str> {
    let (name, rest) = content.split_once(':')?;
    let is_word = !name.is_empty()
        && name
            .chars()
            .all(|c| c.is_alphanumeric() || c == '_' || c == '-');
    (is_word && (rest.is_empty() || rest.starts_with(' '))).then_some(name)
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

    #[test]
    fn every_key_has_its_path_and_keys_in_lists_have_none() {
        let outline = Outline::of(TEXT);
        assert_eq!(
            outline.keys().collect::<Vec<_>>(),
            [
                "first",
                "block",
                "block.inner",
                "block.list",
                "block.deep",
                "block.deep.deepest",
                "last"
            ]
        );
    }

    #[test]
    fn the_line_of_a_key_belongs_to_that_key() {
        let outline = Outline::of(TEXT);
        for key in outline.keys() {
            assert_eq!(outline.key_at(outline.line_of(key).unwrap()), Some(key));
        }
        assert_eq!(outline.key_at(8), Some("block.list"));
    }

    #[test]
    fn the_items_of_a_list_have_lines_of_their_own() {
        let outline = Outline::of(TEXT);
        assert_eq!(outline.line_of("block.list[1]"), Some(7));
        assert_eq!(outline.line_of("block.list[2]"), Some(9));
        // What is not there is told at the list.
        assert_eq!(outline.line_of("block.list[3]"), Some(6));
        assert_eq!(outline.line_of("block.list[0]"), Some(6));
        assert_eq!(outline.line_of("nothing[1]"), None);
    }

    #[test]
    fn replacing_a_value_leaves_every_other_line() {
        let replaced = Outline::of(TEXT).with_value("block.list", "[]").unwrap();
        let expected = TEXT.replace(
            "  list:\n  - name: a\n    other: b\n  - name: c\n",
            "  list: []\n",
        );
        assert_eq!(replaced.trim_end(), expected.trim_end());
    }

    #[test]
    fn a_key_that_is_not_there_has_no_line_and_cannot_be_replaced() {
        let outline = Outline::of(TEXT);
        assert_eq!(outline.line_of("inner"), None);
        assert_eq!(outline.with_value("inner", "3"), None);
    }
}
