//! Sampling a chunk of actions (spec 1.8): steps from noise along the velocity.

use super::action_head::ActionHead;
use super::context::Context;
use super::dit::{ActiveRows, Pass};
use super::workspace::Workspace;
use crate::alloc::{reserve, sized};
use crate::array::{Array, ArrayMut, unravel};
use crate::error::{Error, Result, problem, show_shape};
use crate::inspect::changes::Changes;
use crate::inspect::intervention::Intervention;
use crate::inspect::trace::{Recorded, StepBlock};
use crate::ops::check_interrupted;
use crate::sampling::chunking::{Chunking, Seam};
use crate::sampling::integrator::{Integrator, Velocity};
use crate::sampling::timestep::timestep;

/// How a chunk is sampled.
///
/// ```
/// use saccade_vla::{Integrator, Sampling};
/// let sampling = Sampling::default().with_num_steps(8).with_integrator(Integrator::Midpoint);
/// assert_eq!((sampling.num_steps, sampling.num_samples), (Some(8), None));
/// ```
#[derive(Clone, Copy, Debug, Default)]
#[non_exhaustive]
pub struct Sampling<'a> {
    /// Steps, 1 to `num_timestep_buckets`; default the config's.
    pub num_steps: Option<usize>,
    /// What a step is. To the interventions all evaluations of a step are that step.
    pub integrator: Integrator,
    /// Chunks for each observation; none adds no axis to noise and result.
    pub num_samples: Option<usize>,
    /// The rows of state and future tokens run at every `future_refresh`-th evaluation of the velocity, beginning with the first. At the
    /// others only the action rows run, and self-attention uses the keys and values that the other rows last had. `None` and 1 run all rows
    /// at every evaluation, which is exact.
    pub future_refresh: Option<usize>,
    /// The previous chunk, and how this one begins with its end; none starts from noise alone.
    pub chunking: Option<Chunking<'a>>,
    /// What to change inside the head. Cuts and biases act on the rows that run; a patch of rows that do not is an error.
    pub interventions: &'a [Intervention],
}

impl<'a> Sampling<'a> {
    /// With this number of steps.
    #[must_use]
    pub fn with_num_steps(self, num_steps: impl Into<Option<usize>>) -> Self {
        Self {
            num_steps: num_steps.into(),
            ..self
        }
    }

    /// With this integrator.
    #[must_use]
    pub fn with_integrator(self, integrator: Integrator) -> Self {
        Self { integrator, ..self }
    }

    /// With this number of chunks for each observation.
    #[must_use]
    pub fn with_num_samples(self, num_samples: impl Into<Option<usize>>) -> Self {
        Self {
            num_samples: num_samples.into(),
            ..self
        }
    }

    /// Running the rows of state and future tokens at every `future_refresh`-th evaluation only.
    #[must_use]
    pub fn with_future_refresh(self, future_refresh: impl Into<Option<usize>>) -> Self {
        Self {
            future_refresh: future_refresh.into(),
            ..self
        }
    }

    /// Beginning with the end of the previous chunk.
    #[must_use]
    pub fn with_chunking(self, chunking: impl Into<Option<Chunking<'a>>>) -> Self {
        Self {
            chunking: chunking.into(),
            ..self
        }
    }

    /// With these changes.
    #[must_use]
    pub fn with_interventions(self, interventions: &'a [Intervention]) -> Self {
        Self {
            interventions,
            ..self
        }
    }
}

/// How the velocity is followed.
#[derive(Clone, Copy)]
pub(super) struct Steps {
    pub count: usize,
    pub integrator: Integrator,
    /// All rows run at the evaluations that this divides.
    pub refresh: usize,
}

impl ActionHead {
    /// Samples a chunk of actions: Euler steps from `noise` (spec 1.8).
    ///
    /// `state` is `(batch, num_states, state_dim)`, or `(batch, state_dim)` where one is taken; `embodiment_id` a scalar or `(batch,)`;
    /// `noise` `(batch, action_horizon, encoder_action_dim)`, or `(batch, num_samples, action_horizon, encoder_action_dim)` with
    /// `num_samples`. `out` has the shape of the noise, with `action_dim` for its last axis.
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
    /// let sampling = Sampling::default().with_num_samples(3).with_num_steps(2);
    /// let mut actions = vec![0.0; 3 * config.action_horizon * config.action_dim];
    /// let shape = [1, 3, config.action_horizon, config.action_dim];
    /// let out = ArrayMut::new(&mut actions, &shape)?;
    /// head.sample(&context, state, Array::new(&[0], &[])?, noise, &sampling, out)?;
    /// assert!(actions.iter().all(|action| action.is_finite()));
    /// # Ok::<(), saccade_vla::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for arguments that do not fit, [`Error::Input`] also for actions that are not finite;
    /// [`Error::Memory`]. `out` is then untouched.
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
        let extent = self.extent(sampling.interventions, context, num_steps)?;
        let changes = Changes::new(sampling.interventions, extent)?;
        changes.check_refresh(steps.refresh, sampling.integrator.evaluations())?;
        let pass = Pass {
            context,
            samples,
            changes: &changes,
            step: 0,
            rows: ActiveRows::Needed,
        };
        self.with_workspace(|workspace| {
            self.check_embodiments(embodiment_id, context.batch, &mut workspace.embodiment_ids)?;
            self.encode_state(state, workspace)?;
            self.begin(noise.data(), seam.as_ref(), samples, workspace)?;
            self.follow(&pass, steps, &mut Recorded::default(), workspace)?;
            self.copy_actions(&workspace.x, noise.shape(), out)
        })
    }

    /// What a chunk starts from, to `workspace.x (batch, samples, action_horizon, encoder_action_dim)`: noise, and the end of the previous chunk
    /// if there is one. What no decoder moves is zero.
    pub(super) fn begin(
        &self,
        noise: &[f32],
        seam: Option<&Seam<'_>>,
        samples: usize,
        workspace: &mut Workspace,
    ) -> Result<()> {
        let Workspace { x, strength, .. } = workspace;
        let (horizon, width) = (self.config.action_horizon, self.config.encoder_action_dim);
        let x = sized(x, noise.len())?;
        x.copy_from_slice(noise);
        let strength = sized(strength, horizon)?;
        strength.fill(1.0);
        if let Some(seam) = seam {
            seam.begin(samples, horizon, width, x);
            for (index, strength) in strength.iter_mut().enumerate() {
                *strength = seam.strength(index);
            }
        }
        for row in x.chunks_exact_mut(width) {
            row[self.config.action_dim..].fill(0.0);
        }
        Ok(())
    }

    /// Follows the velocity from `workspace.x` to the actions in equal steps, in place.
    pub(super) fn follow(
        &self,
        pass: &Pass<'_>,
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
            let times = &mut workspace.dit.times;
            times.clear();
            reserve("activations", times, pass.context.batch)?;
            times.resize(pass.context.batch, self.layers.dit.time(self.engine, timestep)?);
            let rows = if !refreshes(evaluation) {
                ActiveRows::Actions
            } else if evaluation + 1 < count && !refreshes(evaluation + 1) {
                ActiveRows::NeededAndHeld
            } else {
                pass.rows
            };
            self.step_velocity(&Pass { step, rows, ..*pass }, |_| timestep, recorded, workspace)?;
            let Workspace {
                x,
                start,
                strength,
                velocity,
                ..
            } = &mut *workspace;
            let velocity = Velocity {
                values: velocity,
                action_dim: self.config.action_dim,
                strength,
            };
            let width = self.config.encoder_action_dim;
            steps
                .integrator
                .advance(evaluation % in_step, dt, &velocity, x, width, start)?;
        }
        Ok(())
    }

    /// The actions as they are returned: without what no decoder moves. `shape` is that of `x`.
    ///
    /// # Errors
    /// [`Error::Input`] if one is not finite: a robot must not get it.
    pub(super) fn copy_actions(&self, x: &[f32], shape: &[usize], out: &mut [f32]) -> Result<()> {
        let (width, action_dim) = (self.config.encoder_action_dim, self.config.action_dim);
        let rows = || x.chunks_exact(width).map(|row| &row[..action_dim]);
        let is_bad = |row: &[f32]| row.iter().any(|value| !value.is_finite());
        if let Some(row) = rows().position(is_bad) {
            let column = x[row * width..].iter().position(|value| !value.is_finite());
            let position = row * width + column.unwrap_or(0);
            return Err(Error::Input(problem!(
                "actions";
                "the result is not finite, {} at index {}: inputs or weights are too large for the arithmetic",
                x[position], show_shape(&unravel(position, shape))
            )));
        }
        for (row, out) in rows().zip(out.chunks_exact_mut(action_dim)) {
            out.copy_from_slice(row);
        }
        Ok(())
    }
}

/// The number of evaluations from one that runs all rows to the next.
pub(super) fn check_refresh(future_refresh: Option<usize>) -> Result<usize> {
    match future_refresh {
        Some(0) => Err(Error::Input(problem!(
            "future_refresh"; expected "at least 1"; got "0"
        ))),
        given => Ok(given.unwrap_or(1)),
    }
}
