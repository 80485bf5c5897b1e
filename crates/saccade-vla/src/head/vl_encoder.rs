//! The vision-language tokens (spec 1.5): `vlln`, the VL self-attention, and what the cross-attention blocks make of the result.

use std::ops::Range;

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch, PackedKeyValues};

use super::context::Seen;
use crate::alloc::{collected, filled, sized};
use crate::config::{HeadConfig, Reads};
use crate::engine::Engine;
use crate::error::Result;
use crate::inspect::trace::{Keep, Recorded, Shapes};
use crate::nn::attention::{Attention, AttentionBuffers, Bias, SelfKeys};
use crate::nn::feed_forward::{DIFFUSERS, FeedForward};
use crate::nn::norm::LayerNorm;
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;
use crate::precision::Role;
use crate::profile::Part;

/// Rows of vision-language tokens that are encoded together. More rows read the weights less often; fewer keep the intermediate
/// activations small. At 1024 rows the weights are read once per 3 to 4 camera views and the largest buffer is 32 MB at N1.5's size.
const ENCODE_ROWS: usize = 1024;

const EPS: f32 = 1e-5;

/// As much as a trace holds by default: the probabilities of N1.5's four blocks over three cameras for six observations.
const MAX_RECORDED_BYTES: u64 = 1 << 31;

/// `vlln` and the blocks of the VL self-attention.
pub(crate) struct VlEncoder {
    vlln: Option<LayerNorm>,
    blocks: Vec<VlBlock>,
    context_dim: usize,
    num_heads: usize,
}

/// `vl += attention(norm1(vl)); vl += ff(norm3(vl))`.
struct VlBlock {
    norm1: LayerNorm,
    attention: Attention,
    norm3: LayerNorm,
    feed_forward: FeedForward,
}

/// What is encoded, and for whom.
pub(crate) struct VlTokens<'a> {
    /// `(batch, num_vl_tokens, context_dim)`.
    pub features: &'a [f32],
    pub num_vl_tokens: usize,
    /// What is added to the logits of each token in the VL self-attention, `(batch, num_vl_tokens)`: minus infinity removes it.
    pub removed: Option<&'a [f32]>,
    /// What each kind of cross-attention block sees.
    pub seen: &'a [Seen],
    /// For each block of the transformer that attends to these tokens: its attention and which of the tokens it sees.
    pub cross: &'a [Option<(Reads, &'a Attention)>],
}

/// The tokens as the cross-attention blocks see them, `(batch, num_vl_tokens, context_dim)`, and by block their keys and values.
pub(crate) type Encoded = (Vec<f32>, Vec<Vec<PackedKeyValues>>);

/// Memory of one `encode` that is kept for the next.
pub(crate) struct EncodeBuffers {
    y: Activations,
    gathered: Activations,
    hidden: Activations,
    attention: AttentionBuffers,
}

impl EncodeBuffers {
    pub(crate) fn new() -> Self {
        Self {
            y: Activations::new(),
            gathered: Activations::new(),
            hidden: Activations::new(),
            attention: AttentionBuffers::new(),
        }
    }
}

impl VlBlock {
    fn new(weights: &Weights<'_>, config: &HeadConfig) -> Result<Self> {
        let (width, heads) = (config.context_dim, config.vl_num_heads);
        Ok(Self {
            norm1: LayerNorm::new(&weights.at("norm1"), width, EPS)?,
            attention: Attention::new(&weights.at("attn1"), width, width, heads, Part::ToKv)?,
            norm3: LayerNorm::new(&weights.at("norm3"), width, EPS)?,
            feed_forward: FeedForward::new(
                &weights.at("ff"),
                DIFFUSERS,
                [width, 4 * width],
                Epilogue::GeluTanh,
                Role::Block,
            )?,
        })
    }
}

impl VlEncoder {
    /// From `vlln` and `vl_self_attention`.
    pub(crate) fn new(weights: &Weights<'_>, config: &HeadConfig) -> Result<Self> {
        let vlln = match config.use_vlln {
            true => Some(LayerNorm::new(&weights.at("vlln"), config.context_dim, EPS)?),
            false => None,
        };
        let blocks = weights.at("vl_self_attention.transformer_blocks");
        Ok(Self {
            vlln,
            blocks: (0..config.vl_num_layers)
                .map(|index| VlBlock::new(&blocks.at(index), config))
                .collect::<Result<_>>()?,
            context_dim: config.context_dim,
            num_heads: config.vl_num_heads,
        })
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
        let blocks: Vec<_> = (0..self.blocks.len()).map(shapes).collect();
        Recorded::claim("record", record, &blocks, MAX_RECORDED_BYTES)
    }

    /// The tokens that the cross-attention blocks see, and their keys and values in each of these. What `recorded` has room for is kept.
    pub(crate) fn encode(
        &self,
        engine: Engine,
        tokens: &VlTokens<'_>,
        recorded: &mut Recorded<usize>,
        buffers: &mut EncodeBuffers,
    ) -> Result<Encoded> {
        let VlTokens {
            features,
            num_vl_tokens,
            ..
        } = *tokens;
        let mut vl_embs = filled("vl_embs", features.len(), 0.0)?;
        let batch = features.len() / (num_vl_tokens * self.context_dim);
        let mut keys_values = Vec::new();
        for block in tokens.cross {
            let held = if block.is_some() { batch } else { 0 };
            keys_values.push(collected("keys and values", held, [])?);
        }
        let together = (ENCODE_ROWS / num_vl_tokens).max(1); // observations
        let chunk = together * num_vl_tokens * self.context_dim;
        for (index, vl) in vl_embs.chunks_mut(chunk).enumerate() {
            let first = index * together;
            let elements = first..first + vl.len() / (num_vl_tokens * self.context_dim);
            self.tokens(engine, tokens, elements.clone(), recorded, buffers, vl)?;
            self.project(engine, tokens, elements, vl, &mut keys_values, buffers)?;
        }
        if let Some(removed) = tokens.removed {
            for (row, &removed) in vl_embs.chunks_exact_mut(self.context_dim).zip(removed) {
                if removed != 0.0 {
                    row.fill(0.0);
                }
            }
        }
        Ok((vl_embs, keys_values))
    }

    /// Adds the keys and values of `elements`, whose tokens are `vl`, to those of each block.
    fn project(
        &self,
        engine: Engine,
        tokens: &VlTokens<'_>,
        elements: Range<usize>,
        vl: &[f32],
        keys_values: &mut [Vec<PackedKeyValues>],
        buffers: &mut EncodeBuffers,
    ) -> Result<()> {
        let EncodeBuffers {
            gathered,
            hidden,
            attention: AttentionBuffers { linear, .. },
            ..
        } = buffers;
        for seen in tokens.seen {
            let counts = seen.counts(elements.clone(), tokens.num_vl_tokens);
            let rows = seen.rows(elements.clone(), vl, self.context_dim, gathered)?;
            for (block, keys_values) in tokens.cross.iter().zip(&mut *keys_values) {
                if let Some((reads, attention)) = block
                    && *reads == seen.reads
                {
                    keys_values.extend(attention.project(engine, rows, &counts, hidden, linear)?);
                }
            }
        }
        Ok(())
    }

    /// The tokens of the observations `elements`, to `vl`.
    fn tokens(
        &self,
        engine: Engine,
        tokens: &VlTokens<'_>,
        elements: Range<usize>,
        recorded: &mut Recorded<usize>,
        buffers: &mut EncodeBuffers,
        vl: &mut [f32],
    ) -> Result<()> {
        let num_vl_tokens = tokens.num_vl_tokens;
        // The part of `(batch, ...)` that belongs to the elements.
        let part = |size: usize| elements.start * size..elements.end * size;
        let features = &tokens.features[part(num_vl_tokens * self.context_dim)];
        let bias = Bias {
            keys: tokens.removed.map(|removed| &removed[part(num_vl_tokens)]),
            shared: None,
        };
        match &self.vlln {
            Some(vlln) => vlln.apply(engine, features, vl)?,
            None => vl.copy_from_slice(features),
        }
        for (index, block) in self.blocks.iter().enumerate() {
            check_interrupted()?;
            let EncodeBuffers {
                y, hidden, attention, ..
            } = &mut *buffers;
            let y = sized(y, vl.len())?;
            block.norm1.apply(engine, vl, y)?;
            let weights = recorded
                .attention(index)
                .map(|all| &mut all[part(self.num_heads * num_vl_tokens * num_vl_tokens)]);
            let keys = SelfKeys {
                source: y,
                sequences: elements.len(),
                held: None,
                bias,
            };
            block.attention.mix_self(engine, y, keys, weights, attention)?;
            block.attention.out(engine, Epilogue::Add, attention, vl)?;
            block.norm3.apply(engine, vl, y)?;
            let scratch: &mut LinearScratch = &mut attention.linear;
            block.feed_forward.add(engine, y, hidden, scratch, vl)?;
            if let Some(kept) = recorded.hidden(index) {
                kept[part(num_vl_tokens * self.context_dim)].copy_from_slice(vl);
            }
        }
        Ok(())
    }
}
