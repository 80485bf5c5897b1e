//! What can go wrong with files, and how messages show shapes, sizes and text from strangers.

use std::borrow::Cow;
use std::fmt::{self, Display, Formatter, Write};
use std::io;
use std::path::{Path, PathBuf};

/// The result of everything in this crate that can fail.
pub type Result<T> = std::result::Result<T, Error>;

/// An error that a user can act on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An argument is out of range, or names a directory that must not be replaced.
    #[error("{0}")]
    Input(Problem),
    /// A checkpoint is broken, incomplete or of another kind.
    #[error("{0}")]
    Checkpoint(Problem),
    /// A file cannot be read.
    #[error("{what}: {} cannot be read: {source}", printable(&path.to_string_lossy()))]
    Unreadable {
        /// The argument or role of the path.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A tensor cannot be read from its file.
    #[error("source: {} cannot be read from {}: {source}", printable(name), printable(&path.to_string_lossy()))]
    UnreadableTensor {
        /// The tensor.
        name: String,
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A file holds text that is not the JSON that is expected there.
    #[error("{what}: {}: {}", printable(&path.to_string_lossy()), printable(&source.to_string()))]
    Json {
        /// The argument or role of the path.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// Where and why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A file cannot be written.
    #[error("out: {} cannot be written: {source}", printable(&path.to_string_lossy()))]
    Output {
        /// The file or directory.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A checkpoint was written, and could not be given its name; nothing was deleted.
    #[error(
        "out: {} cannot be given to the new checkpoint: {source}; the old one is in {} and the new one in {}",
        printable(&path.to_string_lossy()),
        printable(&old.to_string_lossy()),
        printable(&new.to_string_lossy())
    )]
    Stranded {
        /// The wanted name.
        path: PathBuf,
        /// Where the checkpoint is that had this name.
        old: PathBuf,
        /// Where the new one is.
        new: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Memory that the system refused.
    #[error("{what}: cannot allocate {}", show_bytes(*bytes))]
    Memory {
        /// What it was for.
        what: &'static str,
        /// How much was asked for.
        bytes: usize,
    },
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
    /// The argument that is to blame, if one is.
    #[must_use]
    pub fn argument(&self) -> Option<&str> {
        match self {
            Self::Input(problem) | Self::Checkpoint(problem) => problem.argument(),
            Self::Unreadable { what, .. }
            | Self::Json { what, .. }
            | Self::Memory { what, .. }
            | Self::NotFound { what, .. } => Some(what),
            Self::UnreadableTensor { .. } => Some("source"),
            Self::Output { .. } | Self::Stranded { .. } => Some("out"),
        }
    }

    /// The error for `path`, which could not be opened or read.
    pub(crate) fn reading(what: &'static str, path: &Path, source: io::Error) -> Self {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::NotFound => Self::NotFound { what, path },
            _ => Self::Unreadable { what, path, source },
        }
    }

    /// The error for `path`, which could not be written.
    pub(crate) fn writing(path: &Path, source: io::Error) -> Self {
        Self::Output {
            path: path.to_owned(),
            source,
        }
    }
}

/// An argument, and why it is refused. Its text names the argument, what was expected and what was given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    argument: String,
    reason: Reason,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Reason {
    Unexpected { expected: String, given: String },
    Other(String),
}

impl Problem {
    /// The problem `argument: expected ..., got ...`. The argument may be a path into one, as `chunking: overlap`.
    pub fn expected(argument: impl Display, expected: impl Display, given: impl Display) -> Self {
        let (expected, given) = (expected.to_string(), given.to_string());
        Self {
            argument: argument.to_string(),
            reason: Reason::Unexpected { expected, given },
        }
    }

    /// The problem `argument: text`, where the two sides do not say it.
    pub fn new(argument: impl Display, text: impl Display) -> Self {
        Self {
            argument: argument.to_string(),
            reason: Reason::Other(text.to_string()),
        }
    }

    /// The argument, where one is to blame.
    #[must_use]
    pub fn argument(&self) -> Option<&str> {
        Some(self.argument.as_str()).filter(|argument| !argument.is_empty())
    }

    /// What was expected and what was given, where the text says both.
    #[must_use]
    pub fn sides(&self) -> Option<(&str, &str)> {
        match &self.reason {
            Reason::Unexpected { expected, given } => Some((expected, given)),
            Reason::Other(_) => None,
        }
    }
}

/// A [`Problem`] in the words of its place: `problem!("out"; "{path} exists")`, or with both sides,
/// `problem!("num_heads"; expected "a divisor of {width}"; got "{num_heads}")`.
#[doc(hidden)]
#[macro_export]
macro_rules! problem {
    ($argument:expr; expected $expected:literal $(, $of:expr)*; got $given:literal $(, $with:expr)*) => {
        $crate::Problem::expected(
            $argument,
            format_args!($expected $(, $of)*),
            format_args!($given $(, $with)*),
        )
    };
    ($argument:expr; $text:literal $(, $with:expr)*) => {
        $crate::Problem::new($argument, format_args!($text $(, $with)*))
    };
}

/// Returns the error with a [`problem!`]: `bail!(Input, "out"; "{path} exists")` for the `Error::Input` of the caller.
#[doc(hidden)]
#[macro_export]
macro_rules! bail {
    ($kind:ident, $($problem:tt)+) => {
        return Err(Error::$kind($crate::problem!($($problem)+)))
    };
}

/// Returns the error with a [`problem!`] unless something holds: `ensure!(!path.exists(), Input, "out"; "{path} exists")`.
#[doc(hidden)]
#[macro_export]
macro_rules! ensure {
    ($holds:expr, $kind:ident, $($problem:tt)+) => {
        if !$holds {
            $crate::bail!($kind, $($problem)+);
        }
    };
}

/// A problem of no argument.
impl From<String> for Problem {
    fn from(text: String) -> Self {
        Self::new("", text)
    }
}

impl Display for Problem {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let mut text = match &self.reason {
            Reason::Unexpected { expected, given } => format!("expected {expected}, got {given}"),
            Reason::Other(text) => text.clone(),
        };
        if let Some(argument) = self.argument() {
            // A list begins on a line of its own.
            let space = if text.starts_with('\n') { "" } else { " " };
            text = format!("{argument}:{space}{text}");
        }
        f.write_str(&printable(&text))
    }
}

/// Gives `values` room for `len` elements in all.
///
/// # Errors
/// [`Error::Memory`] if the system refuses it: a file with holes is as long as it likes, and an allocation that fails ends the process.
pub fn reserve<T>(what: &'static str, values: &mut Vec<T>, len: usize) -> Result<()> {
    let more = len.saturating_sub(values.len());
    values.try_reserve_exact(more).map_err(|_| Error::Memory {
        what,
        bytes: len.saturating_mul(size_of::<T>()),
    })
}

/// Allocates this many bytes and frees them: checks that the system grants them, before any is used.
///
/// # Errors
/// [`Error::Memory`] if it does not.
pub fn probe_allocation(what: &'static str, bytes: usize) -> Result<()> {
    reserve(what, &mut Vec::<u8>::new(), bytes)
}

/// Lines of a message that are shown, and characters of the beginning and of the end of a line.
const MAX_LINES: usize = 1000;
const MAX_LINE: usize = 1000;

/// A message as it may reach a terminal: names and values in it come from files, which may hold anything. Control characters, and those
/// that change the direction of writing, are escaped; what is too long is cut.
#[must_use]
pub fn printable(message: &str) -> Cow<'_, str> {
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

/// Whether a character makes a terminal do anything but show it.
fn is_active(character: char) -> bool {
    character.is_control()
        || matches!(character, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Writes a shape as users write it: `(2, 40, 64)`, `(5,)`, `()`.
#[must_use]
pub fn show_shape(shape: &[usize]) -> String {
    match shape {
        [one] => format!("({one},)"),
        _ => format!(
            "({})",
            shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
        ),
    }
}

/// Writes a number of bytes, from 1000 on also in a larger unit: `512 bytes of memory`, `1500000 bytes of memory (1.5 MB)`.
#[must_use]
pub fn show_bytes(bytes: usize) -> String {
    let units = [
        (1e18, "EB"),
        (1e15, "PB"),
        (1e12, "TB"),
        (1e9, "GB"),
        (1e6, "MB"),
        (1e3, "kB"),
    ];
    let unit = units.iter().find(|(size, _)| bytes as f64 >= *size);
    let larger = unit.map(|(size, name)| format!(" ({:.1} {name})", bytes as f64 / size));
    format!("{bytes} bytes of memory{}", larger.unwrap_or_default())
}
