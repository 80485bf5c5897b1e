//! The action head of GR00T-style robot policies on CPUs, exact and fast.
//!
//! An observation is encoded once ([`ActionHead::encode`]): the vision-language tokens pass their norm and self-attention, and every
//! cross-attention block's keys and values are held in a [`Context`]. Chunks of actions are then sampled from it
//! ([`ActionHead::sample`]), any number of times. What happens inside can be changed ([`Intervention`]) and kept ([`ActionHead::trace`]).
//!
//! Where an equation comes from is said by its number in the GR00T action head's specification, as in "spec 1.6".

#![forbid(unsafe_code)]

mod alloc;
mod array;
mod backbone;
mod config;
mod engine;
mod error;
mod head;
mod inspect;
mod nn;
mod ops;
mod precision;
mod processor;
mod profile;
mod recognise;
mod rewrite;
mod sampling;
mod standalone_cross_attention;
mod workspaces;

pub use array::{Array, ArrayMut, OwnedArray};
pub use backbone::{
    Backbone, BackboneCheckpoint, BackboneConfig, BackboneFeatures, BackboneInputs, BackboneKeep,
    BackboneLoadOptions, BackboneRecord, LanguageConfig, VisionConfig,
};
pub use config::HeadConfig;
pub use error::{Error, ErrorKind, Problem, Result};
pub use head::action_head::ActionHead;
pub use head::context::Context;
pub use head::encode::Features;
pub use head::load::LoadOptions;
pub use head::plan::tensor_shapes;
pub use head::sample::Sampling;
pub use head::velocity::NoisyActions;
pub use inspect::groups::{Group, Groups, Tokens};
pub use inspect::intervention::{Intervention, Patch};
pub use inspect::trace::{Keep, Recorded, StepBlock, Trace, TraceOptions};
pub use nn::source::memory::{ElementsRef, TensorView, TensorViews};
pub use ops::interruptible;
pub use precision::Precision;
pub use processor::{
    Frame, Observation, Prepared, Preprocessing, Processor, ProcessorOptions, ProcessorSource, Tokenizer,
    TokenizerFiles, View,
};
pub use profile::{Counter, Part, Profile, Profiling};
pub use recognise::{HeadCheckpoint, TensorFacts};
pub use rewrite::adapter::open_base;
pub use rewrite::convert::{ConvertOptions, ConvertReport, convert};
pub use rewrite::float::Float;
pub use rewrite::quantize::{QuantizeReport, quantize};
pub use rewrite::resize::{
    MergedTokens, ResizeOptions, ResizeReport, merge_future_tokens, resize, resized_config,
};
pub use rewrite::{RewriteOptions, Written};
pub use saccade_vla_checkpoint::{self as files, Checkpoint, Elements};
pub use saccade_vla_kernels::{
    Arithmetic, CpuReport, Isa, StayOnThisThread, default_num_threads, peak, stay_on_this_thread,
};
pub use sampling::chunking::Chunking;
pub use sampling::integrator::Integrator;
pub use standalone_cross_attention::{CrossAttention, KeyOptions, KeyValues};
