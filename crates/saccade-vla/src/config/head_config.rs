//! The sizes and switches of an action head.
//!
//! The keys in JSON are the released ones (`input_embedding_dim`, `num_target_vision_tokens`); the fields of
//! [`HeadConfig`] have the names that are used everywhere else.

use super::values::MAX_SIZE;
use crate::error::{Error, Result, ensure};
use crate::release::{Feature, Version};

/// The sizes and switches of an action head.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct HeadConfig {
    /// Release of the architecture. The other fields define what the head computes.
    pub version: Version,
    /// Width of the diffusion transformer (`input_embedding_dim`).
    pub width: usize,
    /// Blocks of the diffusion transformer.
    pub num_layers: usize,
    /// Attention heads of the diffusion transformer.
    pub num_heads: usize,
    /// Width of one of these heads; `num_heads * head_dim == width`.
    pub head_dim: usize,
    /// Width of the vision-language tokens (`backbone_embedding_dim`; N1: `cross_attention_dim`).
    pub context_dim: usize,
    /// Whether every second block is self-attention; otherwise all are cross-attention.
    pub interleave_self_attention: bool,
    /// If n is not 0, cross-attention blocks see attended positions only: every n-th block, starting with the
    /// first, sees text, the others images (equation 12 of docs/equations.md). 0: all blocks see all
    /// positions, whatever the masks.
    pub attend_text_every_n_blocks: usize,
    /// Whether the vision-language tokens pass the norm `vlln`.
    pub use_vlln: bool,
    /// Blocks of the VL self-attention, 0 without one.
    pub vl_num_layers: usize,
    /// Attention heads of the VL self-attention.
    pub vl_num_heads: usize,
    /// Width of one of these heads; `vl_num_heads * vl_head_dim == context_dim`.
    pub vl_head_dim: usize,
    /// Learned query rows between state and actions (`num_target_vision_tokens`).
    pub num_future_tokens: usize,
    /// What is added to the logits of each future key in every self-attention block: the logarithm of the
    /// number of tokens that it represents (equation 47 of docs/equations.md). Only saccade reads it.
    pub future_key_bias: Option<Vec<f32>>,
    /// Actions in a chunk.
    pub action_horizon: usize,
    /// Width of an action as it is returned.
    pub action_dim: usize,
    /// Width of an action as it is denoised (`pretrained_action_dim`); elements beyond `action_dim` are held
    /// at zero.
    pub encoder_action_dim: usize,
    /// The decoders: module and width, in the order in which their outputs are concatenated to `action_dim`
    /// elements.
    pub decoders: Vec<(String, usize)>,
    /// Width of the state vector (`max_state_dim`).
    pub state_dim: usize,
    /// State vectors that make a state row (`state_history_length`).
    pub state_history: usize,
    /// State vectors in an observation, `state_history` for each state row. No config says it: several rows
    /// are for models that were trained with several states.
    pub num_states: usize,
    /// Hidden width of the encoders and the decoders (`hidden_size`).
    pub hidden_dim: usize,
    /// Slices of the category-specific layers (`max_num_embodiments`).
    pub num_embodiments: usize,
    /// Buckets that the time from 0 to 1 is divided into (`num_timestep_buckets`).
    pub num_timestep_buckets: usize,
    /// Default number of Euler steps (`num_inference_timesteps`).
    pub num_steps: usize,
    /// Rows of the position table (`max_seq_len`).
    pub max_positions: usize,
    /// Whether action rows get a position.
    pub add_pos_embed: bool,
}

/// Which of the vision-language tokens a cross-attention block sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reads {
    /// All, masks or not.
    All,
    /// Those of text that are attended.
    Text,
    /// Those of images that are attended.
    Images,
}

impl HeadConfig {
    /// State rows, the first of the query sequence.
    #[must_use]
    pub fn num_state_rows(&self) -> usize {
        self.num_states / self.state_history
    }

    /// Rows of the query sequence: state, future, action.
    #[must_use]
    pub fn num_rows(&self) -> usize {
        self.num_state_rows() + self.num_future_tokens + self.action_horizon
    }

    /// Whether block `index` attends to the vision-language tokens.
    #[must_use]
    pub fn is_cross(&self, index: usize) -> bool {
        !self.interleave_self_attention || index.is_multiple_of(2)
    }

    /// This config with another number of actions in a chunk.
    ///
    /// # Errors
    /// [`Error::Input`] for none, and for more than the position table has rows or than any config may ask
    /// for.
    pub(crate) fn with_action_horizon(self, action_horizon: usize) -> Result<Self> {
        let (limit, what) = match self.add_pos_embed {
            true => (
                self.max_positions,
                " (max_seq_len, the rows of the position table)",
            ),
            false => (MAX_SIZE as usize, ""),
        };
        ensure!(
            (1..=limit).contains(&action_horizon), Input, "action_horizon";
            expected "1 to {limit}{what}"; got "{action_horizon}"
        );
        Ok(Self {
            action_horizon,
            ..self
        })
    }

    /// This config with another number of states in an observation.
    ///
    /// # Errors
    /// [`Error::Input`] for none, for more than any config may ask for, and for a version that makes one row
    /// of as many states as its config says, for another number.
    pub fn with_num_states(self, num_states: usize) -> Result<Self> {
        ensure!(
            !self.version.has(Feature::StateHistory) || num_states == self.state_history,
            Input, "num_states";
            expected "{}, since {} makes one row of its last states (state_history_length)",
            self.state_history, self.version;
            got "{num_states}"
        );
        ensure!(
            (1..=MAX_SIZE as usize).contains(&num_states), Input, "num_states";
            expected "1 to {MAX_SIZE}"; got "{num_states}"
        );
        Ok(Self { num_states, ..self })
    }

    /// How cross-attention blocks take masks: `"none"` ignores them, `"alternate"` is the rule of
    /// `attend_text_every_n_blocks`.
    #[must_use]
    pub fn mask_mode(&self) -> &'static str {
        match self.attend_text_every_n_blocks {
            0 => "none",
            _ => "alternate",
        }
    }

    /// What block `index` sees of the vision-language tokens, if it is cross-attention.
    pub(crate) fn reads(&self, index: usize) -> Option<Reads> {
        let every = self.attend_text_every_n_blocks;
        self.is_cross(index).then_some(match every {
            0 => Reads::All,
            _ if index.is_multiple_of(2 * every) => Reads::Text,
            _ => Reads::Images,
        })
    }
}
