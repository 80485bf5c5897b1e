//! The vision-language tokens: `vlln`, the VL self-attention, and the KV caches of the cross-attention
//! blocks.
//!
//! Equation 8 of docs/equations.md.

use std::ops::Range;

use saccade_vla_kernels::{Epilogue, PackedKeyValues, Rows, RowsMut};

use super::context::Seen;
use crate::alloc::{Scratch, filled, reserved};
use crate::config::{HeadConfig, Reads};
use crate::engine::Kernels;
use crate::error::Result;
use crate::inspect::trace::{Keep, Recorded, Shapes};
use crate::nn::attention::{Attention, AttentionWorkspace, Bias, SelfKeys};
use crate::nn::feed_forward::{DIFFUSERS, FeedForward};
use crate::nn::norm::LayerNorm;
use crate::nn::sequences::Sequences;
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;
use crate::precision::Role;
use crate::profile::Part;

/// Rows of vision-language tokens that are encoded together. More rows read the weights less often; fewer
/// keep the intermediate activations small. At 1024 rows the weights are read once per 3 to 4 camera views
/// and the largest buffer is 32 MB at N1.5's size.
const ENCODE_ROWS: usize = 1024;

const EPS: f32 = 1e-5;

/// As much as a trace holds by default: the probabilities of N1.5's four blocks over three cameras for six
/// observations.
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

/// The tokens to encode, and the readers of the result.
pub(crate) struct VlTokens<'a> {
    /// `(batch * num_vl_tokens, context_dim)`.
    pub features: Rows<'a>,
    pub batch: usize,
    pub num_vl_tokens: usize,
    /// Biases of the logits of each token in the VL self-attention, `(batch, num_vl_tokens)`: minus infinity
    /// removes it.
    pub removed: Option<&'a [f32]>,
    /// The tokens that each kind of cross-attention block sees.
    pub seen: &'a [Seen],
    /// For each block of the transformer that attends to these tokens: its attention and the tokens it sees.
    pub cross: &'a [Option<(Reads, &'a Attention)>],
}

/// The tokens as the cross-attention blocks see them, `(batch, num_vl_tokens, context_dim)`, and by block
/// their KV caches.
pub(crate) type Encoded = (Vec<f32>, Vec<Vec<PackedKeyValues>>);

/// Memory kept between calls.
#[derive(Default)]
pub(crate) struct VlWorkspace {
    y: Scratch,
    gathered: Scratch,
    hidden: Scratch,
    attention: AttentionWorkspace,
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
        Recorded::allocate("record", record, &blocks, MAX_RECORDED_BYTES)
    }

    /// The tokens that the cross-attention blocks see, and their KV caches. Records what `recorded` has room
    /// for.
    pub(crate) fn encode(
        &self,
        kernels: &mut Kernels<'_>,
        tokens: &VlTokens<'_>,
        recorded: &mut Recorded<usize>,
        workspace: &mut VlWorkspace,
    ) -> Result<Encoded> {
        let (batch, num_vl_tokens) = (tokens.batch, tokens.num_vl_tokens);
        let len = batch * num_vl_tokens * self.context_dim;
        let mut vl_embs = filled("vl_embs", len, 0.0)?;
        let mut vl = RowsMut::new(&mut vl_embs, self.context_dim);
        let mut caches = Vec::new();
        for block in tokens.cross {
            let held = if block.is_some() { batch } else { 0 };
            caches.push(reserved("keys and values", held)?);
        }
        let together = (ENCODE_ROWS / num_vl_tokens).max(1);
        for first in (0..batch).step_by(together) {
            let observations = first..batch.min(first + together);
            let rows = observations.start * num_vl_tokens..observations.end * num_vl_tokens;
            let mut vl = vl.reborrow().rows(rows);
            self.tokens(
                kernels,
                tokens,
                observations.clone(),
                recorded,
                workspace,
                vl.reborrow(),
            )?;
            self.project(
                kernels,
                tokens,
                observations,
                vl.as_rows(),
                &mut caches,
                workspace,
            )?;
        }
        if let Some(removed) = tokens.removed {
            for (row, &removed) in vl.iter_mut().zip(removed) {
                if removed != 0.0 {
                    row.fill(0.0);
                }
            }
        }
        Ok((vl_embs, caches))
    }

    /// Adds the KV caches of `observations`, whose tokens are `vl`, to those of each block.
    fn project(
        &self,
        kernels: &mut Kernels<'_>,
        tokens: &VlTokens<'_>,
        observations: Range<usize>,
        vl: Rows<'_>,
        caches: &mut [Vec<PackedKeyValues>],
        workspace: &mut VlWorkspace,
    ) -> Result<()> {
        for seen in tokens.seen {
            let counts = seen.counts(observations.clone(), tokens.num_vl_tokens);
            let rows = seen.rows(observations.clone(), vl, &mut workspace.gathered)?;
            for (block, caches) in tokens.cross.iter().zip(&mut *caches) {
                if let Some((reads, attention)) = block
                    && *reads == seen.reads
                {
                    caches.extend(attention.project(kernels, rows, &counts, &mut workspace.hidden)?);
                }
            }
        }
        Ok(())
    }

    /// The tokens of `observations`, to `vl`.
    fn tokens(
        &self,
        kernels: &mut Kernels<'_>,
        tokens: &VlTokens<'_>,
        observations: Range<usize>,
        recorded: &mut Recorded<usize>,
        workspace: &mut VlWorkspace,
        mut vl: RowsMut<'_>,
    ) -> Result<()> {
        let num_vl_tokens = tokens.num_vl_tokens;
        // The part of `(batch, ...)` that belongs to the observations.
        let part = |size: usize| observations.start * size..observations.end * size;
        let features = tokens.features.rows(part(num_vl_tokens));
        let bias = tokens
            .removed
            .map_or(Bias::None, |removed| Bias::Keys(&removed[part(num_vl_tokens)]));
        match &self.vlln {
            Some(vlln) => vlln.apply(kernels.engine, features, vl.reborrow())?,
            None => vl.copy_from(features),
        }
        for (index, block) in self.blocks.iter().enumerate() {
            check_interrupted()?;
            let mut y = workspace.y.rows(vl.num_rows(), vl.num_columns())?;
            block.norm1.apply(kernels.engine, vl.as_rows(), y.reborrow())?;
            let sequences = Sequences::new(y.as_rows(), observations.len());
            let keys = SelfKeys {
                source: sequences,
                held: None,
                bias,
                probabilities: recorded
                    .attention(index)
                    .map(|all| &mut all[part(self.num_heads * num_vl_tokens * num_vl_tokens)]),
            };
            block
                .attention
                .add_self(kernels, sequences, keys, &mut workspace.attention, vl.reborrow())?;
            block.norm3.apply(kernels.engine, vl.as_rows(), y.reborrow())?;
            block
                .feed_forward
                .add(kernels, y.as_rows(), &mut workspace.hidden, vl.reborrow())?;
            if let Some(recorded) = recorded.hidden(index) {
                let recorded = RowsMut::new(recorded, self.context_dim);
                recorded.rows(part(num_vl_tokens)).copy_from(vl.as_rows());
            }
        }
        Ok(())
    }
}
