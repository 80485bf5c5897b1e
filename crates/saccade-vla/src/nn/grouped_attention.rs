//! Self-attention of language and vision models: heads of queries that share heads of keys, norms of both,
//! rotary positions, a causal mask.
//!
//! Equation 28 of docs/equations.md.

use std::ops::Range;

use saccade_vla_kernels::{Epilogue, Mask, PackedKeyValues, Rows, RowsMut};

use super::kv_cache;
use super::linear::Linear;
use super::norm::RmsNorm;
use super::rope::Rope;
use super::weights::Weights;
use crate::alloc::Scratch;
use crate::engine::{Engine, Kernels};
use crate::error::Result;
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

/// The names of the projections to queries, keys and values.
#[derive(Clone, Copy)]
pub(crate) enum Qkv {
    Separate([&'static str; 3]),
    /// One tensor, queries first.
    Stacked(&'static str),
}

/// The rows that a row attends to.
pub(crate) enum Attended<'a, 'b> {
    /// Those of its own sequence: sequences of this many rows, one after the other.
    Whole(&'a [usize]),
    /// Itself and those before it in its sequence: sequences one after the other.
    Causal(&'a mut [Causal<'b>]),
}

/// A sequence whose KV cache outlives the call.
pub(crate) struct Causal<'a> {
    /// Holds keys and values of earlier rows; those of the given rows are appended, if they may be attended
    /// to.
    pub cache: &'a mut PackedKeyValues,
    /// For each of the given rows whether rows may attend to it. A row that finds nothing to attend to gets
    /// zeros from the attention.
    pub attended: &'a [bool],
}

/// `o_proj(softmax(q k^T / sqrt(head_dim)) v)` with `q = rope(norm(q_proj y))`, `k = rope(norm(k_proj y))`
/// and `v = v_proj y`.
pub(crate) struct GroupedAttention {
    qkv: Linear,
    out: Linear,
    /// The norms of each head of the queries and of the keys, if the model has them.
    norms: Option<[RmsNorm; 2]>,
    sizes: GroupedSizes,
}

/// Memory kept between calls.
#[derive(Default)]
pub(crate) struct GroupedWorkspace {
    /// Queries, keys and values side by side.
    qkv: Scratch,
    mixed: Scratch,
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
        let [queries, keys, _] = sizes.columns().map(|columns| columns.len());
        let parts = match projections.qkv {
            Qkv::Separate([q_proj, k_proj, v_proj]) => vec![
                (weights.at(q_proj), queries),
                (weights.at(k_proj), keys),
                (weights.at(v_proj), keys),
            ],
            Qkv::Stacked(qkv) => vec![(weights.at(qkv), queries + 2 * keys)],
        };
        let qkv = Linear::stacked(&parts, sizes.width, Role::BackboneBlock, projections.qkv_bias)?;
        let out = [(weights.at(projections.out), sizes.width)];
        let out = Linear::stacked(&out, queries, Role::BackboneBlock, projections.out_bias)?;
        let norm = |name, eps| RmsNorm::new(&weights.at(name), sizes.head_dim, eps);
        let norms = match norm_eps {
            Some(eps) => Some([norm("q_norm", eps)?, norm("k_norm", eps)?]),
            None => None,
        };
        Ok(Self {
            qkv: qkv.counted(Part::ToQ),
            out: out.counted(Part::ToOut),
            norms,
            sizes,
        })
    }

    /// `x += attention(y)` over the rows of all sequences.
    pub(crate) fn add(
        &self,
        kernels: &mut Kernels<'_>,
        y: Rows<'_>,
        rope: Option<&Rope>,
        attended: Attended<'_, '_>,
        workspace: &mut GroupedWorkspace,
        x: RowsMut<'_>,
    ) -> Result<()> {
        let engine = kernels.engine;
        let [queries, keys, values] = self.sizes.columns();
        let mut qkv = workspace.qkv.rows(y.num_rows(), values.end)?;
        self.qkv.apply(kernels, y, Epilogue::Store, qkv.reborrow())?;
        for (index, columns) in [&queries, &keys].into_iter().enumerate() {
            let mut heads = qkv.reborrow().columns(columns.clone());
            if let Some(norms) = &self.norms {
                norms[index].apply_to_heads(engine, heads.reborrow())?;
            }
            if let Some(rope) = rope {
                rope.apply(engine, heads)?;
            }
        }
        let qkv = qkv.as_rows();
        let mut attend = Attend {
            engine,
            mixed: workspace.mixed.rows(y.num_rows(), queries.len())?,
            queries: qkv.columns(queries),
            keys: qkv.columns(keys),
            values: qkv.columns(values),
        };
        let mut first = 0;
        match attended {
            Attended::Whole(lens) => {
                let empty = || kv_cache::empty(engine, self.sizes.num_kv_heads, self.sizes.head_dim);
                let packed = workspace.packed.get_or_insert_with(empty);
                for len in lens {
                    attend.whole(first..first + len, packed)?;
                    first += len;
                }
            }
            Attended::Causal(sequences) => {
                for sequence in sequences {
                    attend.causal(first, sequence)?;
                    first += sequence.attended.len();
                }
            }
        }
        self.out.apply(kernels, attend.mixed.as_rows(), Epilogue::Add, x)
    }
}

impl GroupedSizes {
    /// The columns of queries, keys and values side by side.
    fn columns(&self) -> [Range<usize>; 3] {
        let queries = self.num_heads * self.head_dim;
        let keys = self.num_kv_heads * self.head_dim;
        [
            0..queries,
            queries..queries + keys,
            queries + keys..queries + 2 * keys,
        ]
    }
}

/// Queries, keys and values of all rows, and the rows that the attention makes of them.
struct Attend<'a> {
    engine: Engine,
    queries: Rows<'a>,
    keys: Rows<'a>,
    values: Rows<'a>,
    mixed: RowsMut<'a>,
}

impl Attend<'_> {
    /// A sequence whose rows all attend to each other; `packed` is memory for it.
    fn whole(&mut self, rows: Range<usize>, packed: &mut PackedKeyValues) -> Result<()> {
        let (keys, values) = (self.keys.rows(rows.clone()), self.values.rows(rows.clone()));
        kv_cache::replace_from(self.engine, packed, 0, keys, values)?;
        self.attend(rows, packed, Mask::None)
    }

    /// A causal sequence, whose rows begin with number `first`: run by run of rows that may be attended to,
    /// or may not.
    fn causal(&mut self, first: usize, Causal { cache, attended }: &mut Causal<'_>) -> Result<()> {
        let mut start = first;
        for run in attended.chunk_by(|a, b| a == b) {
            let rows = start..start + run.len();
            start = rows.end;
            let before = cache.len();
            if run[0] {
                let (keys, values) = (self.keys.rows(rows.clone()), self.values.rows(rows.clone()));
                kv_cache::append(self.engine, cache, keys, values)?;
            } else if before == 0 {
                self.mixed.reborrow().rows(rows).fill(0.0);
                continue;
            }
            // Rows that were not appended all see the same keys.
            self.attend(rows, cache, Mask::Causal { offset: before })?;
        }
        Ok(())
    }

    fn attend(&mut self, rows: Range<usize>, cache: &PackedKeyValues, mask: Mask<'_>) -> Result<()> {
        let mixed = self.mixed.reborrow().rows(rows.clone());
        kv_cache::attend(self.engine, self.queries.rows(rows), cache, mask, None, mixed)
    }
}
