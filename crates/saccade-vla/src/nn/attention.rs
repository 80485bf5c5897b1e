//! Multi-head attention with its projections: what VL blocks, DiT blocks and the cross-attention on its own share.

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch, LogitBias, PackedKeyValues, Rows};

use super::linear::Linear;
use super::weights::Weights;
use crate::alloc::{collected, product, reserve, sized};
use crate::engine::Engine;
use crate::error::Result;
use crate::ops::{self, no_keys_values, rows, rows_mut};
use crate::precision::Role;
use crate::profile::Part;

/// `to_q`, `to_k` over `to_v`, `to_out`: `out(softmax(q k^T / sqrt(head_dim)) v)`, heads being contiguous slices.
pub(crate) struct Attention {
    to_q: Linear,
    to_kv: Linear,
    to_out: Linear,
    num_heads: usize,
    width: usize,
}

/// Memory of one attention call that is kept for the next.
pub(crate) struct AttentionBuffers {
    q: Activations,
    kv: Activations,
    mix: Activations,
    bias: Vec<f32>,
    weights: Activations,
    packed: Vec<PackedKeyValues>,
    /// For the linear layers around the attention too: they run one after the other.
    pub linear: LinearScratch,
}

/// Keys and values of a self-attention that outlive the call.
pub(crate) struct Held<'a> {
    /// One for each sequence; calls with fewer sequences leave the rest unused.
    pub sequences: &'a mut Vec<PackedKeyValues>,
    /// The number of keys that stay as they are; the others are computed from the given rows.
    pub first: usize,
}

impl AttentionBuffers {
    pub(crate) fn new() -> Self {
        Self {
            q: Activations::new(),
            kv: Activations::new(),
            mix: Activations::new(),
            bias: Vec::new(),
            weights: Activations::new(),
            packed: Vec::new(),
            linear: LinearScratch::new(),
        }
    }
}

/// Keys and values that queries are given, one for each group of sequences.
#[derive(Clone, Copy)]
pub(crate) struct CrossKeys<'a> {
    pub packed: &'a [PackedKeyValues],
    /// Sequences of queries for each, of equally many rows.
    pub samples: usize,
    /// The keys that each has, where these are not all.
    pub subset: Option<Subset<'a>>,
    pub bias: Bias<'a>,
}

/// The rows from which a self-attention makes its keys and values.
pub(crate) struct SelfKeys<'a> {
    /// `(sequences, rows, width)`.
    pub source: &'a [f32],
    pub sequences: usize,
    /// Where they outlive the call.
    pub held: Option<Held<'a>>,
    pub bias: Bias<'a>,
}

/// The keys that each group of queries has, where these are not all.
#[derive(Clone, Copy)]
pub(crate) struct Subset<'a> {
    /// By group, ascending.
    pub positions: &'a [Vec<usize>],
    /// How many there are to choose from: biases that are shared, and probabilities, are over all of them.
    pub all: usize,
}

/// What is added to the logits of an attention over several groups of keys.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Bias<'a> {
    /// `(groups, keys)`: each group's own, for all of its heads and queries.
    pub keys: Option<&'a [f32]>,
    /// The same for every sequence of queries.
    pub shared: Option<LogitBias<'a>>,
}

impl Bias<'_> {
    /// The shared bias of `[heads, queries, keys]` logits at `positions` of the keys that it is over; `chosen` is memory for it.
    fn at<'s>(
        &self,
        positions: &[usize],
        [heads, queries, keys]: [usize; 3],
        chosen: &'s mut Vec<f32>,
    ) -> Result<Option<LogitBias<'s>>> {
        let Some(shared) = self.shared else {
            return Ok(None);
        };
        let heads = if shared.head_stride == 0 { 1 } else { heads };
        chosen.clear();
        let len = product("activations", &[heads, queries, keys])?;
        reserve("activations", chosen, len)?;
        for (head, query) in (0..heads).flat_map(|head| (0..queries).map(move |query| (head, query))) {
            let row = &shared.values[head * shared.head_stride + query * shared.query_stride..];
            chosen.extend(positions.iter().map(|&position| row[position]));
        }
        Ok(Some(LogitBias {
            values: chosen,
            head_stride: if heads == 1 { 0 } else { queries * keys },
            query_stride: keys,
        }))
    }

    /// The bias of `[heads, queries, keys]` logits of one group; `sum` is memory for the sum of both kinds.
    fn of<'s>(
        &'s self,
        group: usize,
        [heads, queries, keys]: [usize; 3],
        sum: &'s mut Vec<f32>,
    ) -> Result<Option<LogitBias<'s>>> {
        let own = self.keys.map(|all| &all[group * keys..(group + 1) * keys]);
        let (own, shared) = match (own, self.shared) {
            (Some(own), Some(shared)) => (own, shared),
            (Some(values), None) => {
                return Ok(Some(LogitBias {
                    values,
                    head_stride: 0,
                    query_stride: 0,
                }));
            }
            (None, shared) => return Ok(shared),
        };
        let heads = if shared.head_stride == 0 { 1 } else { heads };
        sum.clear();
        let len = product("activations", &[heads, queries, keys])?;
        reserve("activations", sum, len)?;
        for (head, query) in (0..heads).flat_map(|head| (0..queries).map(move |query| (head, query))) {
            let row = &shared.values[head * shared.head_stride + query * shared.query_stride..][..keys];
            sum.extend(row.iter().zip(own).map(|(shared, own)| shared + own));
        }
        Ok(Some(LogitBias {
            values: sum,
            head_stride: if heads == 1 { 0 } else { queries * keys },
            query_stride: keys,
        }))
    }
}

impl Attention {
    /// From `to_q`, `to_k`, `to_v` and `to_out.0`, as diffusers names them. Keys and values come from rows of `context_dim`; their work is
    /// counted under `kv_part`.
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

    fn head_dim(&self) -> usize {
        self.width / self.num_heads
    }

    fn scale(&self) -> f32 {
        1.0 / (self.head_dim() as f32).sqrt()
    }

    /// Keys and values of `source`, whose rows are those of one group after the other, `counts` of each: one [`PackedKeyValues`] a group.
    pub(crate) fn project(
        &self,
        engine: Engine,
        source: &[f32],
        counts: &[usize],
        buffer: &mut Activations,
        scratch: &mut LinearScratch,
    ) -> Result<Vec<PackedKeyValues>> {
        let (keys, values) = self.keys_values(engine, source, buffer, scratch)?;
        let mut first = 0;
        let mut all = collected("keys and values", counts.len(), [])?;
        for &count in counts {
            let mut packed = no_keys_values(engine, self.num_heads, self.head_dim());
            let new = first..first + count;
            let (keys, values) = (keys.rows(new.clone()), values.rows(new));
            ops::pack(engine.threads, &mut packed, 0, keys, values)?;
            first += count;
            all.push(packed);
        }
        Ok(all)
    }

    fn keys_values<'a>(
        &self,
        engine: Engine,
        source: &[f32],
        buffer: &'a mut Activations,
        scratch: &mut LinearScratch,
    ) -> Result<(Rows<'a>, Rows<'a>)> {
        let both = self.to_kv.out_features();
        let buffer = sized(buffer, source.len() / self.to_kv.in_features() * both)?; // (rows, keys | values)
        self.to_kv
            .apply(engine, source, Epilogue::Store, buffer, scratch)?;
        let both_rows = rows(buffer, both);
        Ok((both_rows.columns(0..both / 2), both_rows.columns(both / 2..both)))
    }

    /// `softmax(to_q(y) keys^T) values`, to be projected by [`Self::out`]. `weights`, where asked for, is
    /// `(sequences, heads, queries, keys)`; it takes one sequence for each of the keys. Where these are a subset, a shared bias and `weights`
    /// are over all that it is chosen from, and `weights` is zero before.
    pub(crate) fn mix_cross(
        &self,
        engine: Engine,
        y: &[f32],
        keys: CrossKeys<'_>,
        mut weights: Option<&mut [f32]>,
        buffers: &mut AttentionBuffers,
    ) -> Result<()> {
        let CrossKeys {
            packed,
            samples,
            subset,
            bias,
        } = keys;
        let width = self.width;
        self.queries(engine, y, buffers)?;
        // A shared bias is one sequence's, so each sequence is then a call of its own; otherwise those that read the same keys share one.
        let calls = if bias.shared.is_some() { samples } else { 1 };
        let count = buffers.q.len() / width / packed.len() / calls; // query rows of a call
        let mix = sized(&mut buffers.mix, buffers.q.len())?;
        for call in 0..packed.len() * calls {
            let (group, kv) = (call / calls, &packed[call / calls]);
            let range = call * count * width..(call + 1) * count * width;
            let logits = [self.num_heads, count, kv.len()];
            let q = rows(&buffers.q[range.clone()], width);
            let mix = rows_mut(&mut mix[range], width);
            let Some(Subset { positions, all }) = subset else {
                let bias = bias.of(group, logits, &mut buffers.bias)?;
                let weights = weights_of(&mut weights, call, logits);
                ops::attention(engine.threads, q, kv, self.scale(), bias.into(), weights, mix)?;
                continue;
            };
            let positions = &positions[group];
            let bias = bias.at(positions, logits, &mut buffers.bias)?;
            let mut chosen = match weights {
                Some(_) => Some(sized(&mut buffers.weights, logits.iter().product())?),
                None => None,
            };
            let seen = chosen.as_deref_mut();
            ops::attention(engine.threads, q, kv, self.scale(), bias.into(), seen, mix)?;
            let all_weights = weights_of(&mut weights, call, [self.num_heads, count, all]);
            if let (Some(all_weights), Some(chosen)) = (all_weights, chosen) {
                spread(chosen, positions, all_weights, all);
            }
        }
        Ok(())
    }

    /// `softmax(to_q(y) keys^T) values` within each sequence, to be projected by [`Self::out`]; `weights` is
    /// `(sequences, heads, queries, keys)`. Keys and values that are held are kept, and where it says so added to those already there.
    pub(crate) fn mix_self(
        &self,
        engine: Engine,
        y: &[f32],
        keys: SelfKeys<'_>,
        mut weights: Option<&mut [f32]>,
        buffers: &mut AttentionBuffers,
    ) -> Result<()> {
        let SelfKeys {
            source,
            sequences,
            held,
            bias,
        } = keys;
        let width = self.width;
        self.queries(engine, y, buffers)?;
        let count = buffers.q.len() / width / sequences; // query rows of a sequence
        let mix = sized(&mut buffers.mix, buffers.q.len())?;
        let (keys, values) = self.keys_values(engine, source, &mut buffers.kv, &mut buffers.linear)?;
        let new = keys.num_rows() / sequences; // rows of a sequence whose keys and values these are
        // Those that are not held use the same memory one after the other.
        let (packed, distinct, first) = match held {
            None => (&mut buffers.packed, 1, 0),
            Some(held) => (held.sequences, sequences, held.first),
        };
        reserve("keys and values", packed, distinct)?;
        while packed.len() < distinct {
            packed.push(no_keys_values(engine, self.num_heads, self.head_dim()));
        }
        let logits = [self.num_heads, count, first + new];
        for sequence in 0..sequences {
            let packed = &mut packed[sequence % distinct];
            let new = sequence * new..(sequence + 1) * new;
            let (keys, values) = (keys.rows(new.clone()), values.rows(new));
            ops::pack(engine.threads, packed, first, keys, values)?;
            let range = sequence * count * width..(sequence + 1) * count * width;
            ops::attention(
                engine.threads,
                rows(&buffers.q[range.clone()], width),
                packed,
                self.scale(),
                bias.of(sequence, logits, &mut buffers.bias)?.into(),
                weights_of(&mut weights, sequence, logits),
                rows_mut(&mut mix[range], width),
            )?;
        }
        Ok(())
    }

    /// `x = epilogue(to_out(mix))` of what [`Self::mix_cross`] or [`Self::mix_self`] has left in `buffers`.
    pub(crate) fn out(
        &self,
        engine: Engine,
        epilogue: Epilogue,
        buffers: &mut AttentionBuffers,
        x: &mut [f32],
    ) -> Result<()> {
        let AttentionBuffers { mix, linear, .. } = buffers;
        self.to_out.apply(engine, mix, epilogue, x, linear)
    }

    fn queries(&self, engine: Engine, y: &[f32], buffers: &mut AttentionBuffers) -> Result<()> {
        let q = sized(&mut buffers.q, y.len())?;
        self.to_q
            .apply(engine, y, Epilogue::Store, q, &mut buffers.linear)
    }
}

/// Rows over keys at `positions` among `all`, written to rows over all of them.
fn spread(chosen: &[f32], positions: &[usize], all_weights: &mut [f32], all: usize) {
    if positions.is_empty() {
        return;
    }
    for (chosen, row) in chosen
        .chunks_exact(positions.len())
        .zip(all_weights.chunks_exact_mut(all))
    {
        for (&weight, &position) in chosen.iter().zip(positions) {
            row[position] = weight;
        }
    }
}

/// The probabilities of one sequence among those of all.
fn weights_of<'a>(
    all: &'a mut Option<&mut [f32]>,
    sequence: usize,
    logits: [usize; 3],
) -> Option<&'a mut [f32]> {
    let size: usize = logits.iter().product();
    all.as_deref_mut()
        .map(|all| &mut all[sequence * size..(sequence + 1) * size])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_kinds_of_bias_add_up() {
        let own = [1.0, 2.0, f32::NEG_INFINITY, 4.0]; // two groups of two keys
        let shared = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0]; // (heads, queries, keys)
        let mut sum = Vec::new();
        let rows = |bias: LogitBias<'_>| {
            [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(head, query)| {
                let first = head * bias.head_stride + query * bias.query_stride;
                [bias.values[first], bias.values[first + 1]]
            })
        };
        let bias = |keys, head_stride| Bias {
            keys,
            shared: Some(LogitBias {
                values: &shared,
                head_stride,
                query_stride: 2,
            }),
        };
        let mut of = |bias: Bias<'_>, group| rows(bias.of(group, [2, 2, 2], &mut sum).unwrap().unwrap());
        assert_eq!(
            of(bias(None, 4), 1),
            [[10.0, 20.0], [30.0, 40.0], [50.0, 60.0], [70.0, 80.0]]
        );
        assert_eq!(
            of(bias(Some(&own), 4), 0),
            [[11.0, 22.0], [31.0, 42.0], [51.0, 62.0], [71.0, 82.0]]
        );
        let removed = f32::NEG_INFINITY;
        assert_eq!(
            of(bias(Some(&own), 0), 1),
            [[removed, 24.0], [removed, 44.0], [removed, 24.0], [removed, 44.0]]
        );
        let keys_only = Bias {
            keys: Some(&own),
            shared: None,
        };
        assert_eq!(of(keys_only, 0), [[1.0, 2.0]; 4]);
        assert!(Bias::default().of(0, [2, 2, 2], &mut sum).unwrap().is_none());
    }
}
