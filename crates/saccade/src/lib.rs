//! The action head of GR00T-style robot policies on CPUs, exact and fast.
//!
//! An observation is encoded once ([`ActionHead::encode`]): the vision-language tokens pass their norm and self-attention, and every
//! cross-attention block's keys and values are held in a [`Context`]. Chunks of actions are then sampled from it
//! ([`ActionHead::sample`]) as often as wanted. What happens inside can be changed ([`Intervention`]) and kept ([`ActionHead::trace`]).
//!
//! Where an equation comes from is said by its number in the GR00T action head's specification, as in "spec 1.6".

#![forbid(unsafe_code)]

mod array;
mod attention;
mod cache;
mod chunking;
mod config;
mod context;
mod cross_attention;
mod dit;
mod error;
mod footprint;
mod head;
mod intervention;
mod layers;
mod layout;
mod memory;
mod precision;
mod profile;
mod reading;
mod recognise;
mod rewrite;
mod tables;
mod trace;

pub use array::{Array, OwnedArray};
pub use chunking::Chunking;
pub use config::HeadConfig;
pub use context::Context;
pub use cross_attention::{CrossAttention, KeyValues};
pub use error::{Error, ErrorKind, Result};
pub use head::{ActionHead, Features, Integrator, LoadOptions, Sampling};
pub use intervention::{Group, Groups, Intervention, Patch, Tokens};
pub use layout::tensor_shapes;
pub use memory::{ElementsRef, TensorView, TensorViews};
pub use precision::Precision;
pub use profile::{Counter, Part, Profile};
pub use recognise::{Published, TensorFacts};
pub use rewrite::convert::{ConvertOptions, ConvertReport, convert};
pub use rewrite::float::Float;
pub use rewrite::quantize::{QuantizeReport, quantize};
pub use rewrite::resize::{
    MergedTokens, ResizeOptions, ResizeReport, merge_future_tokens, resize, resized_config,
};
pub use rewrite::{RewriteOptions, Written};
pub use saccade_checkpoint::{self as files, Checkpoint, Elements};
pub use saccade_kernels::{Arithmetic, Isa, default_num_threads, peak};
pub use trace::{Keep, Recorded, StepBlock, Trace, TraceOptions};
