//! Self-attention of language and vision models: fewer heads of keys than of queries, norms of both, rotary positions, a causal mask.

use std::ops::Range;

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch, Mask, PackedKeyValues, Rows};

use super::linear::Linear;
use super::rms_norm::RmsNorm;
use super::rope::Rotation;
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

/// The projections of an attention: how a model names them, and which of them have a bias.
#[derive(Clone, Copy)]
pub(crate) struct Projections {
    pub qkv: Qkv,
    pub out: &'static str,
    pub qkv_bias: bool,
    pub out_bias: bool,
}

/// The names of what makes queries, keys and values.
#[derive(Clone, Copy)]
pub(crate) enum Qkv {
    Separate([&'static str; 3]),
    /// One tensor, queries first.
    Stacked(&'static str),
}

/// Which rows attend to which.
pub(crate) enum Sequences<'a, 'b> {
    /// Sequences of this many rows, one after the other: a row attends to all of its own sequence.
    Whole(&'a [usize]),
    /// Sequences one after the other: a row attends to itself and to the rows before it.
    Causal(&'a mut [Causal<'b>]),
}

/// A sequence whose keys and values outlive the call.
pub(crate) struct Causal<'a> {
    /// Those of earlier rows; those of the given rows are added, if they may be attended to.
    pub held: &'a mut PackedKeyValues,
    /// For each of the given rows whether rows may attend to it. A row that finds nothing to attend to gets zeros from the attention.
    pub attended: &'a [bool],
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
    qkv: Activations,
    mix: Activations,
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
        let parts = match projections.qkv {
            Qkv::Separate([q_proj, k_proj, v_proj]) => vec![
                (weights.at(q_proj), queries),
                (weights.at(k_proj), keys),
                (weights.at(v_proj), keys),
            ],
            Qkv::Stacked(qkv) => vec![(weights.at(qkv), queries + 2 * keys)],
        };
        let qkv = Linear::stacked(&parts, width, Role::BackboneBlock, projections.qkv_bias)?;
        let out = [(weights.at(projections.out), width)];
        let out = Linear::stacked(&out, queries, Role::BackboneBlock, projections.out_bias)?;
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

    /// `x += attention(y)` over the rows of all sequences, both `(rows, width)`.
    pub(crate) fn add(
        &self,
        engine: Engine,
        y: &[f32],
        rotation: Option<&Rotation>,
        sequences: Sequences<'_, '_>,
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
        let mix = sized(&mut buffers.mix, count * queries)?; // (rows, num_heads * head_dim)
        let mut attend = Attend {
            engine,
            queries: qkv.columns(0..queries),
            keys: qkv.columns(queries..queries + keys),
            values: qkv.columns(queries + keys..all),
            scale: 1.0 / (head_dim as f32).sqrt(),
            mix,
        };
        let mut first = 0;
        match sequences {
            Sequences::Whole(lens) => {
                let packed = buffers
                    .packed
                    .get_or_insert_with(|| no_keys_values(engine, num_kv_heads, head_dim));
                for len in lens {
                    attend.whole(first..first + len, packed)?;
                    first += len;
                }
            }
            Sequences::Causal(sequences) => {
                for sequence in sequences {
                    attend.causal(first, sequence)?;
                    first += sequence.attended.len();
                }
            }
        }
        self.out.apply(engine, mix, Epilogue::Add, x, scratch)
    }
}

/// Queries, keys and values of all rows, and the rows that the attention makes of them.
struct Attend<'a> {
    engine: Engine,
    queries: Rows<'a>,
    keys: Rows<'a>,
    values: Rows<'a>,
    scale: f32,
    mix: &'a mut [f32],
}

impl Attend<'_> {
    /// A sequence whose rows all attend to each other; `packed` is memory for it.
    fn whole(&mut self, rows: Range<usize>, packed: &mut PackedKeyValues) -> Result<()> {
        let (keys, values) = (self.keys.rows(rows.clone()), self.values.rows(rows.clone()));
        ops::pack(self.engine.threads, packed, 0, keys, values)?;
        self.attend(rows, packed, Mask::None)
    }

    /// A causal sequence, whose rows begin with number `first`: run by run of rows that may be attended to, or may not.
    fn causal(&mut self, first: usize, Causal { held, attended }: &mut Causal<'_>) -> Result<()> {
        let mut start = 0;
        for run in attended.chunk_by(|a, b| a == b) {
            let rows = first + start..first + start + run.len();
            start += run.len();
            let before = held.len();
            if run[0] {
                let (keys, values) = (self.keys.rows(rows.clone()), self.values.rows(rows.clone()));
                ops::append(self.engine.threads, held, keys, values)?;
                self.attend(rows, held, Mask::Causal { offset: before })?;
            } else if before == 0 {
                let width = self.queries.num_columns();
                self.mix[rows.start * width..rows.end * width].fill(0.0);
            } else {
                // All of them see the same keys.
                self.attend(rows, held, Mask::Causal { offset: before })?;
            }
        }
        Ok(())
    }

    fn attend(&mut self, range: Range<usize>, kv: &PackedKeyValues, mask: Mask<'_>) -> Result<()> {
        let width = self.queries.num_columns();
        let mixed = rows_mut(&mut self.mix[range.start * width..range.end * width], width);
        let queries = self.queries.rows(range);
        ops::attention(self.engine.threads, queries, kv, self.scale, mask, None, mixed)
    }
}
