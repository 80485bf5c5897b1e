//! The sizes of one call: observations, steps and tokens.

use super::groups::Groups;
use super::intervention::Intervention;
use crate::config::HeadConfig;
use crate::error::{Error, Result, ensure, show_shape};

/// The sizes of one call.
#[derive(Clone, Copy)]
pub(crate) struct CallSizes<'a> {
    pub config: &'a HeadConfig,
    pub batch: usize,
    pub num_steps: usize,
    /// `(groups.future, width)`: the learned ones, or those in their place.
    pub future_tokens: &'a [f32],
    /// What is added to the logits of these keys, with or without an intervention.
    pub future_key_bias: Option<&'a [f32]>,
    pub groups: Groups,
}

impl<'a> CallSizes<'a> {
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for future tokens that cannot replace the learned ones.
    pub(crate) fn new(
        config: &'a HeadConfig,
        learned: &'a [f32],
        interventions: &'a [Intervention],
        [batch, num_vl_tokens]: [usize; 2],
        num_steps: usize,
    ) -> Result<Self> {
        let replaced = replaced_future_tokens(interventions, config.width)?;
        let future_tokens = replaced.unwrap_or(learned);
        // The config's biases are those of the learned tokens.
        let future_key_bias = match replaced {
            None => config.future_key_bias.as_deref(),
            Some(_) => None,
        };
        Ok(Self {
            config,
            batch,
            num_steps,
            future_tokens,
            future_key_bias,
            groups: Groups {
                state: config.num_state_rows(),
                future: future_tokens.len() / config.width,
                action: config.action_horizon,
                vl: num_vl_tokens,
            },
        })
    }
}

fn replaced_future_tokens(interventions: &[Intervention], width: usize) -> Result<Option<&[f32]>> {
    let mut given = interventions.iter().filter_map(|one| one.future_tokens.as_ref());
    let Some(tokens) = given.next() else {
        return Ok(None);
    };
    ensure!(
        given.next().is_none(), Input, "future_tokens";
        expected "at most one intervention that replaces them"; got "several"
    );
    ensure!(
        matches!(*tokens.shape(), [_, last] if last == width), Shape, "future_tokens";
        expected "(tokens, width) with width {width}"; got "{}", show_shape(tokens.shape())
    );
    Ok(Some(tokens.view().check_finite("future_tokens")?.data()))
}
