//! Sampling a chunk and keeping what goes on inside.

use super::action_head::ActionHead;
use super::context::Context;
use super::dit::{ActiveRows, Pass};
use super::flow_matching::Steps;
use super::sample::Sampling;
use crate::alloc::filled;
use crate::array::{Array, OwnedArray};
use crate::error::{Error, Result, bail, ensure};
use crate::inspect::compiled::CompiledInterventions;
use crate::inspect::groups::Groups;
use crate::inspect::trace::{Recorded, Shapes, StepBlock, Trace, TraceOptions};
use crate::sampling::integrator::Integrator;

impl ActionHead {
    /// As [`Self::sample`], and keeps what goes on inside. All rows are computed in every block, the last
    /// included.
    ///
    /// There is one chunk and one context for each observation, and all rows run at every step:
    /// `sampling.num_samples`, `sampling.guidance` and `sampling.future_refresh` must be none, and
    /// `sampling.integrator` Euler's.
    ///
    /// ```
    /// # use saccade_vla::{ActionHead, Array, Features, Keep, LoadOptions, Sampling, TraceOptions};
    /// # let head = ActionHead::load("examples/tiny".as_ref(), &LoadOptions::default())?;
    /// # let context = head.encode(&Features::new(Array::new(&[0.1; 640], &[1, 20, 32])?))?;
    /// # let (state, noise) = (Array::new(&[0.0; 8], &[1, 8])?, Array::new(&[0.5; 128], &[1, 16, 8])?);
    /// let record = Keep { attention: true, ..Keep::default() };
    /// let options = TraceOptions { record, ..TraceOptions::default() };
    /// let trace = head.trace(&context, state, Array::new(&[0], &[])?, noise, &Sampling::default(), &options)?;
    /// let attention = &trace.recorded.attention[&(0, 0)]; // of the first step and block
    /// assert_eq!(attention.shape()[0], 1); // (batch, heads, queries, keys)
    /// assert_eq!(attention.shape()[3], 20);
    /// # Ok::<(), saccade_vla::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for arguments that do not fit, for a trace of more than
    /// `options.max_bytes`, and for actions that are not finite; [`Error::Memory`].
    pub fn trace(
        &self,
        context: &Context,
        state: Array<'_>,
        embodiment_id: Array<'_, i64>,
        noise: Array<'_>,
        sampling: &Sampling<'_>,
        options: &TraceOptions,
    ) -> Result<Trace> {
        self.check_context(context)?;
        check_traceable(sampling)?;
        let (batch, config) = (context.batch, &self.config);
        let state = self.check_state(state, batch)?;
        let num_steps = self.check_num_steps(sampling.num_steps)?;
        let samples = self.check_noise(noise, batch, None)?;
        let seam = self.check_chunking(sampling, batch)?;
        let sizes = self.call_sizes(sampling.interventions, context, num_steps)?;
        let groups = sizes.groups;
        let chosen = options.chosen(num_steps, config.num_layers)?;
        let shapes: Vec<_> = chosen
            .into_iter()
            .map(|key| (key, self.shapes(&groups, batch, key)))
            .collect();
        // Before the interventions are worked out, since that takes memory too.
        let mut recorded = Recorded::allocate("max_bytes", options.record, &shapes, options.max_bytes)?;
        let compiled = CompiledInterventions::new(sampling.interventions, sizes)?;
        let pass = Pass {
            context,
            samples,
            compiled: &compiled,
            step: 0,
            rows: ActiveRows::All,
        };
        let steps = Steps {
            count: num_steps,
            integrator: Integrator::Euler,
            refresh: 1,
        };
        self.with_workspace(|workspace| {
            self.check_embodiments(embodiment_id, batch, &mut workspace.embodiment_ids)?;
            self.encode_state(state, workspace)?;
            self.begin(noise.data(), seam.as_ref(), samples, workspace)?;
            self.integrate(&pass, None, steps, &mut recorded, workspace)?;
            let shape = [batch, config.action_horizon, config.action_dim];
            let mut actions = filled("actions", shape.iter().product(), 0.0)?;
            self.copy_actions(workspace.x.as_rows(), noise.shape(), &mut actions)?;
            Ok(Trace {
                recorded,
                groups,
                actions: OwnedArray::new(actions, &shape)?,
            })
        })
    }

    /// The shapes of what a block of a step has.
    fn shapes(&self, groups: &Groups, batch: usize, (_, block): StepBlock) -> Shapes {
        let config = &self.config;
        let rows = groups.num_rows();
        let keys = if config.is_cross(block) { groups.vl } else { rows };
        Shapes {
            attention: [batch, config.num_heads, rows, keys],
            hidden: [batch, rows, config.width],
        }
    }
}

/// Checks that a trace can be made of a call with these options.
fn check_traceable(sampling: &Sampling<'_>) -> Result<()> {
    if let Some(samples) = sampling.num_samples {
        bail!(
            Input, "num_samples";
            expected "none, since a trace is of one chunk an observation"; got "{samples}"
        );
    }
    ensure!(
        sampling.integrator == Integrator::Euler, Input, "integrator";
        expected "euler, since a trace has one evaluation a step"; got "midpoint"
    );
    ensure!(
        sampling.guidance.is_none(), Input, "guidance"; "expected none, since a trace is of one context"
    );
    if let Some(refresh) = sampling.future_refresh {
        bail!(
            Input, "future_refresh";
            expected "none, since a trace is of all rows at every step"; got "{refresh}"
        );
    }
    Ok(())
}
