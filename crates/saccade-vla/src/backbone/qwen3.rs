//! Qwen3, the language model: the layers that are kept, over the tokens of words and views.

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch, PackedKeyValues};

use super::config::LanguageConfig;
use crate::alloc::sized;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::gated_mlp::GatedMlp;
use crate::nn::grouped_attention::{
    Causal, GroupedAttention, GroupedBuffers, GroupedSizes, Projections, Qkv, Sequences,
};
use crate::nn::rms_norm::RmsNorm;
use crate::nn::rope::Rotation;
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
    mlp: GatedMlp,
}

/// The rows of a prompt that are computed.
pub(super) struct NewRows<'a> {
    /// For each of them whether it may be attended to.
    pub attended: &'a [bool],
    /// By layer, the keys and values of earlier rows; those of these rows are added.
    pub keys_values: &'a mut [PackedKeyValues],
}

/// Rows that are added to the hidden state after a layer: first row, and the rows.
pub(super) type Additions<'a> = Vec<(usize, &'a [f32])>;

/// Memory of one call that is kept for the next.
#[derive(Default)]
pub(super) struct LanguageBuffers {
    pub x: Activations,
    pub y: Activations,
    hidden: Activations,
    attention: GroupedBuffers,
    pub linear: LinearScratch,
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
        let mlp = weights.at("mlp");
        Ok(Self {
            input_layernorm: norm("input_layernorm")?,
            attention: GroupedAttention::new(&weights.at("self_attn"), sizes, PROJECTIONS, Some(eps))?,
            post_attention_layernorm: norm("post_attention_layernorm")?,
            mlp: GatedMlp::new(&mlp, width, config.hidden_dim, Epilogue::Silu, false)?,
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

    /// Runs the layers over the rows of all prompts, which are in `buffers.x (rows, width)`. `deepstack` is what is added after the first
    /// layers; `keep` is given the rows after each layer, before that.
    pub(super) fn run(
        &self,
        engine: Engine,
        rotation: &Rotation,
        prompts: &mut [NewRows<'_>],
        deepstack: &[Additions<'_>],
        buffers: &mut LanguageBuffers,
        mut keep: impl FnMut(usize, &[f32]) -> Result<()>,
    ) -> Result<()> {
        let LanguageBuffers {
            x,
            y,
            hidden,
            attention,
            linear,
        } = buffers;
        let y = sized(y, x.len())?;
        for (index, layer) in self.layers.iter().enumerate() {
            check_interrupted()?;
            layer.input_layernorm.apply(engine, x, y)?;
            let mut sequences: Vec<Causal<'_>> = prompts
                .iter_mut()
                .map(|prompt| Causal {
                    held: &mut prompt.keys_values[index],
                    attended: prompt.attended,
                })
                .collect();
            let memory = (&mut *attention, &mut *linear);
            let sequences = Sequences::Causal(&mut sequences);
            layer
                .attention
                .add(engine, y, Some(rotation), sequences, memory, x)?;
            layer.post_attention_layernorm.apply(engine, x, y)?;
            layer.mlp.add(engine, y, hidden, linear, x)?;
            keep(index, x)?;
            for (first, rows) in deepstack.get(index).into_iter().flatten() {
                let to = &mut x[*first..first + rows.len()];
                to.iter_mut().zip(*rows).for_each(|(to, row)| *to += row);
            }
        }
        Ok(())
    }

    /// The rows `x` after the last norm, if there is one, in `y`.
    pub(super) fn finish<'a>(
        &self,
        engine: Engine,
        x: &'a [f32],
        y: &'a mut Activations,
    ) -> Result<&'a [f32]> {
        let Some(norm) = &self.norm else {
            return Ok(x);
        };
        let y = sized(y, x.len())?;
        norm.apply(engine, x, y)?;
        Ok(y)
    }
}
