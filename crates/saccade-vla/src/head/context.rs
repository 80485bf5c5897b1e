//! An encoded observation: the vision-language tokens, and the KV cache of every cross-attention block.

use std::ops::Range;

use saccade_vla_kernels::{PackedKeyValues, Rows};

use crate::alloc::Scratch;
use crate::config::Reads;
use crate::error::Result;
use crate::inspect::trace::Recorded;

/// An encoded observation. Immutable; serves any number of calls and threads.
pub struct Context {
    pub(crate) head: u64,
    pub(crate) batch: usize,
    pub(crate) num_vl_tokens: usize,
    pub(crate) vl_embs: Vec<f32>,
    /// KV caches by block, and within a block by observation, of the positions that the block sees. Empty for
    /// self-attention.
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

    /// The tokens after `vlln` and the VL self-attention, `(batch, num_vl_tokens, context_dim)`; rows of
    /// removed positions are zero.
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

    /// The positions that blocks of this kind see, by observation; none if they see all.
    pub(crate) fn positions(&self, reads: Reads) -> Option<&[Vec<usize>]> {
        let seen = self.seen.iter().find(|seen| seen.reads == reads)?;
        seen.positions.as_deref()
    }
}

/// The vision-language tokens that one kind of cross-attention block sees.
pub(crate) struct Seen {
    pub reads: Reads,
    /// Ascending, by observation; none if all are seen.
    pub positions: Option<Vec<Vec<usize>>>,
}

impl Seen {
    /// The number of tokens seen of each of these observations.
    pub(crate) fn counts(&self, observations: Range<usize>, num_vl_tokens: usize) -> Vec<usize> {
        match &self.positions {
            None => vec![num_vl_tokens; observations.len()],
            Some(positions) => positions[observations].iter().map(Vec::len).collect(),
        }
    }

    /// The rows that are seen of these observations, whose tokens are `vl`, one observation after the other;
    /// `gathered` is memory for them.
    pub(crate) fn rows<'a>(
        &self,
        observations: Range<usize>,
        vl: Rows<'a>,
        gathered: &'a mut Scratch,
    ) -> Result<Rows<'a>> {
        let Some(positions) = &self.positions else {
            return Ok(vl);
        };
        let positions = &positions[observations];
        let num_vl_tokens = vl.num_rows() / positions.len();
        let count = positions.iter().map(Vec::len).sum();
        let mut rows = gathered.rows(count, vl.num_columns())?;
        let tokens = positions.iter().enumerate().flat_map(|(observation, positions)| {
            let first = observation * num_vl_tokens;
            positions.iter().map(move |position| first + position)
        });
        for (row, token) in rows.iter_mut().zip(tokens) {
            row.copy_from_slice(vl.row(token));
        }
        Ok(gathered.as_rows())
    }

    fn nbytes(&self) -> usize {
        let positions = self.positions.iter().flatten();
        positions.map(|positions| size_of_val(positions.as_slice())).sum()
    }
}
