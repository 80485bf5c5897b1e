//! The diffusion transformer (spec 1.4, 1.6, 1.7), one forward pass over the rows `[state, future, action]`.

use std::sync::Arc;

use saccade_kernels::{Epilogue, LinearScratch, PackedKeyValues, PackedLinear};

use crate::attention::{Attention, AttentionBuffers, Bias, FeedForward, Held, Subset};
use crate::cache::Cache;
use crate::config::{HeadConfig, Reads};
use crate::context::Context;
use crate::error::Result;
use crate::intervention::{Changes, Group, Groups};
use crate::layers::{Engine, TensorSource, load_linear, rows, rows_mut, sized};
use crate::layout::{DitBlockNames, HeadNames, LinearNames};
use crate::profile::{Part, apply, layer_norm, out_of_memory};
use crate::tables::{TIME_CHANNELS, embedding_time};
use crate::trace::{Recorded, StepBlock};

const BLOCK_EPS: f32 = 1e-5;
const OUTPUT_EPS: f32 = 1e-6;

/// Buckets whose modulations are kept: the 4 of the released sampler several times over; 13 MB at N1.5's size.
const CACHED_BUCKETS: usize = 64;

pub(crate) struct Dit {
    timestep_embedder: [PackedLinear; 2],
    blocks: Vec<Block>,
    /// `proj_out_1`: the output norm's modulation.
    output_modulation: PackedLinear,
    /// `proj_out_2`.
    output: PackedLinear,
    width: usize,
    times: Cache<usize, TimeModulations>,
}

struct Block {
    /// `norm1.linear`.
    modulation: PackedLinear,
    attention: Attention,
    /// What it sees of the vision-language tokens; none if it is self-attention.
    reads: Option<Reads>,
    feed_forward: FeedForward,
}

/// `norm(h) * scale + shift`; the 1 of the released `1 + scale` is in `scale`.
struct Modulation {
    scale: Vec<f32>,
    shift: Vec<f32>,
}

/// All that depends on the bucket alone (spec I11).
pub(crate) struct TimeModulations {
    blocks: Vec<Modulation>,
    output: Modulation,
}

/// One forward pass: what it is over, and what is changed in it.
#[derive(Clone, Copy)]
pub(crate) struct Pass<'a> {
    pub context: &'a Context,
    /// Sequences for each batch element, with equally many rows.
    pub samples: usize,
    /// Which rows there are, and what is changed at Euler step `step`.
    pub changes: &'a Changes<'a>,
    pub step: usize,
    pub rows: Rows,
}

/// Which rows run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Rows {
    /// All in every block: what a trace shows.
    All,
    /// All, but in the last block only those of the actions, since nothing reads the others after it (spec I4).
    Needed,
    /// As [`Self::Needed`], and what the self-attention blocks read of them is held.
    NeededAndHeld,
    /// Those of the actions. The self-attention blocks read the held keys and values of the others.
    Actions,
}

/// Memory of one pass that is kept for the next.
pub(crate) struct DitBuffers {
    /// The residual stream, `(sequences, rows, width)`: filled by the caller, unless only the action rows run.
    pub h: Vec<f32>,
    /// That of the action rows alone, `(sequences, action_rows, width)`: filled by the caller where only they run.
    pub action: Vec<f32>,
    /// One for each batch element: filled by the caller.
    pub times: Vec<Arc<TimeModulations>>,
    y: Vec<f32>,
    y_all: Vec<f32>,
    hidden: Vec<f32>,
    attention: AttentionBuffers,
    /// By block, empty for cross-attention.
    held: Vec<Vec<PackedKeyValues>>,
}

impl DitBuffers {
    pub(crate) fn new() -> Self {
        Self {
            h: Vec::new(),
            action: Vec::new(),
            times: Vec::new(),
            y: Vec::new(),
            y_all: Vec::new(),
            hidden: Vec::new(),
            attention: AttentionBuffers::new(),
            held: Vec::new(),
        }
    }
}

impl Dit {
    pub(crate) fn load(
        tensors: &dyn TensorSource,
        engine: Engine,
        config: &HeadConfig,
        names: &HeadNames,
    ) -> Result<Self> {
        let linear = |names: &LinearNames| load_linear(tensors, engine, &[names]);
        let block = |(index, names): (usize, &DitBlockNames)| {
            Ok(Block {
                modulation: linear(&names.modulation)?,
                attention: Attention::load(tensors, engine, &names.attention, config.num_heads)?,
                reads: config.reads(index),
                feed_forward: FeedForward::load(tensors, engine, &names.feed_forward)?,
            })
        };
        let [linear_1, linear_2] = &names.timestep_embedder;
        let [proj_out_1, proj_out_2] = &names.proj_out;
        Ok(Self {
            timestep_embedder: [linear(linear_1)?, linear(linear_2)?],
            blocks: names
                .blocks
                .iter()
                .enumerate()
                .map(block)
                .collect::<Result<_>>()?,
            output_modulation: linear(proj_out_1)?,
            output: linear(proj_out_2)?,
            width: config.width,
            times: Cache::new(CACHED_BUCKETS),
        })
    }

    pub(crate) fn nbytes(&self) -> usize {
        let block = |block: &Block| {
            block.modulation.nbytes() + block.attention.nbytes() + block.feed_forward.nbytes()
        };
        self.timestep_embedder
            .iter()
            .map(PackedLinear::nbytes)
            .sum::<usize>()
            + self.blocks.iter().map(block).sum::<usize>()
            + self.output_modulation.nbytes()
            + self.output.nbytes()
    }

    /// By block: the attention over the vision-language tokens and what it sees of them, if it is one.
    pub(crate) fn cross_attentions(&self) -> Vec<Option<(Reads, &Attention)>> {
        self.blocks
            .iter()
            .map(|block| block.reads.map(|reads| (reads, &block.attention)))
            .collect()
    }

    /// The modulations of bucket `timestep`, computed at its first use.
    pub(crate) fn time(&self, engine: Engine, timestep: usize) -> Arc<TimeModulations> {
        self.times
            .get_or_insert(timestep, || self.modulations(engine, timestep))
    }

    fn modulations(&self, engine: Engine, timestep: usize) -> TimeModulations {
        let mut scratch = LinearScratch::new();
        let mut row = |layer: &PackedLinear, x: &[f32], epilogue| {
            let mut out = vec![0.0; layer.out_features()];
            let applied = layer.apply(
                engine.threads,
                rows(x, x.len()),
                epilogue,
                rows_mut(&mut out, layer.out_features()),
                &mut scratch,
            );
            applied.unwrap_or_else(|error| out_of_memory(error));
            out
        };
        let mut table = [0.0; TIME_CHANNELS];
        embedding_time(timestep, &mut table);
        let [linear_1, linear_2] = &self.timestep_embedder;
        // Every use of the embedding goes through SiLU first, so it is applied here once.
        let hidden = row(linear_1, &table, Epilogue::Silu);
        let silu_temb = row(linear_2, &hidden, Epilogue::Silu);
        let mut modulation = |layer: &PackedLinear, scale_first: bool| {
            let both = row(layer, &silu_temb, Epilogue::Store);
            let (first, second) = both.split_at(self.width);
            let (scale, shift) = if scale_first {
                (first, second)
            } else {
                (second, first)
            };
            Modulation {
                scale: scale.iter().map(|scale| 1.0 + scale).collect(),
                shift: shift.to_vec(),
            }
        };
        TimeModulations {
            blocks: self
                .blocks
                .iter()
                .map(|block| modulation(&block.modulation, true))
                .collect(),
            output: modulation(&self.output_modulation, false),
        }
    }

    /// Runs all blocks over `buffers.h`, or over `buffers.action` where only these rows run, and writes the output rows of the actions,
    /// `(sequences, action_rows, hidden_dim)`. What `recorded` has places for is kept.
    pub(crate) fn forward(
        &self,
        engine: Engine,
        pass: &Pass<'_>,
        recorded: &mut Recorded<StepBlock>,
        buffers: &mut DitBuffers,
        out: &mut Vec<f32>,
    ) {
        buffers.held.resize_with(self.blocks.len(), Vec::new);
        let mut h = std::mem::take(&mut buffers.h); // (sequences, rows, width)
        let mut action = std::mem::take(&mut buffers.action); // (sequences, action_rows, width)
        let last = self.blocks.len() - 1;
        for (index, block) in self.blocks.iter().enumerate() {
            let (x, all): (_, Option<&[f32]>) = match pass.rows {
                Rows::Actions => (&mut action, None),
                Rows::Needed | Rows::NeededAndHeld if index == last => {
                    gather_action_rows(&pass.changes.extent.groups, self.width, &h, &mut action);
                    (&mut action, Some(&h))
                }
                _ => (&mut h, None),
            };
            self.block(engine, pass, index, block, x, all, recorded, buffers);
        }
        if pass.rows == Rows::All {
            gather_action_rows(&pass.changes.extent.groups, self.width, &h, &mut action);
        }
        let y = sized(&mut buffers.y, action.len());
        modulated_norm(
            engine,
            &buffers.times,
            |time| &time.output,
            self.width,
            OUTPUT_EPS,
            &action,
            y,
        );
        let hidden_dim = self.output.out_features();
        let out = sized(out, action.len() / self.width * hidden_dim);
        apply(
            Part::Output,
            &self.output,
            engine.threads,
            rows(y, self.width),
            Epilogue::Store,
            rows_mut(out, hidden_dim),
            &mut buffers.attention.linear,
        );
        (buffers.h, buffers.action) = (h, action);
    }

    /// One block over the rows `x`. `all` are the rows that keys and values come from where `x` is only some of them.
    #[allow(clippy::too_many_arguments)] // One equation: its rows, its conditions and its memory.
    fn block(
        &self,
        engine: Engine,
        pass: &Pass<'_>,
        index: usize,
        block: &Block,
        x: &mut [f32],
        all: Option<&[f32]>,
        recorded: &mut Recorded<StepBlock>,
        buffers: &mut DitBuffers,
    ) {
        let DitBuffers {
            y,
            y_all,
            hidden,
            attention,
            times,
            held: held_by_block,
            ..
        } = buffers;
        let norm = |h: &[f32], y: &mut [f32]| {
            modulated_norm(
                engine,
                times,
                |time| &time.blocks[index],
                self.width,
                BLOCK_EPS,
                h,
                y,
            );
        };
        let y = sized(y, x.len());
        norm(x, y);
        let Pass {
            context,
            samples,
            changes,
            step,
            rows: running,
            ..
        } = *pass;
        let groups = context.batch * samples;
        let first_row = changes.extent.groups.num_rows() - x.len() / self.width / groups;
        let shared = changes.bias(step, index, first_row);
        let weights = recorded.attention((step, index));
        let bias = Bias { keys: None, shared };
        if let Some(reads) = block.reads {
            let kv = &context.keys_values[index];
            let all = context.num_vl_tokens;
            let subset = context
                .positions(reads)
                .map(|positions| Subset { positions, all });
            block.attention.add_cross(
                engine,
                y,
                kv,
                samples,
                subset,
                bias,
                weights,
                Epilogue::Add,
                attention,
                x,
            );
        } else {
            let source: &[f32] = match all {
                None => y,
                Some(h) => {
                    let y_all = sized(y_all, h.len());
                    norm(h, y_all);
                    y_all
                }
            };
            let held = match running {
                Rows::All | Rows::Needed => None,
                Rows::NeededAndHeld => Some(0),
                Rows::Actions => Some(changes.extent.groups.range(Group::Action).start),
            };
            let held = held.map(|first| Held {
                sequences: &mut held_by_block[index],
                first,
            });
            block
                .attention
                .add_self(engine, y, source, groups, held, bias, weights, attention, x);
        }
        layer_norm(
            engine,
            rows(x, self.width),
            BLOCK_EPS,
            None,
            rows_mut(y, self.width),
        );
        block
            .feed_forward
            .add(engine, y, hidden, &mut attention.linear, x);
        changes.patch(step, index, first_row, samples, x);
        if let Some(kept) = recorded.hidden((step, index)) {
            kept.copy_from_slice(x);
        }
    }
}

/// Copies the action rows, the last of each sequence, from `h` to `action`.
fn gather_action_rows(groups: &Groups, width: usize, h: &[f32], action: &mut Vec<f32>) {
    let (sequence, actions) = (groups.num_rows() * width, groups.action * width);
    let action = sized(action, h.len() / sequence * actions);
    for (from, to) in h.chunks_exact(sequence).zip(action.chunks_exact_mut(actions)) {
        to.copy_from_slice(&from[sequence - actions..]);
    }
}

/// `norm(h) * (1 + scale) + shift` with each batch element's own scale and shift.
fn modulated_norm(
    engine: Engine,
    times: &[Arc<TimeModulations>],
    modulation: impl Fn(&TimeModulations) -> &Modulation,
    width: usize,
    eps: f32,
    h: &[f32],
    y: &mut [f32],
) {
    let element = h.len() / times.len();
    let (mut h, mut y) = (h, y);
    // Usually all elements are at one time, and one call does all rows.
    for run in times.chunk_by(Arc::ptr_eq) {
        let (h_run, h_rest) = h.split_at(run.len() * element);
        let (y_run, y_rest) = std::mem::take(&mut y).split_at_mut(run.len() * element);
        let Modulation { scale, shift } = modulation(&run[0]);
        let (h_run, y_run) = (rows(h_run, width), rows_mut(y_run, width));
        layer_norm(engine, h_run, eps, Some((scale, shift)), y_run);
        (h, y) = (h_rest, y_rest);
    }
}
