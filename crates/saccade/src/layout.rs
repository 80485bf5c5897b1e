//! Tensors by name: what a model's checkpoint must hold, and what is read of it.

use std::ops::Range;

/// A tensor that a checkpoint must hold.
#[derive(Clone, Debug)]
pub(crate) struct TensorSpec {
    pub name: String,
    pub shape: Vec<usize>,
    /// Whether it may be stored as int8 with a scale for each row: the weights that run so.
    pub may_be_int8: bool,
    /// Whether its first axis is of embodiments.
    pub per_embodiment: bool,
}

/// A tensor to read, or some slices of its first axis.
#[derive(Clone, Debug)]
pub(crate) struct Wanted {
    pub name: String,
    pub slices: Option<Range<usize>>,
    /// Whether its memory comes back to be read into again: only what is not kept may be read into larger memory than it needs.
    pub is_given_back: bool,
}

impl TensorSpec {
    /// A floating-point tensor that all embodiments share.
    pub(crate) fn plain(name: &str, shape: &[usize]) -> Self {
        Self {
            name: name.to_owned(),
            shape: shape.to_vec(),
            may_be_int8: false,
            per_embodiment: false,
        }
    }
}
