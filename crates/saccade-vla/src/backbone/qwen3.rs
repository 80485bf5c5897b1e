//! Qwen3, the language model: the layers that are kept, over the tokens of words and views.

use saccade_vla_kernels::{Epilogue, PackedKeyValues, Rows};

use super::config::LanguageConfig;
use crate::alloc::Scratch;
use crate::engine::{Engine, Kernels};
use crate::error::Result;
use crate::nn::feed_forward::FeedForward;
use crate::nn::grouped_attention::{
    Attended, Causal, GroupedAttention, GroupedSizes, GroupedWorkspace, Projections, Qkv,
};
use crate::nn::norm::RmsNorm;
use crate::nn::rope::Rope;
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;

const PROJECTIONS: Projections = Projections {
    qkv: Qkv::Separate(["q_proj", "k_proj", "v_proj"]),
    out: "o_proj",
    qkv_bias: false,
    out_bias: false,
};

/// The layers that are kept, and the norm of the features if they have one.
pub(super) struct Qwen3 {
    layers: Vec<Layer>,
    norm: Option<RmsNorm>,
}

/// `x += attention(norm(x)); x += mlp(norm(x))`.
struct Layer {
    input_layernorm: RmsNorm,
    attention: GroupedAttention,
    post_attention_layernorm: RmsNorm,
    mlp: FeedForward,
}

/// The rows of a prompt that are computed.
pub(super) struct NewRows<'a> {
    /// For each of them whether it may be attended to.
    pub attended: &'a [bool],
    /// By layer, the KV cache of earlier rows; keys and values of these rows are appended.
    pub caches: &'a mut [PackedKeyValues],
}

/// Rows that are added to the hidden state after a layer, each with the number of the row that it is added
/// to.
pub(super) type Additions<'a> = Vec<(usize, &'a [f32])>;

/// Memory kept between calls.
#[derive(Default)]
pub(super) struct LanguageWorkspace {
    /// The residual stream, `(rows, width)`.
    pub x: Scratch,
    pub y: Scratch,
    hidden: Scratch,
    attention: GroupedWorkspace,
}

impl Layer {
    fn new(weights: &Weights<'_>, config: &LanguageConfig) -> Result<Self> {
        let (width, eps) = (config.width, config.norm_eps as f32);
        let sizes = GroupedSizes {
            width,
            num_heads: config.num_heads,
            num_kv_heads: config.num_kv_heads,
            head_dim: config.head_dim,
        };
        let norm = |name: &str| RmsNorm::new(&weights.at(name), width, eps);
        Ok(Self {
            input_layernorm: norm("input_layernorm")?,
            attention: GroupedAttention::new(&weights.at("self_attn"), sizes, PROJECTIONS, Some(eps))?,
            post_attention_layernorm: norm("post_attention_layernorm")?,
            mlp: FeedForward::gated(&weights.at("mlp"), [width, config.hidden_dim], Epilogue::Silu)?,
        })
    }
}

impl Qwen3 {
    /// From `layers` and, if the features are normed, `norm`.
    pub(super) fn new(weights: &Weights<'_>, config: &LanguageConfig) -> Result<Self> {
        let layers = weights.at("layers");
        let layers: Result<_> = (0..config.num_layers)
            .map(|index| Layer::new(&layers.at(index), config))
            .collect();
        Ok(Self {
            layers: layers?,
            norm: match config.has_final_norm {
                true => Some(RmsNorm::new(
                    &weights.at("norm"),
                    config.width,
                    config.norm_eps as f32,
                )?),
                false => None,
            },
        })
    }

    /// Runs the layers over the rows of all prompts, which are in `workspace.x`. `deepstack` is added after
    /// the first layers; `record` is given the rows after each layer, before that.
    pub(super) fn run(
        &self,
        kernels: &mut Kernels<'_>,
        rope: &Rope,
        prompts: &mut [NewRows<'_>],
        deepstack: &[Additions<'_>],
        workspace: &mut LanguageWorkspace,
        mut record: impl FnMut(usize, Rows<'_>),
    ) -> Result<()> {
        let (hidden, attention) = (&mut workspace.hidden, &mut workspace.attention);
        let mut x = workspace.x.as_rows_mut();
        let mut y = workspace.y.rows(x.num_rows(), x.num_columns())?;
        for (index, layer) in self.layers.iter().enumerate() {
            check_interrupted()?;
            let (norm, mlp_norm) = (&layer.input_layernorm, &layer.post_attention_layernorm);
            norm.apply(kernels.engine, x.as_rows(), y.reborrow())?;
            let mut sequences: Vec<Causal<'_>> = prompts
                .iter_mut()
                .map(|prompt| Causal {
                    cache: &mut prompt.caches[index],
                    attended: prompt.attended,
                })
                .collect();
            let (attended, rope) = (Attended::Causal(&mut sequences), Some(rope));
            let normed = y.as_rows();
            layer
                .attention
                .add(kernels, normed, rope, attended, attention, x.reborrow())?;
            mlp_norm.apply(kernels.engine, x.as_rows(), y.reborrow())?;
            layer.mlp.add(kernels, y.as_rows(), hidden, x.reborrow())?;
            record(index, x.as_rows());
            for (row, added) in deepstack.get(index).into_iter().flatten() {
                let x = x.row_mut(*row).iter_mut().zip(*added);
                x.for_each(|(x, added)| *x += added);
            }
        }
        Ok(())
    }

    /// The rows `x` after the last norm, if there is one, in `y`.
    pub(super) fn finish<'a>(&self, engine: Engine, x: Rows<'a>, y: &'a mut Scratch) -> Result<Rows<'a>> {
        let Some(norm) = &self.norm else {
            return Ok(x);
        };
        norm.apply(engine, x, y.rows(x.num_rows(), x.num_columns())?)?;
        Ok(y.as_rows())
    }
}
