//! Embodiments whose state does not act.
//!
//! The class of GR00T-H keeps how often its training sets the state of each embodiment to zero in a tensor,
//! and at inference sets those to zero that it always did so for.

use saccade_vla_kernels::Rows;
use serde_json::Value;

use crate::alloc::Scratch;
use crate::config::CheckpointConfig;
use crate::error::{Error, Problem, Result, problem};
use crate::nn::sequences::Sequences;
use crate::nn::weights::Weights;

/// The probabilities' tensor, `(num_embodiments,)`.
pub(crate) const STATE_DROPOUT: &str = "dropout_prob_by_embodiment";

/// The key of the config that they come from, by tag: the class has the tensor only if there are some.
const CONFIG_KEY: &str = "state_dropout_prob_per_embodiment";

/// A state is set to zero at inference where the probability is above this.
const ALWAYS: f32 = 0.999;

/// Which embodiments' states are set to zero.
pub(crate) struct StateDropout {
    /// By embodiment; empty if there are none.
    drops: Vec<bool>,
}

/// True if a head with this config reads the tensor of probabilities; `is_there` says if there is one.
///
/// # Errors
/// [`Error::Checkpoint`] if the config says that states are set to zero and there is no tensor that says
/// which.
pub(super) fn reads_state_dropout(config: &str, is_there: bool) -> Result<bool> {
    let config = CheckpointConfig::parse(config)?;
    let Some(given) = config.get(CONFIG_KEY) else {
        return Ok(is_there);
    };
    let is_always = |probability: &Value| {
        probability
            .as_f64()
            .is_some_and(|value| value > f64::from(ALWAYS))
    };
    match given {
        Value::Object(by_tag) if !is_there && by_tag.values().any(is_always) => {
            Err(Error::Checkpoint(Problem::from(format!(
                "{STATE_DROPOUT} is missing, but {CONFIG_KEY} is {given} in the config: expected the tensor, which tells \
                 whose states are set to zero"
            ))))
        }
        // The released class then has no such tensor, and ignores that of a file.
        Value::Null | Value::Bool(false) => Ok(false),
        Value::Object(by_tag) => Ok(is_there && !by_tag.is_empty()),
        _ => Err(Error::Checkpoint(problem!(
            "config"; "{CONFIG_KEY} is {given}, expected a probability for each embodiment tag"
        ))),
    }
}

impl StateDropout {
    /// Of a head whose states all act.
    pub(super) fn none() -> Self {
        Self { drops: Vec::new() }
    }

    /// From the tensor of probabilities.
    ///
    /// # Errors
    /// As the source of the weights has them; [`Error::Checkpoint`] for a probability that is not finite.
    pub(super) fn read(weights: &Weights<'_>, num_embodiments: usize) -> Result<Self> {
        let probabilities = weights.bias(STATE_DROPOUT, num_embodiments)?;
        let drops: Vec<bool> = probabilities.iter().map(|&value| value > ALWAYS).collect();
        Ok(Self { drops })
    }

    /// The rows of states, equally many for each of the `embodiment_ids`, as the state encoder sees them: in
    /// `zeroed` if some are set to zero.
    pub(super) fn seen<'a>(
        &self,
        embodiment_ids: &[usize],
        states: Rows<'a>,
        zeroed: &'a mut Scratch,
    ) -> Result<Rows<'a>> {
        let is_dropped = |id: &usize| self.drops.get(*id) == Some(&true);
        if !embodiment_ids.iter().any(is_dropped) {
            return Ok(states);
        }
        let mut seen = zeroed.rows(states.num_rows(), states.num_columns())?;
        seen.copy_from(states);
        let observations = Sequences::new(states, embodiment_ids.len());
        for (id, rows) in observations.runs(embodiment_ids, |a, b| a == b) {
            if is_dropped(id) {
                seen.reborrow().rows(rows).fill(0.0);
            }
        }
        Ok(zeroed.as_rows())
    }
}
