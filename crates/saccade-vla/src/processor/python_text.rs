//! Text as Python treats it: `repr`, `lower`, and which characters are letters, digits and white space.
//!
//! Python's tables and Rust's are of the same Unicode, up to characters that a newer one has added.

use std::fmt::Write;
use std::sync::LazyLock;

use regex::Regex;

/// What `re.sub(r"[^\w\s]", "", text)` removes. `\w` is `str.isalnum` or an underscore; `\s` is
/// `str.isspace`, which has four separators that Unicode does not count as white space.
static PUNCTUATION: LazyLock<Regex> = LazyLock::new(|| pattern(r"[^\p{L}\p{N}_\s\x1c-\x1f]"));

/// What `str.isprintable` denies, and a space.
static UNPRINTABLE: LazyLock<Regex> = LazyLock::new(|| pattern(r"[\p{C}\p{Z}]"));

fn pattern(text: &str) -> Regex {
    Regex::new(text).expect("the pattern is written here")
}

/// `re.sub(r"[^\w\s]", "", text.lower())`.
pub(super) fn formalized(text: &str) -> String {
    PUNCTUATION.replace_all(&text.to_lowercase(), "").into_owned()
}

/// `str([text])`: a list of one string, as Python prints it.
pub(super) fn list_of(text: &str) -> String {
    let quote = match text.contains('\'') && !text.contains('"') {
        true => '"',
        false => '\'',
    };
    let mut printed = String::with_capacity(text.len() + 4);
    printed.push('[');
    printed.push(quote);
    for character in text.chars() {
        match character {
            '\\' => printed.push_str("\\\\"),
            '\n' => printed.push_str("\\n"),
            '\r' => printed.push_str("\\r"),
            '\t' => printed.push_str("\\t"),
            _ if character == quote => printed.extend(['\\', quote]),
            ' '..='~' => printed.push(character),
            _ if is_printable(character) => printed.push(character),
            _ => escape(&mut printed, u32::from(character)),
        }
    }
    printed.push(quote);
    printed.push(']');
    printed
}

fn is_printable(character: char) -> bool {
    !UNPRINTABLE.is_match(character.encode_utf8(&mut [0; 4]))
}

fn escape(printed: &mut String, code: u32) {
    let written = match code {
        0..0x100 => write!(printed, "\\x{code:02x}"),
        0x100..0x1_0000 => write!(printed, "\\u{code:04x}"),
        _ => write!(printed, "\\U{code:08x}"),
    };
    written.expect("a string takes all that is written to it");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_of_one_string_are_printed_as_python_prints_them() {
        for (text, printed) in [
            ("push", "['push']"),
            ("don't", "[\"don't\"]"),
            ("a \"b\"", "['a \"b\"']"),
            ("\"it's\"", "['\"it\\'s\"']"),
            ("a\\b\n\r\t", "['a\\\\b\\n\\r\\t']"),
            ("\u{7f}\u{a0}\u{ad}", "['\\x7f\\xa0\\xad']"),
            ("\u{200b}\u{3000}é", "['\\u200b\\u3000é']"),
            ("\u{e0001}🤖", "['\\U000e0001🤖']"),
        ] {
            assert_eq!(list_of(text), printed);
        }
    }

    #[test]
    fn punctuation_is_removed_and_letters_lowered() {
        assert_eq!(
            formalized("Pick_up: don't\u{1f}DROP it!"),
            "pick_up dont\u{1f}drop it"
        );
        assert_eq!(formalized("ΟΔΟΣ ½ ² ⅷ <|im_end|>"), "οδος ½ ² ⅷ im_end");
        assert_eq!(formalized("e\u{301}"), "e", "a combining accent is no letter");
    }
}
