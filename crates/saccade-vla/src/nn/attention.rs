//! Multi-head attention with its projections: what the blocks of the head and the stand-alone cross-attention
//! share.
//!
//! Equation 9 of docs/equations.md.

use saccade_vla_kernels::{Epilogue, LogitBias, PackedKeyValues, Rows, RowsMut};

use super::kv_cache;
use super::linear::Linear;
use super::sequences::Sequences;
use super::weights::Weights;
use crate::alloc::{Scratch, product, reserve, reserved};
use crate::engine::{Engine, Kernels};
use crate::error::Result;
use crate::precision::Role;
use crate::profile::Part;

/// `to_out(softmax(to_q(y) to_k(c)^T / sqrt(head_dim)) to_v(c))`, whose heads are contiguous slices of a row.
pub(crate) struct Attention {
    to_q: Linear,
    /// `to_k` and `to_v`: one product makes both.
    to_kv: Linear,
    to_out: Linear,
    num_heads: usize,
    width: usize,
}

/// Memory kept between calls.
#[derive(Default)]
pub(crate) struct AttentionWorkspace {
    q: Scratch,
    kv: Scratch,
    /// The values that each query attends to, before `to_out`.
    mixed: Scratch,
    bias: Vec<f32>,
    probabilities: Scratch,
    packed: Vec<PackedKeyValues>,
}

/// The keys and values of a cross-attention.
pub(crate) struct CrossKeys<'a> {
    /// The KV cache of each group of sequences.
    pub caches: &'a [PackedKeyValues],
    /// The keys that each group has, where these are not all.
    pub subset: Option<Subset<'a>>,
    pub bias: Bias<'a>,
    /// Receives the softmax, `(sequences, heads, queries, keys)`; takes one sequence in each group. Of a
    /// subset, it is over all keys, and zero before.
    pub probabilities: Option<&'a mut [f32]>,
}

/// The keys that each group of sequences has, where these are not all.
#[derive(Clone, Copy)]
pub(crate) struct Subset<'a> {
    /// By group, ascending.
    pub positions: &'a [Vec<usize>],
    /// The number that they are chosen from: shared biases and probabilities are over all of them.
    pub all: usize,
}

/// The keys and values of a self-attention.
pub(crate) struct SelfKeys<'a> {
    /// The rows that keys and values are made of.
    pub source: Sequences<'a>,
    /// Where keys and values outlive the call.
    pub held: Option<Held<'a>>,
    pub bias: Bias<'a>,
    /// Receives the softmax, `(sequences, heads, queries, keys)`.
    pub probabilities: Option<&'a mut [f32]>,
}

/// KV caches of a self-attention that outlive the call.
pub(crate) struct Held<'a> {
    /// One for each sequence; calls with fewer sequences leave the rest unused.
    pub caches: &'a mut Vec<PackedKeyValues>,
    /// The number of keys that stay as they are; those of the given rows follow.
    pub first: usize,
}

/// What is added to the logits.
#[derive(Clone, Copy, Default)]
pub(crate) enum Bias<'a> {
    #[default]
    None,
    /// `(groups, keys)`: each group's own, for all of its heads and queries.
    Keys(&'a [f32]),
    /// The same for every sequence of queries.
    Shared(LogitBias<'a>),
}

impl Bias<'_> {
    /// The bias of `[heads, queries, keys]` logits of one group, whose keys are those at `positions` of the
    /// shared bias, if only some are there. `memory` is for one that has to be computed.
    fn of<'s>(
        &'s self,
        group: usize,
        positions: Option<&[usize]>,
        [heads, queries, keys]: [usize; 3],
        memory: &'s mut Vec<f32>,
    ) -> Result<Option<LogitBias<'s>>> {
        let shared = match *self {
            Self::None => return Ok(None),
            Self::Keys(all) => {
                return Ok(Some(LogitBias {
                    values: &all[group * keys..(group + 1) * keys],
                    head_stride: 0,
                    query_stride: 0,
                }));
            }
            Self::Shared(shared) => shared,
        };
        let Some(positions) = positions else {
            return Ok(Some(shared));
        };
        let heads = if shared.head_stride == 0 { 1 } else { heads };
        memory.clear();
        let len = product("activations", &[heads, queries, keys])?;
        reserve("activations", memory, len)?;
        for (head, query) in (0..heads).flat_map(|head| (0..queries).map(move |query| (head, query))) {
            let row = &shared.values[head * shared.head_stride + query * shared.query_stride..];
            memory.extend(positions.iter().map(|&position| row[position]));
        }
        Ok(Some(LogitBias {
            values: memory,
            head_stride: if heads == 1 { 0 } else { queries * keys },
            query_stride: keys,
        }))
    }
}

impl Attention {
    /// From `to_q`, `to_k`, `to_v` and `to_out.0`, as diffusers names them. Keys and values come from rows of
    /// `context_dim`; their work is counted under `kv_part`.
    pub(crate) fn new(
        weights: &Weights<'_>,
        width: usize,
        context_dim: usize,
        num_heads: usize,
        kv_part: Part,
    ) -> Result<Self> {
        let to_q = Linear::new(&weights.at("to_q"), width, width, Role::Block)?;
        let key_and_value = [(weights.at("to_k"), width), (weights.at("to_v"), width)];
        let to_kv = Linear::stacked(&key_and_value, context_dim, Role::Block, true)?;
        let to_out = Linear::new(&weights.at("to_out.0"), width, width, Role::Block)?;
        Ok(Self {
            to_q: to_q.counted(Part::ToQ),
            to_kv: to_kv.counted(kv_part),
            to_out: to_out.counted(Part::ToOut),
            num_heads,
            width,
        })
    }

    pub(crate) fn width(&self) -> usize {
        self.width
    }

    fn empty_cache(&self, engine: Engine) -> PackedKeyValues {
        kv_cache::empty(engine, self.num_heads, self.width / self.num_heads)
    }

    /// The KV caches of `source`, whose rows are those of one group after the other, `counts` of each.
    pub(crate) fn project(
        &self,
        kernels: &mut Kernels<'_>,
        source: Rows<'_>,
        counts: &[usize],
        kv: &mut Scratch,
    ) -> Result<Vec<PackedKeyValues>> {
        let (keys, values) = self.keys_values(kernels, source, kv)?;
        let mut first = 0;
        let mut caches = reserved("keys and values", counts.len())?;
        for &count in counts {
            let mut cache = self.empty_cache(kernels.engine);
            let own = first..first + count;
            first = own.end;
            let (keys, values) = (keys.rows(own.clone()), values.rows(own));
            kv_cache::replace_from(kernels.engine, &mut cache, 0, keys, values)?;
            caches.push(cache);
        }
        Ok(caches)
    }

    fn keys_values<'a>(
        &self,
        kernels: &mut Kernels<'_>,
        source: Rows<'_>,
        kv: &'a mut Scratch,
    ) -> Result<(Rows<'a>, Rows<'a>)> {
        let both = kv.rows(source.num_rows(), 2 * self.width)?;
        self.to_kv.apply(kernels, source, Epilogue::Store, both)?;
        let both = kv.as_rows();
        Ok((
            both.columns(0..self.width),
            both.columns(self.width..2 * self.width),
        ))
    }

    /// `out = epilogue(to_out(softmax(to_q(y) keys^T / sqrt(head_dim)) values))`. As many sequences of `y` as
    /// there are for each KV cache attend to the same one.
    pub(crate) fn cross(
        &self,
        kernels: &mut Kernels<'_>,
        y: Sequences<'_>,
        keys: CrossKeys<'_>,
        workspace: &mut AttentionWorkspace,
        epilogue: Epilogue,
        out: RowsMut<'_>,
    ) -> Result<()> {
        let (caches, subset, bias) = (keys.caches, keys.subset, keys.bias);
        let mut probabilities = keys.probabilities;
        self.queries(kernels, y, workspace)?;
        let (q, mut mixed) = (workspace.q.as_rows(), workspace.mixed.as_rows_mut());
        // A shared bias is one sequence's, so each sequence is then a call of its own; otherwise those that
        // read the same keys share one.
        let of_group = y.count / caches.len();
        let together = match bias {
            Bias::Shared(_) => 1,
            _ => of_group,
        };
        for first in (0..y.count).step_by(together) {
            let group = first / of_group;
            let (cache, rows) = (&caches[group], y.range(first..first + together));
            let positions = subset.map(|subset| subset.positions[group].as_slice());
            let logits = [self.num_heads, rows.len(), cache.len()];
            let bias = bias.of(group, positions, logits, &mut workspace.bias)?;
            let all = subset.map_or(cache.len(), |subset| subset.all);
            let recorded = [self.num_heads, rows.len(), all];
            let own = of_sequence(&mut probabilities, first / together, recorded);
            let (q, mixed) = (q.rows(rows.clone()), mixed.reborrow().rows(rows));
            match (positions, own) {
                (Some(positions), Some(own)) => {
                    let chosen = workspace.probabilities.slice(logits.iter().product())?;
                    kv_cache::attend(kernels.engine, q, cache, bias.into(), Some(&mut *chosen), mixed)?;
                    spread(chosen, positions, own, all);
                }
                (_, own) => kv_cache::attend(kernels.engine, q, cache, bias.into(), own, mixed)?,
            }
        }
        self.to_out.apply(kernels, mixed.as_rows(), epilogue, out)
    }

    /// `x += to_out(softmax(to_q(y) keys^T / sqrt(head_dim)) values)` within each sequence.
    pub(crate) fn add_self(
        &self,
        kernels: &mut Kernels<'_>,
        y: Sequences<'_>,
        keys: SelfKeys<'_>,
        workspace: &mut AttentionWorkspace,
        x: RowsMut<'_>,
    ) -> Result<()> {
        let (source, held, bias) = (keys.source, keys.held, keys.bias);
        let mut probabilities = keys.probabilities;
        let engine = kernels.engine;
        self.queries(kernels, y, workspace)?;
        let (keys, values) = self.keys_values(kernels, source.rows, &mut workspace.kv)?;
        let (q, mut mixed) = (workspace.q.as_rows(), workspace.mixed.as_rows_mut());
        // Caches that are not held use the same memory one after the other.
        let (caches, distinct, first) = match held {
            None => (&mut workspace.packed, 1, 0),
            Some(held) => (held.caches, y.count, held.first),
        };
        reserve("keys and values", caches, distinct)?;
        while caches.len() < distinct {
            caches.push(self.empty_cache(engine));
        }
        let logits = [self.num_heads, y.len, first + source.len];
        for sequence in 0..y.count {
            let cache = &mut caches[sequence % distinct];
            let new = source.range(sequence..sequence + 1);
            kv_cache::replace_from(engine, cache, first, keys.rows(new.clone()), values.rows(new))?;
            let bias = bias.of(sequence, None, logits, &mut workspace.bias)?;
            let own = of_sequence(&mut probabilities, sequence, logits);
            let rows = y.range(sequence..sequence + 1);
            let (q, mixed) = (q.rows(rows.clone()), mixed.reborrow().rows(rows));
            kv_cache::attend(engine, q, cache, bias.into(), own, mixed)?;
        }
        self.to_out.apply(kernels, mixed.as_rows(), Epilogue::Add, x)
    }

    /// `to_q(y)` to `workspace.q`, and `workspace.mixed` of the same shape.
    fn queries(
        &self,
        kernels: &mut Kernels<'_>,
        y: Sequences<'_>,
        workspace: &mut AttentionWorkspace,
    ) -> Result<()> {
        workspace.mixed.rows(y.rows.num_rows(), self.width)?;
        let q = workspace.q.rows(y.rows.num_rows(), self.width)?;
        self.to_q.apply(kernels, y.rows, Epilogue::Store, q)
    }
}

/// Writes rows over the keys at `positions` among `all` to rows over all of them.
fn spread(chosen: &[f32], positions: &[usize], all_keys: &mut [f32], all: usize) {
    if positions.is_empty() {
        return;
    }
    let rows = chosen.chunks_exact(positions.len());
    for (chosen, row) in rows.zip(all_keys.chunks_exact_mut(all)) {
        for (&probability, &position) in chosen.iter().zip(positions) {
            row[position] = probability;
        }
    }
}

/// The `[heads, queries, keys]` probabilities of one sequence among those of all.
fn of_sequence<'a>(
    all: &'a mut Option<&mut [f32]>,
    sequence: usize,
    shape: [usize; 3],
) -> Option<&'a mut [f32]> {
    let size: usize = shape.iter().product();
    all.as_deref_mut()
        .map(|all| &mut all[sequence * size..(sequence + 1) * size])
}
