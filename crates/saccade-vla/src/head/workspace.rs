//! Memory of one call, kept for the next call.

use saccade_vla_kernels::{Activations, LinearScratch};

use super::dit::DitBuffers;
use super::vl_encoder::EncodeBuffers;

/// Grows to what the largest call needs.
pub(crate) struct Workspace {
    pub encode: EncodeBuffers,
    pub dit: DitBuffers,
    /// By batch element.
    pub embodiment_ids: Vec<usize>,
    /// States of which some are set to zero, `(batch, num_states * state_dim)`.
    pub seen_state: Activations,
    /// The state encoder's hidden layer, `(batch, state_rows, hidden_dim)`.
    pub state_hidden: Activations,
    /// State rows, `(batch, state_rows, width)`.
    pub state: Activations,
    /// Noisy actions, `(batch, samples, action_horizon, encoder_action_dim)`.
    pub x: Activations,
    /// `x` at the start of a step of two evaluations.
    pub start: Activations,
    /// What the velocity of each action of a chunk is multiplied by.
    pub strength: Activations,
    /// The action encoder's hidden layer, `(batch, samples, action_horizon, width)`.
    pub tokens: Activations,
    /// Action rows, `(batch, samples, action_horizon, width)`.
    pub encoded: Activations,
    /// The transformer's output rows, `(batch, samples, action_horizon, hidden_dim)`.
    pub output: Activations,
    pub decoder_hidden: Activations,
    /// One decoder's output, `(batch, samples, action_horizon, width of the decoder)`.
    pub decoded: Activations,
    /// `(batch, samples, action_horizon, action_dim)`.
    pub velocity: Activations,
    pub linear: LinearScratch,
}

impl Workspace {
    pub(crate) fn new() -> Self {
        Self {
            encode: EncodeBuffers::new(),
            dit: DitBuffers::new(),
            embodiment_ids: Vec::new(),
            seen_state: Activations::new(),
            state_hidden: Activations::new(),
            state: Activations::new(),
            x: Activations::new(),
            start: Activations::new(),
            strength: Activations::new(),
            tokens: Activations::new(),
            encoded: Activations::new(),
            output: Activations::new(),
            decoder_hidden: Activations::new(),
            decoded: Activations::new(),
            velocity: Activations::new(),
            linear: LinearScratch::new(),
        }
    }
}
