//! Sampling chunks of actions, and its options.

use super::action_head::ActionHead;
use super::context::Context;
use super::dit::{ActiveRows, Pass};
use super::flow_matching::Steps;
use super::guidance::Guidance;
use crate::array::{Array, ArrayMut};
use crate::error::{Error, Result, bail};
use crate::inspect::compiled::CompiledInterventions;
use crate::inspect::intervention::Intervention;
use crate::inspect::trace::Recorded;
use crate::sampling::chunking::Chunking;
use crate::sampling::integrator::Integrator;

/// Options of sampling.
///
/// ```
/// use saccade_vla::{Integrator, Sampling};
/// let sampling = Sampling { num_steps: Some(8), integrator: Integrator::Midpoint, ..Sampling::default() };
/// assert_eq!(sampling.num_samples, None);
/// ```
#[derive(Clone, Copy, Debug, Default)]
pub struct Sampling<'a> {
    /// Steps, 1 to `num_timestep_buckets`; default the config's.
    pub num_steps: Option<usize>,
    /// The integration scheme. Interventions see one step, however many evaluations it takes.
    pub integrator: Integrator,
    /// Chunks for each observation; none adds no axis to noise and result.
    pub num_samples: Option<usize>,
    /// The rows of state and future tokens run at every `future_refresh`-th evaluation of the velocity,
    /// beginning with the first. At the others only the action rows run, and self-attention uses the keys and
    /// values that the other rows last had. `None` and 1 run all rows at every evaluation, which is exact.
    pub future_refresh: Option<usize>,
    /// The previous chunk, and how this one begins with its end; none starts from noise alone.
    pub chunking: Option<Chunking<'a>>,
    /// A second context, and how far the velocity is moved away from that of it; none samples the first
    /// alone. The velocities of both count at every evaluation.
    pub guidance: Option<Guidance<'a>>,
    /// Interventions inside the head, in both contexts of a guided call. Cuts and biases act on the rows that
    /// run; a patch of rows that do not is an error.
    pub interventions: &'a [Intervention],
}

impl ActionHead {
    /// Samples a chunk of actions by flow matching: integrates the velocity from `noise` in `num_steps`
    /// steps.
    ///
    /// `state` is `(batch, num_states, state_dim)`, or `(batch, state_dim)` where one is taken;
    /// `embodiment_id` a scalar or `(batch,)`; `noise` `(batch, action_horizon, encoder_action_dim)`, or
    /// `(batch, num_samples, action_horizon, encoder_action_dim)` with `num_samples`. `out` has the shape of
    /// the noise, with `action_dim` for its last axis.
    ///
    /// ```
    /// # use saccade_vla::{ActionHead, Array, ArrayMut, Features, LoadOptions, Sampling};
    /// # let head = ActionHead::load("examples/tiny".as_ref(), &LoadOptions::default())?;
    /// # let context = head.encode(&Features::new(Array::new(&[0.1; 640], &[1, 20, 32])?))?;
    /// let config = head.config();
    /// let state = Array::new(&[0.0; 8], &[1, 8])?;
    /// let noise_shape = [1, 3, config.action_horizon, config.encoder_action_dim];
    /// let noise = vec![0.5; noise_shape.iter().product()];
    /// let noise = Array::new(&noise, &noise_shape)?;
    /// // Three chunks in two steps each.
    /// let sampling = Sampling { num_samples: Some(3), num_steps: Some(2), ..Sampling::default() };
    /// let mut actions = vec![0.0; 3 * config.action_horizon * config.action_dim];
    /// let shape = [1, 3, config.action_horizon, config.action_dim];
    /// let out = ArrayMut::new(&mut actions, &shape)?;
    /// head.sample(&context, state, Array::new(&[0], &[])?, noise, &sampling, out)?;
    /// assert!(actions.iter().all(|action| action.is_finite()));
    /// # Ok::<(), saccade_vla::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for arguments that do not fit, [`Error::Input`] also for actions
    /// that are not finite; [`Error::Memory`]. `out` is then untouched.
    pub fn sample(
        &self,
        context: &Context,
        state: Array<'_>,
        embodiment_id: Array<'_, i64>,
        noise: Array<'_>,
        sampling: &Sampling<'_>,
        out: ArrayMut<'_>,
    ) -> Result<()> {
        self.check_context(context)?;
        let state = self.check_state(state, context.batch)?;
        let num_steps = self.check_num_steps(sampling.num_steps)?;
        let samples = self.check_noise(noise, context.batch, sampling.num_samples)?;
        let out = self.check_out(out, context.batch, sampling.num_samples)?;
        let seam = self.check_chunking(sampling, context.batch)?;
        let steps = Steps {
            count: num_steps,
            integrator: sampling.integrator,
            refresh: check_refresh(sampling.future_refresh)?,
        };
        let sizes = self.call_sizes(sampling.interventions, context, num_steps)?;
        let compiled = CompiledInterventions::new(sampling.interventions, sizes)?;
        compiled.check_refresh(steps.refresh, sampling.integrator.evaluations())?;
        let guidance = sampling.guidance.as_ref();
        let guided = self.guided(guidance, sampling.interventions, context.batch, num_steps)?;
        let pass = Pass {
            context,
            samples,
            compiled: &compiled,
            step: 0,
            rows: ActiveRows::Needed,
        };
        self.with_workspace(|workspace| {
            self.check_embodiments(embodiment_id, context.batch, &mut workspace.embodiment_ids)?;
            self.encode_state(state, workspace)?;
            self.begin(noise.data(), seam.as_ref(), samples, workspace)?;
            self.integrate(&pass, guided.as_ref(), steps, &mut Recorded::default(), workspace)?;
            self.copy_actions(workspace.x.as_rows(), noise.shape(), out)
        })
    }
}

/// The number of evaluations from one that runs all rows to the next.
pub(super) fn check_refresh(future_refresh: Option<usize>) -> Result<usize> {
    match future_refresh {
        Some(0) => bail!(Input, "future_refresh"; expected "at least 1"; got "0"),
        given => Ok(given.unwrap_or(1)),
    }
}
