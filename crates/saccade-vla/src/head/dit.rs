//! The diffusion transformer: one forward pass over the rows `[state, future, action]` (flow matching,
//! docs/equations.md).
//!
//! Equations 7, 10, 11 and 13 of docs/equations.md.

use std::sync::Arc;

use saccade_vla_kernels::{Epilogue, LinearScratch, PackedKeyValues, Rows, RowsMut};

use super::context::Context;
use crate::alloc::Scratch;
use crate::cache::Cache;
use crate::config::{HeadConfig, Reads};
use crate::engine::{Engine, Kernels};
use crate::error::{Error, Result};
use crate::inspect::compiled::CompiledInterventions;
use crate::inspect::groups::{Group, Groups};
use crate::inspect::trace::{Recorded, StepBlock};
use crate::nn::attention::{Attention, AttentionWorkspace, Bias, CrossKeys, Held, SelfKeys, Subset};
use crate::nn::feed_forward::{DIFFUSERS, FeedForward};
use crate::nn::linear::Linear;
use crate::nn::norm::layer_norm;
use crate::nn::sequences::Sequences;
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;
use crate::precision::Role;
use crate::profile::Part;
use crate::sampling::timestep_embedding::{TIME_CHANNELS, transformer_embedding};

const BLOCK_EPS: f32 = 1e-5;
const OUTPUT_EPS: f32 = 1e-6;

/// Timesteps whose modulations are cached: the 4 of the released sampler several times over; 13 MB at N1.5's
/// size.
const CACHED_TIMESTEPS: usize = 64;

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

/// `x += attention(adaptive_norm(x)); x += ff(norm(x))`.
struct Block {
    /// `norm1.linear`.
    modulation: Linear,
    attention: Attention,
    /// The vision-language tokens that it attends to; none if it is self-attention.
    reads: Option<Reads>,
    feed_forward: FeedForward,
}

/// An adaptive norm's `norm(h) * scale + shift`; the 1 of the released `1 + scale` is in `scale`.
struct Modulation {
    scale: Vec<f32>,
    shift: Vec<f32>,
}

/// All values that depend on the timestep alone.
pub(crate) struct TimeModulations {
    blocks: Vec<Modulation>,
    output: Modulation,
}

/// One forward pass: the rows it is over, and the changes made in it.
#[derive(Clone, Copy)]
pub(crate) struct Pass<'a> {
    pub context: &'a Context,
    /// Sequences for each observation, with equally many rows.
    pub samples: usize,
    /// The rows that there are, and the changes by Euler step.
    pub compiled: &'a CompiledInterventions<'a>,
    pub step: usize,
    pub rows: ActiveRows,
}

/// The rows that run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ActiveRows {
    /// All in every block, as a trace shows them.
    All,
    /// All, but in the last block only those of the actions, since nothing reads the others after it.
    Needed,
    /// As [`Self::Needed`], and the KV caches of the self-attention blocks are held.
    NeededAndHeld,
    /// The action rows. The self-attention blocks read the keys and values of the other rows from the held KV
    /// caches.
    Actions,
}

/// One block in one pass.
#[derive(Clone, Copy)]
struct BlockCall<'a> {
    pass: &'a Pass<'a>,
    times: &'a [Arc<TimeModulations>],
    index: usize,
    /// The first row of each sequence that runs.
    first_row: usize,
}

/// The input of a pass, of which the residual stream is changed in place. Kept between calls.
#[derive(Default)]
pub(crate) struct DitInput {
    /// The residual stream, `(sequences * rows, width)`, unless only the action rows run.
    pub h: Scratch,
    /// The action rows alone, `(sequences * action_rows, width)`, where only they run.
    pub action: Scratch,
    /// By observation.
    pub times: Vec<Arc<TimeModulations>>,
}

/// Memory kept between calls.
#[derive(Default)]
pub(crate) struct DitWorkspace {
    y: Scratch,
    y_all: Scratch,
    hidden: Scratch,
    attention: AttentionWorkspace,
    /// By block, the KV cache of each sequence; empty for cross-attention.
    held: Vec<Vec<PackedKeyValues>>,
    output: Scratch,
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
            times: Cache::new(CACHED_TIMESTEPS),
        })
    }

    /// For each block that attends to the vision-language tokens: its attention and the tokens it sees.
    pub(crate) fn cross_attentions(&self) -> Vec<Option<(Reads, &Attention)>> {
        self.blocks
            .iter()
            .map(|block| block.reads.map(|reads| (reads, &block.attention)))
            .collect()
    }

    /// The modulations of `timestep`, computed at its first use.
    pub(crate) fn time(&self, engine: Engine, timestep: usize) -> Result<Arc<TimeModulations>> {
        self.times
            .get_or_insert(timestep, || self.modulations(engine, timestep))
    }

    fn modulations(&self, engine: Engine, timestep: usize) -> Result<TimeModulations> {
        let mut scratch = LinearScratch::new();
        let kernels = &mut Kernels::new(engine, &mut scratch);
        let mut row = |layer: &Linear, x: &[f32], epilogue| {
            let mut out = vec![0.0; layer.out_features()];
            let rows = RowsMut::new(&mut out, layer.out_features());
            layer.apply(kernels, Rows::new(x, layer.in_features()), epilogue, rows)?;
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

    /// Runs all blocks over `input.h`, or over `input.action` where only these rows run: the output rows of
    /// the actions, `(sequences * action_rows, hidden_dim)`.
    pub(crate) fn forward<'a>(
        &self,
        kernels: &mut Kernels<'_>,
        pass: &Pass<'_>,
        input: &mut DitInput,
        recorded: &mut Recorded<StepBlock>,
        workspace: &'a mut DitWorkspace,
    ) -> Result<Rows<'a>> {
        workspace.held.resize_with(self.blocks.len(), Vec::new);
        let DitInput { h, action, times } = input;
        let groups = &pass.compiled.sizes.groups;
        let last = self.blocks.len() - 1;
        for index in 0..self.blocks.len() {
            check_interrupted()?;
            let narrows =
                index == last && matches!(pass.rows, ActiveRows::Needed | ActiveRows::NeededAndHeld);
            if narrows {
                gather_action_rows(groups, h.as_rows(), action)?;
            }
            let only_actions = narrows || pass.rows == ActiveRows::Actions;
            let call = BlockCall {
                pass,
                times,
                index,
                first_row: if only_actions {
                    groups.range(Group::Action).start
                } else {
                    0
                },
            };
            let (mut x, all) = match only_actions {
                true => (action.as_rows_mut(), narrows.then(|| h.as_rows())),
                false => (h.as_rows_mut(), None),
            };
            self.attend(kernels, call, all, recorded, workspace, x.reborrow())?;
            self.feed_forward(kernels, call, recorded, workspace, x)?;
        }
        if pass.rows == ActiveRows::All {
            gather_action_rows(groups, h.as_rows(), action)?;
        }
        self.output(kernels, times, action.as_rows(), workspace)
    }

    /// `proj_out_2(adaptive_norm(action))`.
    fn output<'a>(
        &self,
        kernels: &mut Kernels<'_>,
        times: &[Arc<TimeModulations>],
        action: Rows<'_>,
        workspace: &'a mut DitWorkspace,
    ) -> Result<Rows<'a>> {
        let mut y = workspace.y.rows(action.num_rows(), self.width)?;
        adaptive_norm(
            kernels.engine,
            OUTPUT_EPS,
            times,
            |time| &time.output,
            action,
            y.reborrow(),
        )?;
        let out = workspace
            .output
            .rows(action.num_rows(), self.output.out_features())?;
        self.output.apply(kernels, y.as_rows(), Epilogue::Store, out)?;
        Ok(workspace.output.as_rows())
    }

    /// `x += attention(adaptive_norm(x))`. Keys and values come from the rows `all` where `x` is only some of
    /// them.
    fn attend(
        &self,
        kernels: &mut Kernels<'_>,
        call: BlockCall<'_>,
        all: Option<Rows<'_>>,
        recorded: &mut Recorded<StepBlock>,
        workspace: &mut DitWorkspace,
        x: RowsMut<'_>,
    ) -> Result<()> {
        let (pass, index) = (call.pass, call.index);
        let block = &self.blocks[index];
        let sequences = pass.context.batch * pass.samples;
        let norm = |h: Rows<'_>, y: &mut Scratch| {
            let y = y.rows(h.num_rows(), self.width)?;
            adaptive_norm(
                kernels.engine,
                BLOCK_EPS,
                call.times,
                |time| &time.blocks[index],
                h,
                y,
            )
        };
        norm(x.as_rows(), &mut workspace.y)?;
        let y = Sequences::new(workspace.y.as_rows(), sequences);
        let bias = pass.compiled.bias(pass.step, index, call.first_row);
        let bias = bias.map_or(Bias::None, Bias::Shared);
        let probabilities = recorded.attention((pass.step, index));
        if let Some(reads) = block.reads {
            let subset = pass.context.positions(reads).map(|positions| Subset {
                positions,
                all: pass.context.num_vl_tokens,
            });
            let keys = CrossKeys {
                caches: &pass.context.keys_values[index],
                subset,
                bias,
                probabilities,
            };
            let memory = &mut workspace.attention;
            return block.attention.cross(kernels, y, keys, memory, Epilogue::Add, x);
        }
        let source = match all {
            None => y,
            Some(all) => {
                norm(all, &mut workspace.y_all)?;
                Sequences::new(workspace.y_all.as_rows(), sequences)
            }
        };
        let first_held = match pass.rows {
            ActiveRows::All | ActiveRows::Needed => None,
            ActiveRows::NeededAndHeld => Some(0),
            ActiveRows::Actions => Some(call.first_row),
        };
        let keys = SelfKeys {
            source,
            held: first_held.map(|first| Held {
                caches: &mut workspace.held[index],
                first,
            }),
            bias,
            probabilities,
        };
        block
            .attention
            .add_self(kernels, y, keys, &mut workspace.attention, x)
    }

    /// `x += ff(norm(x))`; then patches and records the rows.
    fn feed_forward(
        &self,
        kernels: &mut Kernels<'_>,
        call: BlockCall<'_>,
        recorded: &mut Recorded<StepBlock>,
        workspace: &mut DitWorkspace,
        mut x: RowsMut<'_>,
    ) -> Result<()> {
        let (pass, index) = (call.pass, call.index);
        let mut y = workspace.y.rows(x.num_rows(), self.width)?;
        layer_norm(kernels.engine, BLOCK_EPS, None, x.as_rows(), y.reborrow())?;
        let feed_forward = &self.blocks[index].feed_forward;
        feed_forward.add(kernels, y.as_rows(), &mut workspace.hidden, x.reborrow())?;
        pass.compiled
            .patch(pass.step, index, call.first_row, pass.samples, x.reborrow());
        if let Some(recorded) = recorded.hidden((pass.step, index)) {
            RowsMut::new(recorded, self.width).copy_from(x.as_rows());
        }
        Ok(())
    }
}

/// Copies the action rows, the last of each sequence, from `h` to `action`.
fn gather_action_rows(groups: &Groups, h: Rows<'_>, action: &mut Scratch) -> Result<()> {
    let actions = groups.range(Group::Action);
    let sequences = h.num_rows() / groups.num_rows();
    let mut action = action.rows(sequences * actions.len(), h.num_columns())?;
    for sequence in 0..sequences {
        let first = sequence * groups.num_rows();
        let to = sequence * actions.len()..(sequence + 1) * actions.len();
        let from = h.rows(first + actions.start..first + actions.end);
        action.reborrow().rows(to).copy_from(from);
    }
    Ok(())
}

/// `norm(h) * (1 + scale) + shift` with each observation's own scale and shift, which `of` selects among the
/// modulations of its timestep.
fn adaptive_norm(
    engine: Engine,
    eps: f32,
    times: &[Arc<TimeModulations>],
    of: impl Fn(&TimeModulations) -> &Modulation,
    h: Rows<'_>,
    mut y: RowsMut<'_>,
) -> Result<()> {
    // Usually all observations are at one timestep, and one call does all rows.
    for (time, rows) in Sequences::new(h, times.len()).runs(times, Arc::ptr_eq) {
        let Modulation { scale, shift } = of(time);
        let y = y.reborrow().rows(rows.clone());
        layer_norm(engine, eps, Some((scale, shift)), h.rows(rows), y)?;
    }
    Ok(())
}
