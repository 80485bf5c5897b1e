//! Flow matching: the velocity of noisy actions, and its integration from noise to actions, in the order in
//! which it is computed.
//!
//! Equations 2, 6, 13 and 15 of docs/equations.md.

use std::sync::Arc;

use saccade_vla_kernels::{Rows, RowsMut};

use super::action_head::ActionHead;
use super::dit::{ActiveRows, Pass};
use super::guidance::Guided;
use super::workspace::Workspace;
use crate::alloc::reserve;
use crate::array::not_finite;
use crate::engine::Kernels;
use crate::error::Result;
use crate::inspect::trace::{Recorded, StepBlock};
use crate::ops::check_interrupted;
use crate::sampling::chunking::Seam;
use crate::sampling::integrator::Integrator;
use crate::sampling::timestep::timestep;

/// The steps of an integration of the velocity.
#[derive(Clone, Copy)]
pub(super) struct Steps {
    pub count: usize,
    pub integrator: Integrator,
    /// All rows run at the evaluations that this divides.
    pub refresh: usize,
}

impl ActionHead {
    /// The state rows of each observation, to `workspace.state`; of zeros for embodiments whose state does
    /// not act.
    pub(super) fn encode_state(&self, state: &[f32], workspace: &mut Workspace) -> Result<()> {
        let ids = &workspace.embodiment_ids;
        let encoder = &self.layers.state_encoder;
        let state = Rows::new(state, encoder.in_features());
        let state = self.state_dropout.seen(ids, state, &mut workspace.zeroed_state)?;
        let kernels = &mut Kernels::new(self.engine, &mut workspace.linear);
        let (hidden, encoded) = (&mut workspace.state_hidden, &mut workspace.state);
        encoder.apply(kernels, ids, state, hidden, encoded)?;
        Ok(())
    }

    /// The start of a chunk, to `workspace.x`: noise, and the end of the previous chunk if there is one.
    /// Elements that no decoder moves are zero.
    pub(super) fn begin(
        &self,
        noise: &[f32],
        seam: Option<&Seam<'_>>,
        samples: usize,
        workspace: &mut Workspace,
    ) -> Result<()> {
        let Workspace { x, strength, .. } = workspace;
        let (horizon, width) = (self.config.action_horizon, self.config.encoder_action_dim);
        let noise = Rows::new(noise, width);
        let mut x = x.rows(noise.num_rows(), width)?;
        x.copy_from(noise);
        strength.clear();
        reserve("activations", strength, horizon)?;
        strength.extend((0..horizon).map(|index| seam.map_or(1.0, |seam| seam.strength(index))));
        if let Some(seam) = seam {
            seam.begin(samples, horizon, x.reborrow());
        }
        x.columns(self.config.action_dim..width).fill(0.0);
        Ok(())
    }

    /// Integrates the velocity from the noise in `workspace.x` to the actions in equal steps, in place.
    pub(super) fn integrate(
        &self,
        pass: &Pass<'_>,
        guided: Option<&Guided<'_>>,
        steps: Steps,
        recorded: &mut Recorded<StepBlock>,
        workspace: &mut Workspace,
    ) -> Result<()> {
        let dt = 1.0 / steps.count as f32;
        let in_step = steps.integrator.evaluations();
        let count = steps.count * in_step;
        let refreshes = |evaluation: usize| evaluation.is_multiple_of(steps.refresh);
        for evaluation in 0..count {
            check_interrupted()?;
            let step = evaluation / in_step;
            let timestep = timestep(evaluation, count, self.config.num_timestep_buckets);
            let rows = if !refreshes(evaluation) {
                ActiveRows::Actions
            } else if evaluation + 1 < count && !refreshes(evaluation + 1) {
                ActiveRows::NeededAndHeld
            } else {
                pass.rows
            };
            let pass = &Pass { step, rows, ..*pass };
            self.evaluate(pass, |_| timestep, recorded, workspace)?;
            if let Some(guided) = guided {
                self.guide(guided, pass, workspace)?;
            }
            let (v, x) = (workspace.velocity.as_rows(), workspace.x.as_rows_mut());
            let (strength, start) = (&workspace.strength, &mut workspace.start);
            let stage = evaluation % in_step;
            steps.integrator.advance(stage, dt, v, strength, x, start)?;
        }
        Ok(())
    }

    /// The velocity of the noisy actions in `workspace.x`, to `workspace.velocity`. `timestep` gives the
    /// timestep of an observation.
    pub(super) fn evaluate(
        &self,
        pass: &Pass<'_>,
        timestep: impl Fn(usize) -> usize,
        recorded: &mut Recorded<StepBlock>,
        workspace: &mut Workspace,
    ) -> Result<()> {
        let times = &mut workspace.input.times;
        times.clear();
        reserve("activations", times, pass.context.batch)?;
        let mut last = None;
        for observation in 0..pass.context.batch {
            let timestep = timestep(observation);
            if last != Some(timestep) {
                last = Some(timestep);
                times.push(self.layers.dit.time(self.engine, timestep)?);
            } else {
                times.push(Arc::clone(&times[observation - 1]));
            }
        }
        let kernels = &mut Kernels::new(self.engine, &mut workspace.linear);
        let (ids, x) = (&workspace.embodiment_ids, workspace.x.as_rows());
        let (hidden, action) = (&mut workspace.action_hidden, &mut workspace.action);
        let encoder = &self.layers.action_encoder;
        encoder.encode(kernels, ids, x, timestep, hidden, action)?;
        self.assemble_rows(pass, workspace)?;
        self.decode(pass, recorded, workspace)
    }

    /// `[state, future, action]` for each sequence, or those of them that run, to the transformer's residual
    /// stream.
    pub(super) fn assemble_rows(&self, pass: &Pass<'_>, workspace: &mut Workspace) -> Result<()> {
        let (input, width) = (&mut workspace.input, self.config.width);
        let (state, action) = (workspace.state.as_rows(), workspace.action.as_rows());
        if pass.rows == ActiveRows::Actions {
            input.action.rows(action.num_rows(), width)?.copy_from(action);
            return Ok(());
        }
        let groups = &pass.compiled.sizes.groups;
        let future = Rows::new(pass.compiled.sizes.future_tokens, width);
        let sequences = pass.context.batch * pass.samples;
        let mut h = input.h.rows(sequences * groups.num_rows(), width)?;
        for sequence in 0..sequences {
            let observation = sequence / pass.samples;
            let parts = [
                state.rows(observation * groups.state..(observation + 1) * groups.state),
                future,
                action.rows(sequence * groups.action..(sequence + 1) * groups.action),
            ];
            let mut first = sequence * groups.num_rows();
            for part in parts {
                let rows = first..first + part.num_rows();
                first = rows.end;
                h.reborrow().rows(rows).copy_from(part);
            }
        }
        Ok(())
    }

    /// The transformer, and the velocity that the decoders make of its output rows, to `workspace.velocity`.
    pub(super) fn decode(
        &self,
        pass: &Pass<'_>,
        recorded: &mut Recorded<StepBlock>,
        workspace: &mut Workspace,
    ) -> Result<()> {
        let kernels = &mut Kernels::new(self.engine, &mut workspace.linear);
        let (input, dit) = (&mut workspace.input, &mut workspace.dit);
        let output = self.layers.dit.forward(kernels, pass, input, recorded, dit)?;
        let velocity = &mut workspace.velocity;
        let mut velocity = velocity.rows(output.num_rows(), self.config.action_dim)?;
        let (hidden, decoded) = (&mut workspace.decoder_hidden, &mut workspace.decoded);
        let mut first = 0;
        for decoder in &self.layers.decoders {
            let decoded = decoder.apply(kernels, &workspace.embodiment_ids, output, hidden, decoded)?;
            let columns = first..first + decoded.num_columns();
            first = columns.end;
            velocity.reborrow().columns(columns).copy_from(decoded);
        }
        Ok(())
    }

    /// Copies the actions in `x`, without the elements that no decoder moves. `shape` is that of the noise.
    ///
    /// # Errors
    /// [`Error::Input`] if one is not finite: a robot must not get it.
    pub(super) fn copy_actions(&self, x: Rows<'_>, shape: &[usize], out: &mut [f32]) -> Result<()> {
        let actions = x.columns(0..self.config.action_dim);
        for (row, action) in actions.iter().enumerate() {
            if let Some(column) = action.iter().position(|value| !value.is_finite()) {
                let position = row * x.num_columns() + column;
                return Err(not_finite("actions", action[column], position, shape));
            }
        }
        RowsMut::new(out, self.config.action_dim).copy_from(actions);
        Ok(())
    }
}
