//! What a query may attend to: every key, those up to its own position, or what a bias on the logits leaves.

/// What is added to the logits: element `(head, query, key)` is
/// `values[head * head_stride + query * query_stride + key]`.
///
/// A stride of 0 repeats a row. `f32::NEG_INFINITY` removes a key: then neither the key nor its value has any
/// influence.
#[derive(Clone, Copy, Debug)]
pub struct LogitBias<'a> {
    /// Rows of one element per key.
    pub values: &'a [f32],
    /// Elements from a head's rows to the next one's.
    pub head_stride: usize,
    /// Elements from a query's row to the next one's.
    pub query_stride: usize,
}

/// Which keys a query attends to.
#[derive(Clone, Copy, Debug, Default)]
pub enum Mask<'a> {
    /// All of them.
    #[default]
    None,
    /// Query number `i` attends to keys `0 ..= offset + i`, as far as there are keys. What this removes is
    /// not computed, and a query's result has the same bits whatever comes after its last key.
    Causal {
        /// Keys before the first query's own: 0 where queries and keys are the same rows; the length of the
        /// prefix where keys of earlier rows are cached.
        offset: usize,
    },
    /// Those that the bias does not remove.
    Bias(LogitBias<'a>),
}

impl<'a> From<Option<LogitBias<'a>>> for Mask<'a> {
    fn from(bias: Option<LogitBias<'a>>) -> Self {
        bias.map_or(Self::None, Self::Bias)
    }
}

impl Mask<'_> {
    /// How many of the first `len` keys come before the first one that no query up to number `query` attends
    /// to.
    #[inline(always)]
    pub(super) fn visible(&self, query: usize, len: usize) -> usize {
        match self {
            Self::Causal { offset } => len.min(offset.saturating_add(query).saturating_add(1)),
            Self::None | Self::Bias(_) => len,
        }
    }

    /// The bias of one query, one element for each of `len` keys.
    #[inline(always)]
    pub(super) fn bias(&self, head: usize, query: usize, len: usize) -> Option<&[f32]> {
        match self {
            Self::Bias(bias) => {
                Some(&bias.values[head * bias.head_stride + query * bias.query_stride..][..len])
            }
            Self::None | Self::Causal { .. } => None,
        }
    }

    /// # Panics
    /// If a bias is too short for these logits, of which there is at least one.
    pub(super) fn check(&self, num_heads: usize, queries: usize, len: usize) {
        if let Self::Bias(bias) = self {
            let heads = (num_heads - 1).saturating_mul(bias.head_stride);
            let queries = (queries - 1).saturating_mul(bias.query_stride);
            let needed = heads.saturating_add(queries).saturating_add(len);
            assert!(
                bias.values.len() >= needed,
                "bias: expected {needed} elements, got {}",
                bias.values.len()
            );
        }
    }
}
