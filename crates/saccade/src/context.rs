//! What is computed once per observation and held: the vision-language tokens, and the keys and values of every cross-attention block.

use std::ops::Range;

use saccade_kernels::PackedKeyValues;

use crate::attention::{Attention, AttentionBuffers, Bias, FeedForward};
use crate::config::{HeadConfig, Reads};
use crate::error::Result;
use crate::layers::{Engine, Norm, TensorSource, sized};
use crate::layout::{HeadNames, VlBlockNames};
use crate::trace::{Keep, Recorded, Shapes};

/// Rows of vision-language tokens that are encoded together. More rows read the weights less often; fewer keep the intermediate
/// activations small. At 1024 rows the weights are read once per 3 to 4 camera views and the largest buffer is 32 MB at N1.5's size.
const ENCODE_ROWS: usize = 1024;

/// An encoded observation. Immutable; serves any number of calls and threads.
pub struct Context {
    pub(crate) head: u64,
    pub(crate) batch: usize,
    pub(crate) num_vl_tokens: usize,
    pub(crate) vl_embs: Vec<f32>,
    /// By block, empty for self-attention; within it by batch element. Of the positions that are seen there only.
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

    /// Vision-language tokens of each, removed ones counted.
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
    fn counts(&self, elements: Range<usize>, num_vl_tokens: usize) -> Vec<usize> {
        match &self.positions {
            None => vec![num_vl_tokens; elements.len()],
            Some(positions) => positions[elements].iter().map(Vec::len).collect(),
        }
    }

    /// The rows of these batch elements that are seen, one element's after the other's; `gathered` is memory for them.
    fn rows<'a>(
        &self,
        elements: Range<usize>,
        vl: &'a [f32],
        context_dim: usize,
        gathered: &'a mut Vec<f32>,
    ) -> &'a [f32] {
        let Some(positions) = &self.positions else {
            return vl;
        };
        gathered.clear();
        let element = vl.len() / elements.len();
        for (vl, positions) in vl.chunks_exact(element).zip(&positions[elements]) {
            for &position in positions {
                gathered.extend_from_slice(&vl[position * context_dim..][..context_dim]);
            }
        }
        gathered
    }

    fn nbytes(&self) -> usize {
        let positions = self.positions.iter().flatten();
        positions.map(|positions| size_of_val(positions.as_slice())).sum()
    }
}

/// The logit biases, 0 or minus infinity, that take these positions away.
pub(crate) fn removed_keys(removed: &[bool]) -> Vec<f32> {
    removed
        .iter()
        .map(|&removed| if removed { f32::NEG_INFINITY } else { 0.0 })
        .collect()
}

/// `vlln` and the VL self-attention (spec 1.5).
pub(crate) struct VlEncoder {
    vlln: Option<Norm>,
    blocks: Vec<VlBlock>,
    context_dim: usize,
    num_heads: usize,
}

struct VlBlock {
    norm1: Norm,
    attention: Attention,
    norm3: Norm,
    feed_forward: FeedForward,
}

/// Memory of one `encode` that is kept for the next.
pub(crate) struct EncodeBuffers {
    y: Vec<f32>,
    gathered: Vec<f32>,
    hidden: Vec<f32>,
    attention: AttentionBuffers,
}

impl EncodeBuffers {
    pub(crate) fn new() -> Self {
        Self {
            y: Vec::new(),
            gathered: Vec::new(),
            hidden: Vec::new(),
            attention: AttentionBuffers::new(),
        }
    }
}

const EPS: f32 = 1e-5;

/// As much as a trace holds by default: the probabilities of N1.5's four blocks over three cameras for six observations.
const MAX_RECORDED_BYTES: u64 = 1 << 31;

impl VlEncoder {
    pub(crate) fn load(
        tensors: &dyn TensorSource,
        engine: Engine,
        config: &HeadConfig,
        names: &HeadNames,
    ) -> Result<Self> {
        let block = |names: &VlBlockNames| {
            Ok(VlBlock {
                norm1: Norm::load(tensors, &names.norm1, EPS)?,
                attention: Attention::load(tensors, engine, &names.attention, config.vl_num_heads)?,
                norm3: Norm::load(tensors, &names.norm3, EPS)?,
                feed_forward: FeedForward::load(tensors, engine, &names.feed_forward)?,
            })
        };
        Ok(Self {
            vlln: names
                .vlln
                .as_ref()
                .map(|names| Norm::load(tensors, names, EPS))
                .transpose()?,
            blocks: names.vl_blocks.iter().map(block).collect::<Result<_>>()?,
            context_dim: config.context_dim,
            num_heads: config.vl_num_heads,
        })
    }

    pub(crate) fn nbytes(&self) -> usize {
        let block = |block: &VlBlock| {
            block.norm1.nbytes()
                + block.attention.nbytes()
                + block.norm3.nbytes()
                + block.feed_forward.nbytes()
        };
        self.vlln.as_ref().map_or(0, Norm::nbytes) + self.blocks.iter().map(block).sum::<usize>()
    }

    /// Memory for what is to be recorded of `batch` observations.
    pub(crate) fn recorded(
        &self,
        record: Keep,
        batch: usize,
        num_vl_tokens: usize,
    ) -> Result<Recorded<usize>> {
        let shapes = |block| {
            let attention = [batch, self.num_heads, num_vl_tokens, num_vl_tokens];
            let hidden = [batch, num_vl_tokens, self.context_dim];
            (block, Shapes { attention, hidden })
        };
        let places: Vec<_> = (0..self.blocks.len()).map(shapes).collect();
        Recorded::claim("record", record, &places, MAX_RECORDED_BYTES)
    }

    /// The tokens that the cross-attention blocks see, and their keys and values in each of `cross` blocks.
    ///
    /// `features` is `(batch, num_vl_tokens, context_dim)`, `removed` what is added to the logits of its tokens in the VL self-attention, `seen`
    /// has every kind of the blocks. What `recorded` has places for is kept.
    #[allow(clippy::too_many_arguments)] // An observation, what is wanted of it, and memory.
    pub(crate) fn encode(
        &self,
        engine: Engine,
        cross: &[Option<(Reads, &Attention)>],
        features: &[f32],
        num_vl_tokens: usize,
        removed: Option<&[f32]>,
        seen: &[Seen],
        recorded: &mut Recorded<usize>,
        buffers: &mut EncodeBuffers,
    ) -> (Vec<f32>, Vec<Vec<PackedKeyValues>>) {
        let mut vl_embs = vec![0.0; features.len()];
        let mut keys_values: Vec<Vec<_>> = cross.iter().map(|_| Vec::new()).collect();
        let together = (ENCODE_ROWS / num_vl_tokens).max(1); // batch elements
        let chunk = together * num_vl_tokens * self.context_dim;
        for (index, (features, vl)) in features.chunks(chunk).zip(vl_embs.chunks_mut(chunk)).enumerate() {
            let groups = features.len() / (num_vl_tokens * self.context_dim);
            let elements = index * together..index * together + groups;
            self.tokens(
                engine,
                features,
                num_vl_tokens,
                elements.clone(),
                removed,
                recorded,
                buffers,
                vl,
            );
            let EncodeBuffers {
                gathered,
                hidden,
                attention: AttentionBuffers { linear, .. },
                ..
            } = &mut *buffers;
            for seen in seen {
                let counts = seen.counts(elements.clone(), num_vl_tokens);
                let rows = seen.rows(elements.clone(), vl, self.context_dim, gathered);
                for (block, keys_values) in cross.iter().zip(&mut keys_values) {
                    if let Some((reads, attention)) = block
                        && *reads == seen.reads
                    {
                        keys_values.extend(attention.project(engine, rows, &counts, hidden, linear));
                    }
                }
            }
        }
        if let Some(removed) = removed {
            for (row, &bias) in vl_embs.chunks_exact_mut(self.context_dim).zip(removed) {
                if bias != 0.0 {
                    row.fill(0.0);
                }
            }
        }
        (vl_embs, keys_values)
    }

    /// The batch elements `elements`, whose features are given.
    #[allow(clippy::too_many_arguments)] // As above.
    fn tokens(
        &self,
        engine: Engine,
        features: &[f32],
        num_vl_tokens: usize,
        elements: Range<usize>,
        removed: Option<&[f32]>,
        recorded: &mut Recorded<usize>,
        buffers: &mut EncodeBuffers,
        vl: &mut [f32],
    ) {
        // The part of `(batch, ...)` that belongs to the elements.
        let part = |size: usize| elements.start * size..elements.end * size;
        let bias = Bias {
            keys: removed.map(|removed| &removed[part(num_vl_tokens)]),
            shared: None,
        };
        match &self.vlln {
            Some(vlln) => vlln.apply(engine, features, vl),
            None => vl.copy_from_slice(features),
        }
        for (index, block) in self.blocks.iter().enumerate() {
            let y = sized(&mut buffers.y, vl.len());
            block.norm1.apply(engine, vl, y);
            let weights = recorded
                .attention(index)
                .map(|all| &mut all[part(self.num_heads * num_vl_tokens * num_vl_tokens)]);
            let attention = &mut buffers.attention;
            block
                .attention
                .add_self(engine, y, y, elements.len(), None, bias, weights, attention, vl);
            block.norm3.apply(engine, vl, y);
            block
                .feed_forward
                .add(engine, y, &mut buffers.hidden, &mut buffers.attention.linear, vl);
            if let Some(kept) = recorded.hidden(index) {
                kept[part(num_vl_tokens * self.context_dim)].copy_from_slice(vl);
            }
        }
    }
}
