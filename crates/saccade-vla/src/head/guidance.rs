//! Guidance: a velocity that is moved away from that of a second context (equation 54 of
//! docs/equations.md).

use std::fmt;
use std::mem::swap;

use super::action_head::ActionHead;
use super::context::Context;
use super::dit::Pass;
use super::workspace::Workspace;
use crate::error::{Error, Result, ensure, problem};
use crate::inspect::compiled::CompiledInterventions;
use crate::inspect::intervention::Intervention;
use crate::inspect::trace::Recorded;

/// A second context of the same observations, such as one without their instructions, and a weight `w`: with
/// the velocities `v` of the first and `u` of the second, sampling follows `u + w (v - u)`.
///
/// ```
/// # use saccade_vla::{ActionHead, Array, ArrayMut, Features, Guidance, LoadOptions, Sampling};
/// # let head = ActionHead::load("examples/tiny".as_ref(), &LoadOptions::default())?;
/// # let (state, noise) = (Array::new(&[0.0; 8], &[1, 8])?, Array::new(&[0.5; 128], &[1, 16, 8])?);
/// let context = head.encode(&Features::new(Array::new(&[0.1; 640], &[1, 20, 32])?))?;
/// let without = head.encode(&Features::new(Array::new(&[0.2; 576], &[1, 18, 32])?))?;
/// let sampling = Sampling {
///     guidance: Some(Guidance { without: &without, weight: 2.0 }),
///     ..Sampling::default()
/// };
/// let mut actions = [0.0; 128];
/// let out = ArrayMut::new(&mut actions, &[1, 16, 8])?;
/// head.sample(&context, state, Array::new(&[0], &[])?, noise, &sampling, out)?;
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Clone, Copy)]
pub struct Guidance<'a> {
    /// Encoded by the same head, with as many observations as the first context. The numbers of
    /// vision-language tokens may differ.
    pub without: &'a Context,
    /// At least 0, rounded to float32. 1 samples the first context alone, and costs nothing; 0 has the result of
    /// the second.
    pub weight: f64,
}

impl fmt::Debug for Guidance<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Guidance")
            .field("weight", &self.weight)
            .finish_non_exhaustive()
    }
}

/// [`Guidance`], checked, of a call in which the second context counts.
pub(super) struct Guided<'a> {
    without: &'a Context,
    weight: f32,
    /// The interventions in the second context, whose vision-language tokens are others.
    compiled: CompiledInterventions<'a>,
}

impl ActionHead {
    /// None if the first context alone counts.
    ///
    /// # Errors
    /// [`Error::Input`] for a weight that is no number of at least 0, and for a second context that is not of
    /// this head, of other observations, or that the interventions do not fit.
    pub(super) fn guided<'a>(
        &'a self,
        guidance: Option<&Guidance<'a>>,
        interventions: &'a [Intervention],
        batch: usize,
        num_steps: usize,
    ) -> Result<Option<Guided<'a>>> {
        let Some(&Guidance { without, weight }) = guidance else {
            return Ok(None);
        };
        let rounded = weight as f32;
        // Of the number that was given: a small one below 0 is rounded to -0, which is at least 0.
        ensure!(
            rounded.is_finite() && weight >= 0.0, Input, "guidance";
            expected "a finite number of at least 0"; got "{weight}"
        );
        ensure!(
            without.head == self.id, Input, "without";
            expected "a context that this head encoded"; got "that of another head"
        );
        ensure!(
            without.batch == batch, Input, "without";
            expected "a context of {batch} observations, as the first one is"; got "{}", without.batch
        );
        if rounded == 1.0 {
            return Ok(None);
        }
        let compiled = self
            .call_sizes(interventions, without, num_steps)
            .and_then(|sizes| CompiledInterventions::new(interventions, sizes))
            .map_err(|error| match error {
                Error::Shape(problem) | Error::Input(problem) => Error::Input(problem!(
                    "without";
                    "the intervention does not fit this context of {} vision-language tokens: {problem}",
                    without.num_vl_tokens
                )),
                other => other,
            })?;
        Ok(Some(Guided {
            without,
            weight: rounded,
            compiled,
        }))
    }

    /// Moves the velocity that was evaluated in the first context away from that of the second.
    pub(super) fn guide(
        &self,
        guided: &Guided<'_>,
        pass: &Pass<'_>,
        workspace: &mut Workspace,
    ) -> Result<()> {
        let pass = Pass {
            context: guided.without,
            compiled: &guided.compiled,
            ..*pass
        };
        // The state and action rows are the same. The transformer has its own memory in each context, because it may
        // hold keys and values from one evaluation to the next.
        swap(&mut workspace.velocity, &mut workspace.other_velocity);
        swap(&mut workspace.dit, &mut workspace.other_dit);
        let evaluated = self
            .assemble_rows(&pass, workspace)
            .and_then(|()| self.decode(&pass, &mut Recorded::default(), workspace));
        swap(&mut workspace.dit, &mut workspace.other_dit);
        evaluated?;
        let with = workspace.other_velocity.as_slice();
        for (velocity, with) in workspace.velocity.as_mut_slice().iter_mut().zip(with) {
            *velocity += guided.weight * (with - *velocity);
        }
        Ok(())
    }
}
