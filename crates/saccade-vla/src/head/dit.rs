//! The diffusion transformer (spec 1.4, 1.6, 1.7), one forward pass over the rows `[state, future, action]`.

use std::sync::Arc;

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch, PackedKeyValues};

use super::cache::Cache;
use super::context::Context;
use crate::alloc::sized;
use crate::config::{HeadConfig, Reads};
use crate::engine::Engine;
use crate::error::{Error, Result};
use crate::inspect::changes::Changes;
use crate::inspect::groups::{Group, Groups};
use crate::inspect::trace::{Recorded, StepBlock};
use crate::nn::attention::{Attention, AttentionBuffers, Bias, CrossKeys, Held, SelfKeys, Subset};
use crate::nn::feed_forward::{DIFFUSERS, FeedForward};
use crate::nn::linear::Linear;
use crate::nn::weights::Weights;
use crate::ops::{self, check_interrupted};
use crate::precision::Role;
use crate::profile::Part;
use crate::sampling::timestep_embedding::{TIME_CHANNELS, transformer_embedding};

const BLOCK_EPS: f32 = 1e-5;
const OUTPUT_EPS: f32 = 1e-6;

/// Buckets whose modulations are kept: the 4 of the released sampler several times over; 13 MB at N1.5's size.
const CACHED_BUCKETS: usize = 64;

pub(crate) struct Dit {
    timestep_embedder: [Linear; 2],
    blocks: Vec<Block>,
    /// `proj_out_1`: the output norm's modulation.
    output_modulation: Linear,
    /// `proj_out_2`.
    output: Linear,
    width: usize,
    times: Cache<usize, TimeModulations>,
}

/// `x += attention(modulated_norm(x)); x += ff(norm(x))`.
struct Block {
    /// `norm1.linear`.
    modulation: Linear,
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
    pub rows: ActiveRows,
}

/// Which rows run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ActiveRows {
    /// All in every block: what a trace shows.
    All,
    /// All, but in the last block only those of the actions, since nothing reads the others after it (spec I4).
    Needed,
    /// As [`Self::Needed`], and what the self-attention blocks read of them is held.
    NeededAndHeld,
    /// The action rows. The self-attention blocks read the held keys and values of the other rows.
    Actions,
}

/// One block in one pass.
#[derive(Clone, Copy)]
struct BlockCall<'a> {
    engine: Engine,
    pass: &'a Pass<'a>,
    index: usize,
}

impl BlockCall<'_> {
    /// Sequences that run.
    fn sequences(&self) -> usize {
        self.pass.context.batch * self.pass.samples
    }

    /// The first row of a sequence that is in `x`, whose rows are `width` wide.
    fn first_row(&self, x: &[f32], width: usize) -> usize {
        self.pass.changes.extent.groups.num_rows() - x.len() / width / self.sequences()
    }

    /// The key of what is recorded.
    fn step_block(&self) -> StepBlock {
        (self.pass.step, self.index)
    }
}

/// Memory of one pass that is kept for the next.
pub(crate) struct DitBuffers {
    /// The residual stream, `(sequences, rows, width)`: filled by the caller, unless only the action rows run.
    pub h: Activations,
    /// That of the action rows alone, `(sequences, action_rows, width)`: filled by the caller where only they run.
    pub action: Activations,
    /// One for each batch element: filled by the caller.
    pub times: Vec<Arc<TimeModulations>>,
    y: Activations,
    y_all: Activations,
    hidden: Activations,
    attention: AttentionBuffers,
    /// Keys and values by block; empty for cross-attention.
    held: Vec<Vec<PackedKeyValues>>,
}

impl DitBuffers {
    pub(crate) fn new() -> Self {
        Self {
            h: Activations::new(),
            action: Activations::new(),
            times: Vec::new(),
            y: Activations::new(),
            y_all: Activations::new(),
            hidden: Activations::new(),
            attention: AttentionBuffers::new(),
            held: Vec::new(),
        }
    }
}

impl Block {
    /// Block number `index`, from its weights.
    fn new(weights: &Weights<'_>, config: &HeadConfig, index: usize) -> Result<Self> {
        let (width, reads) = (config.width, config.reads(index));
        let (context_dim, kv_part) = match reads {
            Some(_) => (config.context_dim, Part::ContextToKv),
            None => (width, Part::ToKv),
        };
        let attention = weights.at("attn1");
        Ok(Self {
            modulation: Linear::new(&weights.at("norm1.linear"), width, 2 * width, Role::Time)?,
            attention: Attention::new(&attention, width, context_dim, config.num_heads, kv_part)?,
            reads,
            feed_forward: FeedForward::new(
                &weights.at("ff"),
                DIFFUSERS,
                [width, 4 * width],
                Epilogue::GeluTanh,
                Role::Block,
            )?,
        })
    }
}

impl Dit {
    /// From `model`.
    pub(crate) fn new(weights: &Weights<'_>, config: &HeadConfig) -> Result<Self> {
        let width = config.width;
        let blocks = weights.at("transformer_blocks");
        let blocks = (0..config.num_layers)
            .map(|index| Block::new(&blocks.at(index), config, index))
            .collect::<Result<_>>()?;
        let embedder = weights.at("timestep_encoder.timestep_embedder");
        let output = Linear::new(&weights.at("proj_out_2"), width, config.hidden_dim, Role::Other);
        Ok(Self {
            blocks,
            timestep_embedder: [
                Linear::new(&embedder.at("linear_1"), TIME_CHANNELS, width, Role::Time)?,
                Linear::new(&embedder.at("linear_2"), width, width, Role::Time)?,
            ],
            output_modulation: Linear::new(&weights.at("proj_out_1"), width, 2 * width, Role::Time)?,
            output: output?.counted(Part::Output),
            width,
            times: Cache::new(CACHED_BUCKETS),
        })
    }

    /// For each block that attends to the vision-language tokens: its attention and which of the tokens it sees.
    pub(crate) fn cross_attentions(&self) -> Vec<Option<(Reads, &Attention)>> {
        self.blocks
            .iter()
            .map(|block| block.reads.map(|reads| (reads, &block.attention)))
            .collect()
    }

    /// The modulations of bucket `timestep`, computed at its first use.
    pub(crate) fn time(&self, engine: Engine, timestep: usize) -> Result<Arc<TimeModulations>> {
        self.times
            .get_or_insert(timestep, || self.modulations(engine, timestep))
    }

    fn modulations(&self, engine: Engine, timestep: usize) -> Result<TimeModulations> {
        let mut scratch = LinearScratch::new();
        let mut row = |layer: &Linear, x: &[f32], epilogue| {
            let mut out = vec![0.0; layer.out_features()];
            layer.apply(engine, x, epilogue, &mut out, &mut scratch)?;
            Ok::<_, Error>(out)
        };
        let mut table = [0.0; TIME_CHANNELS];
        transformer_embedding(timestep, &mut table);
        let [linear_1, linear_2] = &self.timestep_embedder;
        // Every use of the embedding goes through SiLU first, so it is applied here once.
        let hidden = row(linear_1, &table, Epilogue::Silu)?;
        let silu_temb = row(linear_2, &hidden, Epilogue::Silu)?;
        let mut modulation = |layer: &Linear, scale_first: bool| {
            let both = row(layer, &silu_temb, Epilogue::Store)?;
            let (first, second) = both.split_at(self.width);
            let (scale, shift) = if scale_first {
                (first, second)
            } else {
                (second, first)
            };
            Ok::<_, Error>(Modulation {
                scale: scale.iter().map(|scale| 1.0 + scale).collect(),
                shift: shift.to_vec(),
            })
        };
        Ok(TimeModulations {
            blocks: self
                .blocks
                .iter()
                .map(|block| modulation(&block.modulation, true))
                .collect::<Result<_>>()?,
            output: modulation(&self.output_modulation, false)?,
        })
    }

    /// Runs all blocks over `buffers.h`, or over `buffers.action` where only these rows run, and writes the output rows of the actions,
    /// `(sequences, action_rows, hidden_dim)`. What `recorded` has room for is kept.
    pub(crate) fn forward(
        &self,
        engine: Engine,
        pass: &Pass<'_>,
        recorded: &mut Recorded<StepBlock>,
        buffers: &mut DitBuffers,
        out: &mut Activations,
    ) -> Result<()> {
        buffers.held.resize_with(self.blocks.len(), Vec::new);
        // Taken out for the call, so that the blocks can have the other buffers; put back even if it fails.
        let mut h = std::mem::take(&mut buffers.h); // (sequences, rows, width)
        let mut action = std::mem::take(&mut buffers.action); // (sequences, action_rows, width)
        let result = self
            .run_blocks(engine, pass, recorded, buffers, &mut h, &mut action)
            .and_then(|()| self.output(engine, &action, buffers, out));
        (buffers.h, buffers.action) = (h, action);
        result
    }

    fn run_blocks(
        &self,
        engine: Engine,
        pass: &Pass<'_>,
        recorded: &mut Recorded<StepBlock>,
        buffers: &mut DitBuffers,
        h: &mut Activations,
        action: &mut Activations,
    ) -> Result<()> {
        let groups = &pass.changes.extent.groups;
        let last = self.blocks.len() - 1;
        for index in 0..self.blocks.len() {
            check_interrupted()?;
            let (x, all): (_, Option<&[f32]>) = match pass.rows {
                ActiveRows::Actions => (&mut *action, None),
                ActiveRows::Needed | ActiveRows::NeededAndHeld if index == last => {
                    gather_action_rows(groups, self.width, h, action)?;
                    (&mut *action, Some(h))
                }
                _ => (&mut *h, None),
            };
            let call = BlockCall { engine, pass, index };
            self.attend(call, all, recorded, buffers, x)?;
            self.feed_forward(call, recorded, buffers, x)?;
        }
        if pass.rows == ActiveRows::All {
            gather_action_rows(groups, self.width, h, action)?;
        }
        Ok(())
    }

    /// `proj_out_2(modulated_norm(action))`.
    fn output(
        &self,
        engine: Engine,
        action: &[f32],
        buffers: &mut DitBuffers,
        out: &mut Activations,
    ) -> Result<()> {
        let y = sized(&mut buffers.y, action.len())?;
        let norm = ModulatedNorm::new(self.width, OUTPUT_EPS, |time| &time.output);
        norm.apply(engine, &buffers.times, action, y)?;
        let out = sized(out, action.len() / self.width * self.output.out_features())?;
        self.output
            .apply(engine, y, Epilogue::Store, out, &mut buffers.attention.linear)
    }

    /// `x += attention(modulated_norm(x))`. `all` are the rows that keys and values come from where `x` is only some of them.
    fn attend(
        &self,
        call: BlockCall<'_>,
        all: Option<&[f32]>,
        recorded: &mut Recorded<StepBlock>,
        buffers: &mut DitBuffers,
        x: &mut [f32],
    ) -> Result<()> {
        let BlockCall { engine, pass, index } = call;
        let block = &self.blocks[index];
        let DitBuffers {
            y,
            y_all,
            attention,
            times,
            held: held_by_block,
            ..
        } = buffers;
        let norm = ModulatedNorm::new(self.width, BLOCK_EPS, |time| &time.blocks[index]);
        let y = sized(y, x.len())?;
        norm.apply(engine, times, x, y)?;
        let first_row = call.first_row(x, self.width);
        let bias = Bias {
            keys: None,
            shared: pass.changes.bias(pass.step, index, first_row),
        };
        let weights = recorded.attention(call.step_block());
        if let Some(reads) = block.reads {
            let subset = pass.context.positions(reads).map(|positions| Subset {
                positions,
                all: pass.context.num_vl_tokens,
            });
            let keys = CrossKeys {
                packed: &pass.context.keys_values[index],
                samples: pass.samples,
                subset,
                bias,
            };
            block.attention.mix_cross(engine, y, keys, weights, attention)?;
        } else {
            let source: &[f32] = match all {
                None => y,
                Some(h) => {
                    let y_all = sized(y_all, h.len())?;
                    norm.apply(engine, times, h, y_all)?;
                    y_all
                }
            };
            let first_held = match pass.rows {
                ActiveRows::All | ActiveRows::Needed => None,
                ActiveRows::NeededAndHeld => Some(0),
                ActiveRows::Actions => Some(pass.changes.extent.groups.range(Group::Action).start),
            };
            let keys = SelfKeys {
                source,
                sequences: call.sequences(),
                held: first_held.map(|first| Held {
                    sequences: &mut held_by_block[index],
                    first,
                }),
                bias,
            };
            block.attention.mix_self(engine, y, keys, weights, attention)?;
        }
        block.attention.out(engine, Epilogue::Add, attention, x)
    }

    /// `x += ff(norm(x))`, and what is to be done with the rows after the block.
    fn feed_forward(
        &self,
        call: BlockCall<'_>,
        recorded: &mut Recorded<StepBlock>,
        buffers: &mut DitBuffers,
        x: &mut [f32],
    ) -> Result<()> {
        let BlockCall { engine, pass, index } = call;
        let DitBuffers {
            y, hidden, attention, ..
        } = buffers;
        let y = sized(y, x.len())?;
        ops::layer_norm(engine, self.width, BLOCK_EPS, None, x, y)?;
        let scratch = &mut attention.linear;
        self.blocks[index]
            .feed_forward
            .add(engine, y, hidden, scratch, x)?;
        let first_row = call.first_row(x, self.width);
        pass.changes.patch(pass.step, index, first_row, pass.samples, x);
        if let Some(kept) = recorded.hidden(call.step_block()) {
            kept.copy_from_slice(x);
        }
        Ok(())
    }
}

/// Copies the action rows, the last of each sequence, from `h` to `action`.
fn gather_action_rows(groups: &Groups, width: usize, h: &[f32], action: &mut Activations) -> Result<()> {
    let (sequence, actions) = (groups.num_rows() * width, groups.action * width);
    let action = sized(action, h.len() / sequence * actions)?;
    for (from, to) in h.chunks_exact(sequence).zip(action.chunks_exact_mut(actions)) {
        to.copy_from_slice(&from[sequence - actions..]);
    }
    Ok(())
}

/// `norm(h) * (1 + scale) + shift` with each batch element's own scale and shift.
struct ModulatedNorm<F> {
    width: usize,
    eps: f32,
    /// Which of the modulations.
    of: F,
}

impl<F: Fn(&TimeModulations) -> &Modulation> ModulatedNorm<F> {
    fn new(width: usize, eps: f32, of: F) -> Self {
        Self { width, eps, of }
    }

    fn apply(&self, engine: Engine, times: &[Arc<TimeModulations>], h: &[f32], y: &mut [f32]) -> Result<()> {
        let element = h.len() / times.len();
        let (mut h, mut y) = (h, y);
        // Usually all elements are at one time, and one call does all rows.
        for run in times.chunk_by(Arc::ptr_eq) {
            let (h_run, h_rest) = h.split_at(run.len() * element);
            let (y_run, y_rest) = std::mem::take(&mut y).split_at_mut(run.len() * element);
            let Modulation { scale, shift } = (self.of)(&run[0]);
            ops::layer_norm(engine, self.width, self.eps, Some((scale, shift)), h_run, y_run)?;
            (h, y) = (h_rest, y_rest);
        }
        Ok(())
    }
}
