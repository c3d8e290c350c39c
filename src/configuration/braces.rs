//! Blocks in braces, such as `range_image: {width: 900}`, as blocks of lines, whose keys may have any of their names.

use super::keys::{key_of, keys};
use super::names::Names;

/// A character and its line, from 0.
type Char = (char, usize);

/// Lines of a text, with their numbers in the original one.
#[derive(Debug, Default)]
pub(super) struct Lines {
    pub(super) texts: Vec<String>,
    pub(super) numbers: Vec<usize>,
}

impl Lines {
    /// Writes the blocks of a configuration that are in braces as lines. What is not a mapping in braces and nothing
    /// else stays as it is.
    pub(super) fn without_braces(original: &[&str], names: &Names) -> Self {
        let mut lines = Self::default();
        let is_content =
            |line: &&str| !line.trim().is_empty() && !line.starts_with(['#', '-', '%']);
        let first = original.iter().position(is_content);
        let whole = first.filter(|&first| original[first].starts_with('{'));
        let mut next = 0;
        if let Some(first) = whole
            && let Some(entries) = entries(&characters(original, first, 0, original.len()))
        {
            lines.push_original(original, 0, first);
            lines.push_entries(&entries, "", 0, names);
            return lines;
        }
        let keys = keys(&original.join("\n"));
        for (index, key) in keys.iter().enumerate() {
            let line = original[key.line];
            let indentation = line.len() - line.trim_start().len();
            let value = key_of(&line[indentation..]).map_or("", |(_, value)| value);
            let is_block = value.trim_start().starts_with('{') && names.is_block(&key.name);
            if !is_block || key.line < next {
                continue;
            }
            let start = line.len() - value.len();
            let end = keys.get(index + 1).map_or(original.len(), |next| next.line);
            if let Some(entries) = entries(&characters(original, key.line, start, end)) {
                lines.push_original(original, next, key.line);
                lines.push(line[..start].to_owned(), key.line);
                lines.push_entries(&entries, &key.name, indentation + 2, names);
                next = end;
            }
        }
        lines.push_original(original, next, original.len());
        lines
    }

    fn push(&mut self, text: String, number: usize) {
        self.texts.push(text);
        self.numbers.push(number);
    }

    fn push_original(&mut self, original: &[&str], start: usize, end: usize) {
        for (number, line) in original.iter().enumerate().take(end).skip(start) {
            self.push((*line).to_owned(), number);
        }
    }

    fn push_entries(&mut self, all: &[Vec<Char>], block: &str, indentation: usize, names: &Names) {
        for entry in all {
            let number = entry[0].1;
            let text: String = entry.iter().map(|(c, _)| c).collect();
            let indented = format!("{:indentation$}{text}", "");
            let (name, value) = key_of(&text).unwrap_or_default();
            let name = format!("{block}.{name}");
            let name = name.trim_start_matches('.');
            let inner = &entry[text.chars().count() - value.chars().count()..];
            match names.is_block(name).then(|| entries(inner)).flatten() {
                Some(inner) => {
                    self.push(indented[..indented.len() - value.len()].to_owned(), number);
                    self.push_entries(&inner, name, indentation + 2, names);
                }
                None => self.push(indented, number),
            }
        }
    }
}

/// The characters from a column of a line on, up to the end of some lines.
fn characters(lines: &[&str], first: usize, column: usize, end: usize) -> Vec<Char> {
    let rows = (first..end).flat_map(|row| {
        let start = if row == first { column } else { 0 };
        let line = lines[row][start..].chars().chain(['\n']);
        line.map(move |c| (c, row))
    });
    rows.collect()
}

/// The entries of a mapping in braces, each with its key; `None` if the text is anything else, or has none.
fn entries(text: &[Char]) -> Option<Vec<Vec<Char>>> {
    let start = text.iter().position(|(c, _)| !c.is_whitespace())?;
    if text[start].0 != '{' {
        return None;
    }
    let mut entries = vec![Vec::new()];
    let mut depth = 1_usize;
    let mut quote = None;
    let mut before = '{';
    let mut rest = text[start + 1..].iter().copied().peekable();
    while let Some((c, row)) = rest.next() {
        let last = std::mem::replace(&mut before, c);
        if quote.is_none() && c == '#' && last.is_whitespace() {
            while rest.next_if(|&(_, other)| other == row).is_some() {}
            before = '\n';
            continue;
        }
        if depth == 0 {
            if c.is_whitespace() {
                continue;
            }
            return None;
        }
        match (quote, c) {
            // Escapes, and quotes of several lines.
            (Some(_), '\n' | '\\') => return None,
            (None, '\'') if last == c => return None,
            (Some(open), _) => quote = Some(open).filter(|&open| open != c),
            (None, '"' | '\'') if last.is_whitespace() || "[{,:".contains(last) => quote = Some(c),
            (None, '{' | '[') => depth += 1,
            (None, '}' | ']') => depth -= 1,
            (None, ',') if depth == 1 => {
                entries.push(Vec::new());
                continue;
            }
            _ => (),
        }
        if depth > 0 {
            let c = if c == '\n' { ' ' } else { c };
            entries.last_mut()?.push((c, row));
        }
    }
    let blank = |(c, _): &Char| c.is_whitespace();
    for entry in &mut entries {
        let content = entry.iter().position(|c| !blank(c)).unwrap_or(entry.len());
        entry.drain(..content);
        let end = entry
            .iter()
            .rposition(|c| !blank(c))
            .map_or(0, |last| last + 1);
        entry.truncate(end);
    }
    let last = entries.pop()?;
    entries.extend((!last.is_empty()).then_some(last));
    let is_key = |entry: &Vec<Char>| {
        let text: String = entry.iter().map(|(c, _)| c).collect();
        key_of(&text).is_some()
    };
    (depth == 0 && !entries.is_empty() && entries.iter().all(is_key)).then_some(entries)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn expanded(text: &str) -> (Vec<String>, Vec<usize>) {
        let names = [
            "seed",
            "tracker",
            "tracker.seed",
            "tracker.sensor",
            "tracker.sensor.width",
            "list",
        ];
        let names = Names(names.map(str::to_owned).into());
        let rows: Vec<&str> = text.lines().collect();
        let lines = Lines::without_braces(&rows, &names);
        (lines.texts, lines.numbers)
    }

    #[test]
    fn blocks_in_braces_are_lines_with_the_numbers_of_theirs() {
        let (texts, numbers) =
            expanded("# {\ntracker: {seed: 7, # }\n  sensor: {\n width: 1}}  # end\nlist: {a: 1}");
        let expected = [
            "# {",
            "tracker:",
            "  seed: 7",
            "  sensor:",
            "    width: 1",
            "list: {a: 1}",
        ];
        assert_eq!(texts, expected);
        assert_eq!(numbers, [0, 1, 1, 2, 3, 4]);
        let (texts, _) = expanded("{tracker: {seed: 7}, 'list': ['a, b}', {c: d}]}");
        assert_eq!(
            texts,
            ["tracker:", "  seed: 7", "'list': ['a, b}', {c: d}]"]
        );
    }

    #[test]
    fn what_is_no_mapping_in_braces_stays() {
        for text in [
            "tracker: {}",
            "tracker: {seed: 7",
            "tracker: {seed}",
            "tracker: {seed: 7} x",
            "tracker: {seed: 7}}",
            "tracker: {seed: 7} {seed: 7}",
            "tracker: {seed: 'it''s, a'}",
            "tracker: {seed: 'a\n b'}",
            "tracker: &a {seed: 7}",
            "tracker: {<<: *a}",
        ] {
            let rows: Vec<&str> = text.lines().collect();
            assert_eq!(expanded(text).0, rows, "{text}");
        }
    }
}
