//! Multi-head attention with its projections, and the feed-forward: what VL blocks and DiT blocks share.

use saccade_kernels::{Epilogue, LinearScratch, LogitBias, PackedKeyValues, PackedLinear, Rows};

use crate::error::Result;
use crate::layers::{Engine, TensorSource, load_linear, rows, rows_mut, sized};
use crate::layout::{AttentionNames, FeedForwardNames};
use crate::profile::{Part, apply, attention, pack};

/// `to_q`, `to_k` over `to_v`, `to_out`: `out(softmax(q k^T / sqrt(head_dim)) v)`, heads being contiguous slices.
pub(crate) struct Attention {
    to_q: PackedLinear,
    to_kv: PackedLinear,
    to_out: PackedLinear,
    num_heads: usize,
}

/// Memory of one attention call that is kept for the next.
pub(crate) struct AttentionBuffers {
    q: Vec<f32>,
    kv: Vec<f32>,
    mix: Vec<f32>,
    bias: Vec<f32>,
    weights: Vec<f32>,
    packed: Vec<PackedKeyValues>,
    /// For the linear layers around the attention too: none of them runs beside another.
    pub linear: LinearScratch,
}

/// Keys and values of a self-attention that outlive the call.
pub(crate) struct Held<'a> {
    /// One for each sequence that ever was.
    pub sequences: &'a mut Vec<PackedKeyValues>,
    /// Those before this number stay as they are, the others are made from the rows given.
    pub first: usize,
}

impl AttentionBuffers {
    pub(crate) fn new() -> Self {
        Self {
            q: Vec::new(),
            kv: Vec::new(),
            mix: Vec::new(),
            bias: Vec::new(),
            weights: Vec::new(),
            packed: Vec::new(),
            linear: LinearScratch::new(),
        }
    }
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
    ) -> Option<LogitBias<'s>> {
        let shared = self.shared?;
        let heads = if shared.head_stride == 0 { 1 } else { heads };
        chosen.clear();
        for (head, query) in (0..heads).flat_map(|head| (0..queries).map(move |query| (head, query))) {
            let row = &shared.values[head * shared.head_stride + query * shared.query_stride..];
            chosen.extend(positions.iter().map(|&position| row[position]));
        }
        Some(LogitBias {
            values: chosen,
            head_stride: if heads == 1 { 0 } else { queries * keys },
            query_stride: keys,
        })
    }

    /// The bias of `[heads, queries, keys]` logits of one group; `sum` is memory for the sum of both kinds.
    fn of<'s>(
        &'s self,
        group: usize,
        [heads, queries, keys]: [usize; 3],
        sum: &'s mut Vec<f32>,
    ) -> Option<LogitBias<'s>> {
        let own = self.keys.map(|all| &all[group * keys..(group + 1) * keys]);
        let (own, shared) = match (own, self.shared) {
            (Some(own), Some(shared)) => (own, shared),
            (Some(values), None) => {
                return Some(LogitBias {
                    values,
                    head_stride: 0,
                    query_stride: 0,
                });
            }
            (None, shared) => return shared,
        };
        let heads = if shared.head_stride == 0 { 1 } else { heads };
        sum.clear();
        for (head, query) in (0..heads).flat_map(|head| (0..queries).map(move |query| (head, query))) {
            let row = &shared.values[head * shared.head_stride + query * shared.query_stride..][..keys];
            sum.extend(row.iter().zip(own).map(|(shared, own)| shared + own));
        }
        Some(LogitBias {
            values: sum,
            head_stride: if heads == 1 { 0 } else { queries * keys },
            query_stride: keys,
        })
    }
}

impl Attention {
    pub(crate) fn load(
        source: &dyn TensorSource,
        engine: Engine,
        names: &AttentionNames,
        num_heads: usize,
    ) -> Result<Self> {
        Ok(Self {
            to_q: load_linear(source, engine, &[&names.to_q])?,
            to_kv: load_linear(source, engine, &[&names.to_k, &names.to_v])?,
            to_out: load_linear(source, engine, &[&names.to_out])?,
            num_heads,
        })
    }

    pub(crate) fn width(&self) -> usize {
        self.to_q.out_features()
    }

    pub(crate) fn nbytes(&self) -> usize {
        self.to_q.nbytes() + self.to_kv.nbytes() + self.to_out.nbytes()
    }

    fn head_dim(&self) -> usize {
        self.width() / self.num_heads
    }

    /// Keys and values of `source`, whose rows are those of one group after the other, `counts` of each: one [`PackedKeyValues`] a group.
    pub(crate) fn project(
        &self,
        engine: Engine,
        source: &[f32],
        counts: &[usize],
        buffer: &mut Vec<f32>,
        scratch: &mut LinearScratch,
    ) -> Vec<PackedKeyValues> {
        let (keys, values) = self.keys_values(engine, Part::ContextToKv, source, buffer, scratch);
        let mut first = 0;
        counts
            .iter()
            .map(|&count| {
                let mut packed = PackedKeyValues::new(
                    engine.isa,
                    engine.precision.keys_values(),
                    self.num_heads,
                    self.head_dim(),
                );
                pack(
                    engine.threads,
                    &mut packed,
                    0,
                    keys.rows(first..first + count),
                    values.rows(first..first + count),
                );
                first += count;
                packed
            })
            .collect()
    }

    fn keys_values<'a>(
        &self,
        engine: Engine,
        part: Part,
        source: &[f32],
        buffer: &'a mut Vec<f32>,
        scratch: &mut LinearScratch,
    ) -> (Rows<'a>, Rows<'a>) {
        let source = rows(source, self.to_kv.in_features());
        let both = self.to_kv.out_features();
        let buffer = sized(buffer, source.num_rows() * both); // (rows, keys | values)
        apply(
            part,
            &self.to_kv,
            engine.threads,
            source,
            Epilogue::Store,
            rows_mut(buffer, both),
            scratch,
        );
        let buffer = rows(buffer, both);
        (buffer.columns(0..both / 2), buffer.columns(both / 2..both))
    }

    /// `x += out(attention(y, held keys and values))`; `y` and `x` have `samples` sequences of equally many rows for each of `kv`.
    /// `weights`, where asked for, is `(sequences, heads, queries, keys)`; it takes one sequence for each of `kv`. Where keys and values are those
    /// of a `subset`, a shared bias and `weights` are over all that it is chosen from, and `weights` is zero before.
    #[allow(clippy::too_many_arguments)] // Buffers and views of one equation; a struct would only rename them.
    pub(crate) fn add_cross(
        &self,
        engine: Engine,
        y: &[f32],
        kv: &[PackedKeyValues],
        samples: usize,
        subset: Option<Subset<'_>>,
        bias: Bias<'_>,
        mut weights: Option<&mut [f32]>,
        epilogue: Epilogue,
        buffers: &mut AttentionBuffers,
        x: &mut [f32],
    ) {
        let width = self.width();
        self.queries(engine, y, buffers);
        // A shared bias is one sequence's, so each sequence is then a call of its own; otherwise those that read the same keys share one.
        let calls = if bias.shared.is_some() { samples } else { 1 };
        let count = buffers.q.len() / width / kv.len() / calls; // query rows of a call
        let mix = sized(&mut buffers.mix, buffers.q.len());
        for call in 0..kv.len() * calls {
            let (group, kv) = (call / calls, &kv[call / calls]);
            let range = call * count * width..(call + 1) * count * width;
            let logits = [self.num_heads, count, kv.len()];
            let q = rows(&buffers.q[range.clone()], width);
            let mix = rows_mut(&mut mix[range], width);
            let Some(Subset { positions, all }) = subset else {
                let bias = bias.of(group, logits, &mut buffers.bias);
                let weights = weights_of(&mut weights, call, logits);
                attention(engine.threads, q, kv, self.scale(), bias, weights, mix);
                continue;
            };
            let positions = &positions[group];
            let bias = bias.at(positions, logits, &mut buffers.bias);
            let mut chosen = weights
                .is_some()
                .then(|| sized(&mut buffers.weights, logits.iter().product()));
            attention(
                engine.threads,
                q,
                kv,
                self.scale(),
                bias,
                chosen.as_deref_mut(),
                mix,
            );
            let all_weights = weights_of(&mut weights, call, [self.num_heads, count, all]);
            if let (Some(all_weights), Some(chosen)) = (all_weights, chosen) {
                spread(chosen, positions, all_weights, all);
            }
        }
        apply(
            Part::ToOut,
            &self.to_out,
            engine.threads,
            rows(mix, width),
            epilogue,
            rows_mut(x, width),
            &mut buffers.linear,
        );
    }

    /// `x += out(attention(y, keys and values of source))` within each of `groups` sequences; `weights` is
    /// `(groups, heads, queries, keys)`. With `held` they are kept, and where it says so added to those already there.
    #[allow(clippy::too_many_arguments)] // As above.
    pub(crate) fn add_self(
        &self,
        engine: Engine,
        y: &[f32],
        source: &[f32],
        groups: usize,
        held: Option<Held<'_>>,
        bias: Bias<'_>,
        mut weights: Option<&mut [f32]>,
        buffers: &mut AttentionBuffers,
        x: &mut [f32],
    ) {
        let width = self.width();
        self.queries(engine, y, buffers);
        let count = buffers.q.len() / width / groups; // query rows of a sequence
        let mix = sized(&mut buffers.mix, buffers.q.len());
        let (keys, values) =
            self.keys_values(engine, Part::ToKv, source, &mut buffers.kv, &mut buffers.linear);
        let new = keys.num_rows() / groups; // rows of a sequence whose keys and values these are
        // Those that are not held share one place.
        let (packed, places, first) = match held {
            None => (&mut buffers.packed, 1, 0),
            Some(held) => (held.sequences, groups, held.first),
        };
        if packed.len() < places {
            packed.resize_with(places, || {
                PackedKeyValues::new(
                    engine.isa,
                    engine.precision.keys_values(),
                    self.num_heads,
                    self.head_dim(),
                )
            });
        }
        let logits = [self.num_heads, count, first + new];
        for group in 0..groups {
            let packed = &mut packed[group % places];
            let new = group * new..(group + 1) * new;
            let (keys, values) = (keys.rows(new.clone()), values.rows(new));
            pack(engine.threads, packed, first, keys, values);
            let range = group * count * width..(group + 1) * count * width;
            attention(
                engine.threads,
                rows(&buffers.q[range.clone()], width),
                packed,
                self.scale(),
                bias.of(group, logits, &mut buffers.bias),
                weights_of(&mut weights, group, logits),
                rows_mut(&mut mix[range], width),
            );
        }
        apply(
            Part::ToOut,
            &self.to_out,
            engine.threads,
            rows(mix, width),
            Epilogue::Add,
            rows_mut(x, width),
            &mut buffers.linear,
        );
    }

    fn queries(&self, engine: Engine, y: &[f32], buffers: &mut AttentionBuffers) {
        let width = self.width();
        let q = sized(&mut buffers.q, y.len());
        apply(
            Part::ToQ,
            &self.to_q,
            engine.threads,
            rows(y, width),
            Epilogue::Store,
            rows_mut(q, width),
            &mut buffers.linear,
        );
    }

    fn scale(&self) -> f32 {
        1.0 / (self.head_dim() as f32).sqrt()
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

/// `Linear(GELU_tanh(Linear(y)))`.
pub(crate) struct FeedForward {
    proj: PackedLinear,
    out: PackedLinear,
}

impl FeedForward {
    pub(crate) fn load(source: &dyn TensorSource, engine: Engine, names: &FeedForwardNames) -> Result<Self> {
        Ok(Self {
            proj: load_linear(source, engine, &[&names.proj])?,
            out: load_linear(source, engine, &[&names.out])?,
        })
    }

    /// `x += feed_forward(y)`.
    pub(crate) fn add(
        &self,
        engine: Engine,
        y: &[f32],
        buffer: &mut Vec<f32>,
        scratch: &mut LinearScratch,
        x: &mut [f32],
    ) {
        let (width, inner) = (self.proj.in_features(), self.proj.out_features());
        let hidden = sized(buffer, y.len() / width * inner);
        apply(
            Part::FeedForwardIn,
            &self.proj,
            engine.threads,
            rows(y, width),
            Epilogue::GeluTanh,
            rows_mut(hidden, inner),
            scratch,
        );
        apply(
            Part::FeedForwardOut,
            &self.out,
            engine.threads,
            rows(hidden, inner),
            Epilogue::Add,
            rows_mut(x, width),
            scratch,
        );
    }

    pub(crate) fn nbytes(&self) -> usize {
        self.proj.nbytes() + self.out.nbytes()
    }
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
        let mut of = |bias: Bias<'_>, group| rows(bias.of(group, [2, 2, 2], &mut sum).unwrap());
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
        assert!(Bias::default().of(0, [2, 2, 2], &mut sum).is_none());
    }
}
