//! The blocks that both vision towers are made of: attention within a view, and a feed-forward layer.

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch};

use crate::alloc::sized;
use crate::backbone::config::VisionConfig;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::feed_forward::FeedForward;
use crate::nn::grouped_attention::{GroupedAttention, GroupedBuffers, GroupedSizes, Projections, Sequences};
use crate::nn::norm::LayerNorm;
use crate::nn::rope::Rotation;
use crate::nn::weights::Weights;
use crate::precision::Role;

/// What the parts of a block are called.
pub(crate) struct BlockNames {
    pub norms: [&'static str; 2],
    pub attention: &'static str,
    pub projections: Projections,
    pub mlp: [&'static str; 2],
}

/// `x += attention(norm1(x)); x += mlp(norm2(x))`.
pub(crate) struct VisionBlock {
    norm1: LayerNorm,
    attention: GroupedAttention,
    norm2: LayerNorm,
    mlp: FeedForward,
}

/// Memory of one call that is kept for the next.
#[derive(Default)]
pub(crate) struct BlockBuffers {
    pub y: Activations,
    pub hidden: Activations,
    pub attention: GroupedBuffers,
    pub linear: LinearScratch,
}

impl VisionBlock {
    pub(crate) fn new(weights: &Weights<'_>, config: &VisionConfig, names: &BlockNames) -> Result<Self> {
        let (width, eps) = (config.width, config.norm_eps as f32);
        let sizes = GroupedSizes {
            width,
            num_heads: config.num_heads,
            num_kv_heads: config.num_heads,
            head_dim: config.head_dim,
        };
        let [norm1, norm2] = names.norms;
        let attention = weights.at(names.attention);
        Ok(Self {
            norm1: LayerNorm::new(&weights.at(norm1), width, eps)?,
            attention: GroupedAttention::new(&attention, sizes, names.projections, None)?,
            norm2: LayerNorm::new(&weights.at(norm2), width, eps)?,
            mlp: FeedForward::new(
                &weights.at("mlp"),
                names.mlp,
                [width, config.hidden_dim],
                Epilogue::GeluTanh,
                Role::BackboneBlock,
            )?,
        })
    }

    /// Runs the block over the patches `x (patches, width)` of views, of which there are `views` in each.
    pub(crate) fn run(
        &self,
        engine: Engine,
        rotation: Option<&Rotation>,
        views: &[usize],
        buffers: &mut BlockBuffers,
        x: &mut [f32],
    ) -> Result<()> {
        let BlockBuffers {
            y,
            hidden,
            attention,
            linear,
        } = buffers;
        let y = sized(y, x.len())?;
        self.norm1.apply(engine, x, y)?;
        let memory = (attention, &mut *linear);
        self.attention
            .add(engine, y, rotation, Sequences::Whole(views), memory, x)?;
        self.norm2.apply(engine, x, y)?;
        self.mlp.add(engine, y, hidden, linear, x)
    }
}
