//! One evaluation of the velocity: encoders, transformer, decoders.

use saccade_vla_kernels::LinearScratch;

use super::action_encoder::NoisyRows;
use super::action_head::ActionHead;
use super::context::Context;
use super::dit::{ActiveRows, Pass};
use super::workspace::Workspace;
use crate::alloc::{reserve, sized};
use crate::array::{Array, ArrayMut};
use crate::error::Result;
use crate::inspect::changes::Changes;
use crate::inspect::intervention::Intervention;
use crate::inspect::trace::{Recorded, StepBlock};

/// Noisy actions and their time.
#[derive(Clone, Copy, Debug)]
pub struct NoisyActions<'a> {
    /// `(batch, action_horizon, encoder_action_dim)`.
    pub actions: Array<'a>,
    /// The timestep, from 0 to `num_timestep_buckets - 1`: a scalar or `(batch,)`.
    pub timestep: Array<'a, i64>,
}

impl ActionHead {
    /// The velocity of noisy actions, to `out (batch, action_horizon, action_dim)`. `state` and `embodiment_id` are as for
    /// [`Self::sample`]. To the interventions it is step 0 of 1.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) and [`Error::Input`](crate::Error::Input) for arguments that do not fit and a velocity that is
    /// not finite; [`Error::Memory`](crate::Error::Memory). `out` is then untouched.
    pub fn velocity(
        &self,
        context: &Context,
        state: Array<'_>,
        embodiment_id: Array<'_, i64>,
        noisy: NoisyActions<'_>,
        interventions: &[Intervention],
        out: ArrayMut<'_>,
    ) -> Result<()> {
        self.check_context(context)?;
        let batch = context.batch;
        let state = self.check_state(state, batch)?;
        let expected = [batch, self.config.action_horizon, self.config.encoder_action_dim];
        let axes = "(batch, action_horizon, encoder_action_dim)";
        let actions = noisy.actions.check_shape("actions", axes, &expected)?;
        actions.check_finite("actions")?;
        let timesteps = self.check_timestep(noisy.timestep, batch)?;
        let shape = [batch, self.config.action_horizon, self.config.action_dim];
        let out = out.check_shape("out", "(batch, action_horizon, action_dim)", &shape)?;
        let changes = Changes::new(interventions, self.extent(interventions, context, 1)?)?;
        self.with_workspace(|workspace| {
            self.check_embodiments(embodiment_id, batch, &mut workspace.embodiment_ids)?;
            self.encode_state(state, workspace)?;
            sized(&mut workspace.x, actions.data().len())?.copy_from_slice(actions.data());
            workspace.dit.times.clear();
            reserve("activations", &mut workspace.dit.times, batch)?;
            for &timestep in &timesteps {
                let time = self.layers.dit.time(self.engine, timestep)?;
                workspace.dit.times.push(time);
            }
            let pass = Pass {
                context,
                samples: 1,
                changes: &changes,
                step: 0,
                rows: ActiveRows::Needed,
            };
            let timestep = |element: usize| timesteps[element];
            self.step_velocity(&pass, timestep, &mut Recorded::default(), workspace)?;
            Array::new(&workspace.velocity, &shape)?.check_result("velocity")?;
            out.copy_from_slice(&workspace.velocity);
            Ok(())
        })
    }

    /// The state rows of each batch element, to `workspace.state (batch, state_rows, width)`; of zeros for embodiments whose state does not act.
    pub(super) fn encode_state(&self, state: &[f32], workspace: &mut Workspace) -> Result<()> {
        let Workspace {
            embodiment_ids,
            seen_state,
            state_hidden,
            state: encoded,
            linear,
            ..
        } = workspace;
        let state = self.state_dropout.seen(embodiment_ids, state, seen_state)?;
        let encoder = &self.layers.state_encoder;
        encoder.apply(self.engine, embodiment_ids, state, state_hidden, encoded, linear)?;
        Ok(())
    }

    /// One forward pass over `workspace.x (batch, samples, action_horizon, encoder_action_dim)`, to `workspace.velocity`.
    pub(super) fn step_velocity(
        &self,
        pass: &Pass<'_>,
        timestep: impl Fn(usize) -> usize,
        recorded: &mut Recorded<StepBlock>,
        workspace: &mut Workspace,
    ) -> Result<()> {
        self.encode_actions(timestep, workspace)?;
        self.assemble_rows(pass, workspace)?;
        let Workspace { dit, output, .. } = workspace;
        self.layers
            .dit
            .forward(self.engine, pass, recorded, dit, output)?;
        self.decode(workspace)
    }

    /// Action rows to `workspace.encoded (batch, samples, action_horizon, width)`.
    pub(super) fn encode_actions(
        &self,
        timestep: impl Fn(usize) -> usize,
        workspace: &mut Workspace,
    ) -> Result<()> {
        let Workspace {
            embodiment_ids,
            x,
            tokens,
            encoded,
            linear,
            ..
        } = workspace;
        let noisy = NoisyRows { embodiment_ids, x };
        let encoder = &self.layers.action_encoder;
        encoder.encode(self.engine, &noisy, timestep, tokens, encoded, linear)
    }

    /// The velocity from the transformer's output rows, to `workspace.velocity (batch, samples, action_horizon, action_dim)`.
    fn decode(&self, workspace: &mut Workspace) -> Result<()> {
        let Workspace {
            embodiment_ids,
            output,
            decoder_hidden,
            decoded,
            velocity,
            linear,
            ..
        } = workspace;
        let linear: &mut LinearScratch = linear;
        let action_dim = self.config.action_dim;
        let rows = output.len() / self.config.hidden_dim;
        let velocity = sized(velocity, rows * action_dim)?;
        let mut first = 0; // column of the decoder's first output
        for decoder in &self.layers.decoders {
            let width = decoder.out_features();
            let decoded = decoder.apply(
                self.engine,
                embodiment_ids,
                output,
                decoder_hidden,
                decoded,
                linear,
            )?;
            for (row, decoded) in velocity
                .chunks_exact_mut(action_dim)
                .zip(decoded.chunks_exact(width))
            {
                row[first..first + width].copy_from_slice(decoded);
            }
            first += width;
        }
        Ok(())
    }

    /// `[state, future, action]` for each sequence, or those of them that run, to the transformer's residual stream.
    fn assemble_rows(&self, pass: &Pass<'_>, workspace: &mut Workspace) -> Result<()> {
        let Workspace {
            state, encoded, dit, ..
        } = workspace;
        if pass.rows == ActiveRows::Actions {
            sized(&mut dit.action, encoded.len())?.copy_from_slice(encoded);
            return Ok(());
        }
        let width = self.config.width;
        let actions = self.config.action_horizon * width;
        let sequence = pass.changes.extent.groups.num_rows() * width;
        let states = pass.changes.extent.groups.state * width;
        let future_tokens = pass.changes.extent.future_tokens;
        let h = sized(&mut dit.h, encoded.len() / actions * sequence)?;
        for (index, (h, action)) in h
            .chunks_exact_mut(sequence)
            .zip(encoded.chunks_exact(actions))
            .enumerate()
        {
            let element = index / pass.samples;
            let (h_state, rest) = h.split_at_mut(states);
            let (h_future, h_action) = rest.split_at_mut(future_tokens.len());
            h_state.copy_from_slice(&state[element * states..(element + 1) * states]);
            h_future.copy_from_slice(future_tokens);
            h_action.copy_from_slice(action);
        }
        Ok(())
    }
}
