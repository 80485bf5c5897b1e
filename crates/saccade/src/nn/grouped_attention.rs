//! Self-attention of language and vision models: fewer heads of keys than of queries, norms of both, rotary positions, a causal mask.

use saccade_kernels::{Epilogue, LinearScratch, Mask, PackedKeyValues};

use super::linear::Linear;
use super::rms_norm::RmsNorm;
use super::rotary::Rotation;
use super::weights::Weights;
use crate::alloc::sized;
use crate::engine::Engine;
use crate::error::Result;
use crate::ops::{self, no_keys_values, rows, rows_mut};
use crate::precision::Role;
use crate::profile::Part;

/// The sizes of an attention whose keys and values are shared by groups of heads of queries.
#[derive(Clone, Copy)]
pub(crate) struct GroupedSizes {
    pub width: usize,
    pub num_heads: usize,
    /// A divisor of `num_heads`.
    pub num_kv_heads: usize,
    pub head_dim: usize,
}

/// The four projections of an attention: how a model names them, and which of them have a bias.
#[derive(Clone, Copy)]
pub(crate) struct Projections {
    /// Of queries, keys, values and the output.
    pub names: [&'static str; 4],
    pub qkv_bias: bool,
    pub out_bias: bool,
}

/// `o_proj(softmax(q k^T / sqrt(head_dim)) v)` with `q = rotate(norm(q_proj y))`, `k = rotate(norm(k_proj y))` and `v = v_proj y`.
pub(crate) struct GroupedAttention {
    qkv: Linear,
    out: Linear,
    /// The norms of each head of the queries and of the keys, if the model has them.
    norms: Option<[RmsNorm; 2]>,
    sizes: GroupedSizes,
}

/// Memory of one call that is kept for the next.
#[derive(Default)]
pub(crate) struct GroupedBuffers {
    qkv: Vec<f32>,
    mix: Vec<f32>,
    packed: Option<PackedKeyValues>,
}

impl GroupedAttention {
    /// From the projections, and with `norm_eps` `q_norm` and `k_norm`, as Qwen names them.
    pub(crate) fn new(
        weights: &Weights<'_>,
        sizes: GroupedSizes,
        projections: Projections,
        norm_eps: Option<f32>,
    ) -> Result<Self> {
        let GroupedSizes {
            width,
            num_heads,
            num_kv_heads,
            head_dim,
        } = sizes;
        let (queries, keys) = (num_heads * head_dim, num_kv_heads * head_dim);
        let [q_proj, k_proj, v_proj, o_proj] = projections.names;
        let parts = [(q_proj, queries), (k_proj, keys), (v_proj, keys)];
        let parts = parts.map(|(name, outputs)| (weights.at(name), outputs));
        let qkv = Linear::stacked(&parts, width, Role::Block, projections.qkv_bias)?;
        let out = [(weights.at(o_proj), width)];
        let out = Linear::stacked(&out, queries, Role::Block, projections.out_bias)?;
        let norms = match norm_eps {
            Some(eps) => Some([
                RmsNorm::new(&weights.at("q_norm"), head_dim, eps)?,
                RmsNorm::new(&weights.at("k_norm"), head_dim, eps)?,
            ]),
            None => None,
        };
        Ok(Self {
            qkv: qkv.counted(Part::ToQ),
            out: out.counted(Part::ToOut),
            norms,
            sizes,
        })
    }

    /// `x += attention(y)` over the rows of one sequence, both `(rows, width)`.
    pub(crate) fn add(
        &self,
        engine: Engine,
        y: &[f32],
        rotation: Option<&Rotation>,
        mask: Mask<'_>,
        (buffers, scratch): (&mut GroupedBuffers, &mut LinearScratch),
        x: &mut [f32],
    ) -> Result<()> {
        let GroupedSizes {
            width,
            num_heads,
            num_kv_heads,
            head_dim,
        } = self.sizes;
        let (queries, keys) = (num_heads * head_dim, num_kv_heads * head_dim);
        let (count, all) = (y.len() / width, queries + 2 * keys);
        let qkv = sized(&mut buffers.qkv, count * all)?; // (rows, queries | keys | values)
        self.qkv.apply(engine, y, Epilogue::Store, qkv, scratch)?;
        for (index, columns) in [0..queries, queries..queries + keys].into_iter().enumerate() {
            if let Some(norms) = &self.norms {
                norms[index].apply_to_heads(engine, rows_mut(qkv, all).columns(columns.clone()))?;
            }
            if let Some(rotation) = rotation {
                rotation.apply(engine, rows_mut(qkv, all).columns(columns))?;
            }
        }
        let qkv = rows(qkv, all);
        let packed = buffers
            .packed
            .get_or_insert_with(|| no_keys_values(engine, num_kv_heads, head_dim));
        let (k, v) = (
            qkv.columns(queries..queries + keys),
            qkv.columns(queries + keys..all),
        );
        ops::pack(engine.threads, packed, 0, k, v)?;
        let mix = sized(&mut buffers.mix, count * queries)?; // (rows, num_heads * head_dim)
        let scale = 1.0 / (head_dim as f32).sqrt();
        let (q, mixed) = (qkv.columns(0..queries), rows_mut(mix, queries));
        ops::attention(engine.threads, q, packed, scale, mask, None, mixed)?;
        self.out.apply(engine, mix, Epilogue::Add, x, scratch)
    }
}
