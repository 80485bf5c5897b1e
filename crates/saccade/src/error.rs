//! What can go wrong: every message names the thing, what was given and what was expected.

use std::borrow::Cow;
use std::fmt::Write;
use std::path::PathBuf;

/// The result of everything in this crate that can fail.
pub type Result<T> = std::result::Result<T, Error>;

/// An error that a user can act on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An array has the wrong number of axes or the wrong size on one of them.
    #[error("{}", printable(.0))]
    Shape(String),
    /// A value is out of range, not finite, or belongs to another head.
    #[error("{}", printable(.0))]
    Input(String),
    /// A checkpoint or its configuration is broken, incomplete or of another kind; all that is wrong is listed.
    #[error("{}", printable(.0))]
    Checkpoint(String),
    /// A file that cannot be written.
    #[error("{}", printable(.0))]
    Output(String),
    /// Memory that the system refused.
    #[error("{what}: cannot allocate {bytes} bytes of memory")]
    Memory {
        /// What it was for.
        what: &'static str,
        /// How much was asked for.
        bytes: usize,
    },
    /// The call was stopped by [`interruptible`](crate::interruptible).
    #[error("the call was interrupted")]
    Interrupted,
    /// A path that is not there.
    #[error("{what}: no such file or directory: {}", printable(&path.to_string_lossy()))]
    NotFound {
        /// The argument or role of the path.
        what: &'static str,
        /// The path as given.
        path: PathBuf,
    },
}

impl Error {
    /// The error for `path`, which could not be opened or read.
    pub(crate) fn from_io(what: &'static str, path: &std::path::Path, error: &std::io::Error) -> Self {
        if error.kind() == std::io::ErrorKind::NotFound {
            Self::NotFound {
                what,
                path: path.to_owned(),
            }
        } else {
            Self::Checkpoint(format!("{what}: {} cannot be read: {error}", path.display()))
        }
    }
}

/// A message shows at most so many lines, and of a line at most so many characters of its beginning and of its end.
const MAX_LINES: usize = 1000;
const MAX_LINE: usize = 1000;

/// A message as it may reach a terminal: names and values in it come from files, which may hold anything. Control characters, and those
/// that turn the direction of writing, are escaped; what is too long is cut.
fn printable(message: &str) -> Cow<'_, str> {
    let is_plain = |line: &str| line.len() <= MAX_LINE && !line.contains(is_active);
    if message.lines().count() <= MAX_LINES && message.lines().all(is_plain) {
        return Cow::Borrowed(message);
    }
    let mut shown = String::new();
    for (number, line) in message.split('\n').enumerate() {
        if number == MAX_LINES {
            shown.push_str("\n  ...");
            break;
        }
        if number > 0 {
            shown.push('\n');
        }
        let length = line.chars().count();
        for (column, character) in line.chars().enumerate() {
            if column == MAX_LINE && length > 2 * MAX_LINE {
                shown.push_str("...");
            }
            if column >= MAX_LINE && column < length.saturating_sub(MAX_LINE) {
                continue;
            }
            if is_active(character) {
                write!(shown, "{}", character.escape_unicode()).expect("strings take everything");
            } else {
                shown.push(character);
            }
        }
    }
    Cow::Owned(shown)
}

/// Whether a character does something to a terminal besides standing there.
fn is_active(character: char) -> bool {
    character.is_control()
        || matches!(character, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Writes a shape as users write it: `(2, 40, 64)`, `(5,)`, `()`.
pub(crate) fn show_shape(shape: &[usize]) -> String {
    match shape {
        [one] => format!("({one},)"),
        _ => format!(
            "({})",
            shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_do_nothing_to_a_terminal() {
        let error = Error::Checkpoint(
            "source: 2 tensors:\n  a\u{1b}[2Jb is unknown\n  c\r\u{202e}d\u{9b}".to_owned(),
        );
        let expected = "source: 2 tensors:\n  a\\u{1b}[2Jb is unknown\n  c\\u{d}\\u{202e}d\\u{9b}";
        assert_eq!(error.to_string(), expected);
        let error = Error::NotFound {
            what: "source",
            path: "a\u{7}".into(),
        };
        assert_eq!(error.to_string(), "source: no such file or directory: a\\u{7}");
    }

    #[test]
    fn long_messages_end() {
        let (begin, end) = ("a".repeat(MAX_LINE), "e".repeat(MAX_LINE));
        let shown = Error::Input(format!("{begin}{}{end}", "m".repeat(10 * MAX_LINE))).to_string();
        assert_eq!(shown, format!("{begin}...{end}"));
        assert_eq!(
            Error::Input(format!("{begin}{end}")).to_string(),
            format!("{begin}{end}")
        );
        let many = "a line\n".repeat(10 * MAX_LINES);
        let shown = Error::Input(many.clone()).to_string();
        assert_eq!(shown.lines().count(), MAX_LINES + 1);
        assert!(many.starts_with(shown.strip_suffix("  ...").unwrap()));
        let all = "a line with \"quotes\", tabs not, \u{e4}\u{3b1}\u{4e2d}\n".repeat(MAX_LINES);
        assert_eq!(Error::Input(all.clone()).to_string(), all);
    }
}
