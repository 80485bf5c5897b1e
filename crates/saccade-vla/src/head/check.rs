//! Checks of the arguments of a call: that they fit the head and each other.

use super::action_head::ActionHead;
use super::context::Context;
use super::sample::Sampling;
use crate::alloc::reserve;
use crate::array::{Array, ArrayMut};
use crate::error::{Error, Problem, Result, bail, ensure, problem, show_shape};
use crate::inspect::call_sizes::CallSizes;
use crate::inspect::intervention::Intervention;
use crate::sampling::chunking::Seam;

impl ActionHead {
    pub(super) fn check_context(&self, context: &Context) -> Result<()> {
        ensure!(
            context.head == self.id, Input, "context";
            expected "one that this head encoded"; got "that of another head"
        );
        Ok(())
    }

    pub(super) fn check_state<'a>(&self, state: Array<'a>, batch: usize) -> Result<&'a [f32]> {
        let (count, width) = (self.config.num_states, self.config.state_dim);
        let is_one_state = count == 1 && state.shape() == [batch, width];
        if !is_one_state && state.shape() != [batch, count, width] {
            let axes = match count {
                1 => format!(
                    "(batch, state_dim) = {} or (batch, num_states, state_dim)",
                    show_shape(&[batch, width])
                ),
                _ => format!("the last {count} states, (batch, num_states, state_dim)"),
            };
            bail!(
                Shape, "state";
                expected "{axes} = {}, normalised and zero-padded to state_dim as the checkpoint's normaliser does",
                show_shape(&[batch, count, width]);
                got "{}", show_shape(state.shape())
            );
        }
        Ok(state.check_finite("state")?.data())
    }

    pub(super) fn check_num_steps(&self, num_steps: Option<usize>) -> Result<usize> {
        let num_steps = num_steps.unwrap_or(self.config.num_steps);
        let buckets = self.config.num_timestep_buckets;
        ensure!(
            (1..=buckets).contains(&num_steps), Input, "num_steps";
            expected "1 to {buckets} (num_timestep_buckets)"; got "{num_steps}"
        );
        Ok(num_steps)
    }

    /// Checks the noise; returns the number of samples per observation.
    pub(super) fn check_noise(
        &self,
        noise: Array<'_>,
        batch: usize,
        num_samples: Option<usize>,
    ) -> Result<usize> {
        let (horizon, width) = (self.config.action_horizon, self.config.encoder_action_dim);
        match num_samples {
            None => {
                let axes = "(batch, action_horizon, encoder_action_dim)";
                noise.check_shape("noise", axes, &[batch, horizon, width])?;
            }
            Some(0) => return Err(Error::Input(Problem::expected("num_samples", "at least 1", "0"))),
            Some(samples) => {
                let axes = "(batch, num_samples, action_horizon, encoder_action_dim)";
                noise.check_shape("noise", axes, &[batch, samples, horizon, width])?;
            }
        }
        noise.check_finite("noise")?;
        Ok(num_samples.unwrap_or(1))
    }

    /// The elements of `out`, whose shape is that of the noise but for the width of an action.
    pub(super) fn check_out<'a>(
        &self,
        out: ArrayMut<'a>,
        batch: usize,
        num_samples: Option<usize>,
    ) -> Result<&'a mut [f32]> {
        let (horizon, width) = (self.config.action_horizon, self.config.action_dim);
        match num_samples {
            None => out.check_shape(
                "out",
                "(batch, action_horizon, action_dim)",
                &[batch, horizon, width],
            ),
            Some(samples) => {
                let axes = "(batch, num_samples, action_horizon, action_dim)";
                out.check_shape("out", axes, &[batch, samples, horizon, width])
            }
        }
    }

    pub(super) fn check_chunking<'a>(
        &self,
        sampling: &Sampling<'a>,
        batch: usize,
    ) -> Result<Option<Seam<'a>>> {
        let chunking = sampling.chunking.as_ref();
        chunking
            .map(|chunking| chunking.check(&self.config, batch))
            .transpose()
    }

    pub(super) fn check_embodiments(
        &self,
        ids: Array<'_, i64>,
        batch: usize,
        checked: &mut Vec<usize>,
    ) -> Result<()> {
        for_batch("embodiment_id", ids, batch, checked, |id| {
            let loaded = usize::try_from(id).ok();
            let loaded = loaded.filter(|id| self.embodiment_ids.contains(id));
            loaded.ok_or_else(|| self.embodiment_error(id))
        })
    }

    fn embodiment_error(&self, id: i64) -> Error {
        let last = self.config.num_embodiments - 1;
        if (0..=last as i64).contains(&id) {
            return Error::Input(problem!(
                "embodiment_id"; "{id} is not loaded, only {:?} are", self.embodiment_ids
            ));
        }
        Error::Input(problem!("embodiment_id"; expected "0 to {last}"; got "{id}"))
    }

    /// The sizes of a call on `context`.
    pub(super) fn call_sizes<'a>(
        &'a self,
        interventions: &'a [Intervention],
        context: &Context,
        num_steps: usize,
    ) -> Result<CallSizes<'a>> {
        let learned = self.layers.future_tokens.data();
        let tokens = [context.batch, context.num_vl_tokens];
        CallSizes::new(&self.config, learned, interventions, tokens, num_steps)
    }

    pub(super) fn check_timestep(&self, timestep: Array<'_, i64>, batch: usize) -> Result<Vec<usize>> {
        let last = self.config.num_timestep_buckets - 1;
        let mut timesteps = Vec::new();
        for_batch("timestep", timestep, batch, &mut timesteps, |given| {
            let timestep = usize::try_from(given).ok().filter(|timestep| *timestep <= last);
            timestep.ok_or_else(|| {
                Error::Input(problem!("timestep"; expected "a bucket from 0 to {last}"; got "{given}"))
            })
        })?;
        Ok(timesteps)
    }
}

/// The `given` scalar or `(batch,)`, each checked by `check`, for each observation of a batch.
fn for_batch(
    name: &'static str,
    given: Array<'_, i64>,
    batch: usize,
    checked: &mut Vec<usize>,
    check: impl Fn(i64) -> Result<usize>,
) -> Result<()> {
    checked.clear();
    reserve(name, checked, batch)?;
    if !given.shape().is_empty() {
        given.check_shape(name, "(batch,)", &[batch])?;
    }
    for &given in given.data() {
        checked.push(check(given)?);
    }
    checked.resize(batch, checked[0]);
    Ok(())
}
