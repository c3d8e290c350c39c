//! Names from outside (files, folders, topics) in texts for people: control characters are shown, not obeyed.

use std::borrow::Cow;

/// Replaces control characters except newlines and tabs, and characters that change the direction of text, by the
/// escapes of JSON (`\u001b`), so that text in JSON keeps its meaning.
pub fn visible(text: &str) -> Cow<'_, str> {
    escaped(text, |c| matches!(c, '\n' | '\t'))
}

/// The same for a part of a line: newlines are replaced, too.
pub fn visible_in_line(text: &str) -> Cow<'_, str> {
    escaped(text, |c| c == '\t')
}

fn escaped(text: &str, is_own: impl Fn(char) -> bool) -> Cow<'_, str> {
    let is_hidden = |c: char| !is_own(c) && (c.is_control() || is_direction(c));
    if !text.contains(is_hidden) {
        return text.into();
    }
    let shown = |c: char| match c {
        '\n' if is_hidden(c) => "\\n".to_owned(),
        c if is_hidden(c) => format!("\\u{:04x}", u32::from(c)),
        c => c.to_string(),
    };
    text.chars().map(shown).collect()
}

/// Whether a character separates lines or changes the direction of text.
fn is_direction(c: char) -> bool {
    matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_shown_and_text_in_json_keeps_its_meaning() {
        let name = "a\u{1b}]0;t\u{7}\u{7f}\u{9b}2J\u{202e}ä\n";
        assert_eq!(
            visible_in_line(name),
            r"a\u001b]0;t\u0007\u007f\u009b2J\u202eä\n"
        );
        assert_eq!(visible("a\n\tb"), "a\n\tb");
        let json = serde_json::to_string(name).unwrap();
        assert_eq!(
            serde_json::from_str::<String>(&visible(&json)).unwrap(),
            name
        );
    }
}
