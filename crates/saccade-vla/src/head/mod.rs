//! The action head: encode an observation once, then sample any number of action chunks from it.

mod action_encoder;
pub(crate) mod action_head;
mod check;
mod checkpoint;
pub(crate) mod context;
mod dit;
mod embodiment_layers;
pub(crate) mod embodiments;
pub(crate) mod encode;
mod flow_matching;
pub(crate) mod guidance;
mod layers;
pub(crate) mod load;
pub(crate) mod plan;
pub(crate) mod sample;
pub(crate) mod state_dropout;
pub(crate) mod stored;
mod trace;
pub(crate) mod velocity;
mod vl_encoder;
mod warmup;
mod workspace;
