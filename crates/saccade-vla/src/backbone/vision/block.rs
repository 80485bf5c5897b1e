//! The blocks that both vision towers are made of: attention within a view, and a feed-forward layer.

use saccade_vla_kernels::{Epilogue, RowsMut};

use crate::alloc::Scratch;
use crate::backbone::config::VisionConfig;
use crate::engine::Kernels;
use crate::error::Result;
use crate::nn::feed_forward::FeedForward;
use crate::nn::grouped_attention::{Attended, GroupedAttention, GroupedSizes, GroupedWorkspace, Projections};
use crate::nn::norm::LayerNorm;
use crate::nn::rope::Rope;
use crate::nn::weights::Weights;
use crate::precision::Role;

/// The names of the parts of a block.
pub(super) struct BlockNames {
    pub norms: [&'static str; 2],
    pub attention: &'static str,
    pub projections: Projections,
    pub mlp: [&'static str; 2],
}

/// `x += attention(norm1(x)); x += mlp(norm2(x))`.
pub(super) struct VisionBlock {
    norm1: LayerNorm,
    attention: GroupedAttention,
    norm2: LayerNorm,
    mlp: FeedForward,
}

/// Memory kept between calls.
#[derive(Default)]
pub(super) struct BlockWorkspace {
    y: Scratch,
    hidden: Scratch,
    attention: GroupedWorkspace,
}

impl VisionBlock {
    /// The blocks below `weights`, by number.
    pub(super) fn all(weights: &Weights<'_>, config: &VisionConfig, names: &BlockNames) -> Result<Vec<Self>> {
        (0..config.num_layers)
            .map(|index| Self::new(&weights.at(index), config, names))
            .collect()
    }

    fn new(weights: &Weights<'_>, config: &VisionConfig, names: &BlockNames) -> Result<Self> {
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

    /// Runs the block over the patches of views, of which there are `views` in each.
    pub(super) fn run(
        &self,
        kernels: &mut Kernels<'_>,
        rope: Option<&Rope>,
        views: &[usize],
        workspace: &mut BlockWorkspace,
        mut x: RowsMut<'_>,
    ) -> Result<()> {
        let BlockWorkspace { y, hidden, attention } = workspace;
        let mut y = y.rows(x.num_rows(), x.num_columns())?;
        self.norm1.apply(kernels.engine, x.as_rows(), y.reborrow())?;
        let views = Attended::Whole(views);
        self.attention
            .add(kernels, y.as_rows(), rope, views, attention, x.reborrow())?;
        self.norm2.apply(kernels.engine, x.as_rows(), y.reborrow())?;
        self.mlp.add(kernels, y.as_rows(), hidden, x)
    }
}
