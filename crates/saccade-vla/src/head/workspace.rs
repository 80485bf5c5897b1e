//! Memory of calls of the head, kept between calls.

use saccade_vla_kernels::LinearScratch;

use super::dit::{DitInput, DitWorkspace};
use super::vl_encoder::VlWorkspace;
use crate::alloc::Scratch;

/// Memory kept between calls; grows to the needs of the largest.
#[derive(Default)]
pub(crate) struct Workspace {
    pub vl: VlWorkspace,
    pub input: DitInput,
    pub dit: DitWorkspace,
    /// That of the second context of a guided call.
    pub other_dit: DitWorkspace,
    /// By observation.
    pub embodiment_ids: Vec<usize>,
    /// States of which some are set to zero, `(batch * state_rows, inputs of a state row)`.
    pub zeroed_state: Scratch,
    /// The state encoder's hidden layer, `(batch * state_rows, hidden_dim)`.
    pub state_hidden: Scratch,
    /// State rows, `(batch * state_rows, width)`.
    pub state: Scratch,
    /// Noisy actions, `(batch * samples * action_horizon, encoder_action_dim)`.
    pub x: Scratch,
    /// `x` at the start of a step of two evaluations.
    pub start: Scratch,
    /// Factor of the velocity of each action of a chunk, `(action_horizon,)`.
    pub strength: Vec<f32>,
    /// The action encoder's hidden layer, `(batch * samples * action_horizon, width)`.
    pub action_hidden: Scratch,
    /// Action rows, `(batch * samples * action_horizon, width)`.
    pub action: Scratch,
    pub decoder_hidden: Scratch,
    /// One decoder's output, `(batch * samples * action_horizon, width of the decoder)`.
    pub decoded: Scratch,
    /// `(batch * samples * action_horizon, action_dim)`.
    pub velocity: Scratch,
    /// That of the other context of a guided call.
    pub other_velocity: Scratch,
    pub linear: LinearScratch,
}
