//! Memory of one call, kept for the next call.

use saccade_kernels::LinearScratch;

use super::dit::DitBuffers;
use super::vl_encoder::EncodeBuffers;

/// Grows to what the largest call needs.
pub(crate) struct Workspace {
    pub encode: EncodeBuffers,
    pub dit: DitBuffers,
    /// By batch element.
    pub embodiment_ids: Vec<usize>,
    /// The state encoder's hidden layer, `(batch, hidden_dim)`.
    pub state_hidden: Vec<f32>,
    /// State rows, `(batch, width)`.
    pub state: Vec<f32>,
    /// Noisy actions, `(batch, samples, action_horizon, encoder_action_dim)`.
    pub x: Vec<f32>,
    /// `x` at the start of a step of two evaluations.
    pub start: Vec<f32>,
    /// What the velocity of each action of a chunk is multiplied by.
    pub strength: Vec<f32>,
    /// The action encoder's hidden layer, `(batch, samples, action_horizon, width)`.
    pub tokens: Vec<f32>,
    /// Action rows, `(batch, samples, action_horizon, width)`.
    pub encoded: Vec<f32>,
    /// The transformer's output rows, `(batch, samples, action_horizon, hidden_dim)`.
    pub output: Vec<f32>,
    pub decoder_hidden: Vec<f32>,
    /// One decoder's output, `(batch, samples, action_horizon, width of the decoder)`.
    pub decoded: Vec<f32>,
    /// `(batch, samples, action_horizon, action_dim)`.
    pub velocity: Vec<f32>,
    pub linear: LinearScratch,
}

impl Workspace {
    pub(crate) fn new() -> Self {
        Self {
            encode: EncodeBuffers::new(),
            dit: DitBuffers::new(),
            embodiment_ids: Vec::new(),
            state_hidden: Vec::new(),
            state: Vec::new(),
            x: Vec::new(),
            start: Vec::new(),
            strength: Vec::new(),
            tokens: Vec::new(),
            encoded: Vec::new(),
            output: Vec::new(),
            decoder_hidden: Vec::new(),
            decoded: Vec::new(),
            velocity: Vec::new(),
            linear: LinearScratch::new(),
        }
    }
}
