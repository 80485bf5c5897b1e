//! The velocity of given noisy actions.

use saccade_vla_kernels::Rows;

use super::action_head::ActionHead;
use super::context::Context;
use super::dit::{ActiveRows, Pass};
use crate::array::{Array, ArrayMut};
use crate::error::Result;
use crate::inspect::compiled::CompiledInterventions;
use crate::inspect::intervention::Intervention;
use crate::inspect::trace::Recorded;

/// Noisy actions and their time.
#[derive(Clone, Copy, Debug)]
pub struct NoisyActions<'a> {
    /// `(batch, action_horizon, encoder_action_dim)`.
    pub actions: Array<'a>,
    /// The timestep, from 0 to `num_timestep_buckets - 1`: a scalar or `(batch,)`.
    pub timestep: Array<'a, i64>,
}

impl ActionHead {
    /// The velocity of noisy actions, to `out (batch, action_horizon, action_dim)`. `state` and
    /// `embodiment_id` are as for [`Self::sample`]. To the interventions it is step 0 of 1.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) and [`Error::Input`](crate::Error::Input) for arguments that do
    /// not fit and a velocity that is not finite; [`Error::Memory`](crate::Error::Memory). `out` is then
    /// untouched.
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
        let compiled =
            CompiledInterventions::new(interventions, self.call_sizes(interventions, context, 1)?)?;
        self.with_workspace(|workspace| {
            self.check_embodiments(embodiment_id, batch, &mut workspace.embodiment_ids)?;
            self.encode_state(state, workspace)?;
            let actions = Rows::new(actions.data(), self.config.encoder_action_dim);
            let x = &mut workspace.x;
            x.rows(actions.num_rows(), actions.num_columns())?
                .copy_from(actions);
            let pass = Pass {
                context,
                samples: 1,
                compiled: &compiled,
                step: 0,
                rows: ActiveRows::Needed,
            };
            self.evaluate(
                &pass,
                |observation| timesteps[observation],
                &mut Recorded::default(),
                workspace,
            )?;
            let velocity = workspace.velocity.as_slice();
            Array::new(velocity, &shape)?.check_result("velocity")?;
            out.copy_from_slice(velocity);
            Ok(())
        })
    }
}
