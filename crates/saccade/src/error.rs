//! What can go wrong: every message names the thing, what was given and what was expected.

use std::path::PathBuf;

/// The result of everything in this crate that can fail.
pub type Result<T> = std::result::Result<T, Error>;

/// An error that a user can act on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An array has the wrong number of axes or the wrong size on one of them.
    #[error("{0}")]
    Shape(String),
    /// A value is out of range, not finite, or belongs to another head.
    #[error("{0}")]
    Input(String),
    /// A checkpoint or its configuration is broken, incomplete or of another kind; all that is wrong is listed.
    #[error("{0}")]
    Checkpoint(String),
    /// A file that cannot be written.
    #[error("{0}")]
    Output(String),
    /// A path that is not there.
    #[error("{what}: no such file or directory: {}", path.display())]
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
