//! What to change inside the head while it runs.

use super::groups::Tokens;
use crate::array::OwnedArray;

/// Rows that replace those of some tokens after one block of one step.
#[derive(Clone, Debug)]
pub struct Patch {
    /// The Euler step.
    pub step: usize,
    /// The block.
    pub block: usize,
    /// Whose rows.
    pub tokens: Tokens,
    /// `(tokens, width)`, or `(batch, tokens, width)`.
    pub rows: OwnedArray,
}

/// A change of what the head computes. Several act together: biases add up, of two patches of one row the later counts, and at most one
/// replaces the future tokens.
///
/// A change acts in a block only if the keys that it names are read there: keys of `vl` in cross-attention blocks, keys of state, future and
/// action in self-attention blocks. A cut or a bias that acts in none of the blocks it is limited to is an error, since it would look like a
/// change without effect; so are lists without an index and groups without a token. One that acts in some of the blocks only is fine.
///
/// ```
/// use saccade_vla::{Group, Intervention, Tokens};
/// let all = |group| Tokens { group, indices: None };
/// let blind = Intervention { cut: vec![(all(Group::Future), all(Group::Vl))], ..Intervention::default() };
/// assert!(blind.blocks.is_none(), "in every block");
/// ```
#[derive(Clone, Debug, Default)]
pub struct Intervention {
    /// `(reader, source)`: the reader's rows no longer see the source's keys. A row with no key left gets zero from the attention.
    pub cut: Vec<(Tokens, Tokens)>,
    /// Added to the logits of these keys, for every reader: one number, or `(tokens,)`. Minus infinity removes a key.
    pub key_bias: Vec<(Tokens, OwnedArray)>,
    /// Replaced rows; `blocks`, `steps` and `heads` do not limit them.
    pub patch: Vec<Patch>,
    /// `(tokens, width)`, in place of the learned ones and of the biases that these have; any number of tokens.
    pub future_tokens: Option<OwnedArray>,
    /// Blocks in which cuts and biases act; default all.
    pub blocks: Option<Vec<usize>>,
    /// Euler steps at which they act; default all.
    pub steps: Option<Vec<usize>>,
    /// Attention heads in which they act; default all.
    pub heads: Option<Vec<usize>>,
}
