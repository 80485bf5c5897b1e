//! What is computed once per observation and held: the vision-language tokens, and the keys and values of every cross-attention block.

use std::ops::Range;

use saccade_vla_kernels::{Activations, PackedKeyValues};

use crate::alloc::sized;
use crate::config::Reads;
use crate::error::Result;
use crate::inspect::trace::Recorded;

/// An encoded observation. Immutable; serves any number of calls and threads.
pub struct Context {
    pub(crate) head: u64,
    pub(crate) batch: usize,
    pub(crate) num_vl_tokens: usize,
    pub(crate) vl_embs: Vec<f32>,
    /// Keys and values by block, and within a block by batch element, of the positions that the block sees. Empty for self-attention.
    pub(crate) keys_values: Vec<Vec<PackedKeyValues>>,
    /// One for each kind of cross-attention block.
    pub(crate) seen: Vec<Seen>,
    pub(crate) image_mask: Option<Vec<bool>>,
    pub(crate) recorded: Recorded<usize>,
}

impl Context {
    /// Observations in this context.
    #[must_use]
    pub fn batch(&self) -> usize {
        self.batch
    }

    /// Vision-language tokens of each observation, removed ones included.
    #[must_use]
    pub fn num_vl_tokens(&self) -> usize {
        self.num_vl_tokens
    }

    /// The tokens after `vlln` and the VL self-attention, `(batch, num_vl_tokens, context_dim)`; rows of removed positions are zero.
    #[must_use]
    pub fn vl_embs(&self) -> &[f32] {
        &self.vl_embs
    }

    /// Which positions are image tokens, `(batch, num_vl_tokens)`, as it was given to `encode`.
    #[must_use]
    pub fn image_mask(&self) -> Option<&[bool]> {
        self.image_mask.as_deref()
    }

    /// Hands over what `encode` recorded of the VL self-attention, by block.
    #[must_use]
    pub fn take_recorded(&mut self) -> Recorded<usize> {
        std::mem::take(&mut self.recorded)
    }

    /// Bytes held, without what was recorded.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        let keys_values: usize = self
            .keys_values
            .iter()
            .flatten()
            .map(PackedKeyValues::nbytes)
            .sum();
        let seen: usize = self.seen.iter().map(Seen::nbytes).sum();
        4 * self.vl_embs.len() + keys_values + seen + self.image_mask.as_ref().map_or(0, Vec::len)
    }

    /// The positions that blocks of this kind see, by batch element; none if they see all.
    pub(crate) fn positions(&self, reads: Reads) -> Option<&[Vec<usize>]> {
        let seen = self.seen.iter().find(|seen| seen.reads == reads)?;
        seen.positions.as_deref()
    }
}

/// The vision-language tokens that one kind of cross-attention block sees.
pub(crate) struct Seen {
    pub reads: Reads,
    /// Ascending, by batch element; none if all are seen.
    pub positions: Option<Vec<Vec<usize>>>,
}

impl Seen {
    /// How many are seen in each of these batch elements.
    pub(crate) fn counts(&self, elements: Range<usize>, num_vl_tokens: usize) -> Vec<usize> {
        match &self.positions {
            None => vec![num_vl_tokens; elements.len()],
            Some(positions) => positions[elements].iter().map(Vec::len).collect(),
        }
    }

    /// The rows of these batch elements that are seen, one element's after the other's; `gathered` is memory for them.
    pub(crate) fn rows<'a>(
        &self,
        elements: Range<usize>,
        vl: &'a [f32],
        context_dim: usize,
        gathered: &'a mut Activations,
    ) -> Result<&'a [f32]> {
        let Some(positions) = &self.positions else {
            return Ok(vl);
        };
        let rows: usize = positions[elements.clone()].iter().map(Vec::len).sum();
        let gathered = sized(gathered, rows * context_dim)?;
        let mut rows = gathered.chunks_exact_mut(context_dim);
        let element = vl.len() / elements.len();
        for (vl, positions) in vl.chunks_exact(element).zip(&positions[elements]) {
            for (&position, row) in positions.iter().zip(&mut rows) {
                row.copy_from_slice(&vl[position * context_dim..][..context_dim]);
            }
        }
        Ok(gathered)
    }

    fn nbytes(&self) -> usize {
        let positions = self.positions.iter().flatten();
        positions.map(|positions| size_of_val(positions.as_slice())).sum()
    }
}
