//! What can go wrong: every message names the argument, what was given and what was expected.

use std::path::Path;

pub use saccade_vla_checkpoint::Problem;
pub(crate) use saccade_vla_checkpoint::{bail, ensure, problem, show_shape};
use saccade_vla_checkpoint::{printable, show_bytes};
use saccade_vla_kernels::{IsaError, KernelError, NumThreadsError};

/// Adds a sentence to a list of problems unless something holds: `require!(problems, n > 0; "n is {n}")`.
macro_rules! require {
    ($problems:ident, $holds:expr; $($sentence:tt)+) => {
        if !$holds {
            $problems.push(format!($($sentence)+));
        }
    };
}
pub(crate) use require;

/// The result of everything in this crate that can fail.
pub type Result<T> = std::result::Result<T, Error>;

/// An error that a user can act on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An array has the wrong number of axes or the wrong size on one of them.
    #[error("{0}")]
    Shape(Problem),
    /// A value is out of range, not finite, or belongs to another head.
    #[error("{0}")]
    Input(Problem),
    /// A checkpoint or its configuration is broken, incomplete or of another kind; all problems are listed.
    #[error("{0}")]
    Checkpoint(Problem),
    /// Text that is not JSON.
    #[error("{}: not valid JSON: {}", printable(what), printable(&source.to_string()))]
    Json {
        /// What should be JSON.
        what: String,
        /// Where and why it is not.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// `SACCADE_ISA` names an instruction set that is unknown or that this CPU lacks.
    #[error(transparent)]
    Isa(#[from] IsaError),
    /// `SACCADE_NUM_THREADS` is not a positive whole number.
    #[error(transparent)]
    NumThreads(#[from] NumThreadsError),
    /// Weights that cannot be packed.
    #[error("source: {0}")]
    Packing(#[source] KernelError),
    /// Memory that the system refused.
    #[error("{what}: cannot allocate {}", show_bytes(*bytes))]
    Memory {
        /// What it was for.
        what: &'static str,
        /// How much was asked for.
        bytes: usize,
    },
    /// The call was stopped by [`interruptible`](crate::interruptible).
    #[error("the call was interrupted")]
    Interrupted,
    /// A file cannot be read or written.
    #[error(transparent)]
    File(#[from] saccade_vla_checkpoint::Error),
}

/// What went wrong, for programs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// An array of the wrong shape.
    Shape,
    /// An argument out of range.
    Input,
    /// A checkpoint that is broken, incomplete or of another kind.
    Checkpoint,
    /// A file that cannot be written.
    Output,
    /// A path that is not there.
    NotFound,
    /// Memory that the system refused.
    Memory,
    /// The caller asked for an end.
    Interrupted,
}

impl Error {
    /// The error of text, called `what`, that is not the JSON which is expected.
    pub(crate) fn json(what: impl Into<String>, source: serde_json::Error) -> Self {
        Self::Json {
            what: what.into(),
            source: source.into(),
        }
    }

    /// The error of the text in the file `path`: one that names what is not JSON names the file too.
    pub(crate) fn in_file(self, path: &Path) -> Self {
        match self {
            Self::Json { what, source } => Self::Json {
                what: format!("{what}: {}", path.display()),
                source,
            },
            other => other,
        }
    }

    /// The argument that is to blame, if one is.
    #[must_use]
    pub fn argument(&self) -> Option<&str> {
        match self {
            Self::Shape(problem) | Self::Input(problem) | Self::Checkpoint(problem) => problem.argument(),
            Self::Json { what, .. } => what.split(": ").next(),
            Self::Memory { what, .. } => Some(what),
            Self::Isa(_) => Some("SACCADE_ISA"),
            Self::NumThreads(_) => Some("SACCADE_NUM_THREADS"),
            Self::Packing(_) => Some("source"),
            Self::File(error) => error.argument(),
            Self::Interrupted => None,
        }
    }

    /// What went wrong.
    #[must_use]
    pub fn kind(&self) -> ErrorKind {
        use saccade_vla_checkpoint::Error as File;
        match self {
            Self::Shape(_) => ErrorKind::Shape,
            Self::Input(_) | Self::Isa(_) | Self::NumThreads(_) | Self::File(File::Input(_)) => {
                ErrorKind::Input
            }
            Self::Memory { .. } | Self::File(File::Memory { .. }) => ErrorKind::Memory,
            Self::Interrupted => ErrorKind::Interrupted,
            Self::File(File::NotFound { .. }) => ErrorKind::NotFound,
            Self::File(File::Output { .. } | File::Stranded { .. }) => ErrorKind::Output,
            Self::Checkpoint(_) | Self::Json { .. } | Self::Packing(_) | Self::File(_) => {
                ErrorKind::Checkpoint
            }
        }
    }
}
