#![doc = include_str!("../README.md")]
//!
//! # Where things are
//!
//! - Policy (feature `processor`): a [`Policy`] is the three below in one: frames and words to a [`PolicyContext`], and actions from it.
//! - Head: [`ActionHead::encode`] turns an observation's [`Features`] into a [`Context`], which holds the KV cache of every cross-attention
//!   block. [`ActionHead::sample`] integrates the flow from noise to actions. [`Chunking`] joins a chunk to the one before (real-time
//!   chunking), [`CrossAttention`] is one such layer alone.
//! - Backbone: [`Backbone::encode`] turns pixels and token ids into features, and reuses what an earlier call computed of the same views.
//!   A [`FeatureBatch`] of them is what the head takes.
//! - Processor (feature `processor`): [`Processor::process`] turns frames and an instruction into those pixels and ids
//!   ([`Prepared::as_inputs`]).
//! - Inspection: an [`Intervention`] cuts attention, adds biases to keys, or replaces rows; [`ActionHead::trace`] records what goes on
//!   inside, [`linalg`] has ridge regression, principal components, CKA and principal angles for it.
//! - Checkpoints: [`HeadCheckpoint`] and [`BackboneCheckpoint`] are open and not loaded; [`convert`], [`quantize`] and [`resize`] (feature
//!   `rewrite`) write changed copies. Files are read by [`files`].
//!
//! Everything that is loaded is immutable and serves any number of threads at once. An [`Error`] names the argument, what was expected and
//! what was given. [`Precision`] says what each kind of layer computes in. Comments cite the equations of docs/equations.md in the
//! repository, which names the function that computes each.

#![forbid(unsafe_code)]

mod alloc;
mod array;
mod backbone;
mod cache;
mod config;
mod engine;
mod error;
mod gram;
mod head;
mod inspect;
mod nn;
mod ops;
#[cfg(feature = "processor")]
mod parallel;
#[cfg(feature = "processor")]
mod policy;
mod precision;
#[cfg(feature = "processor")]
mod processor;
mod profile;
mod recognise;
// Rows say what processors do, also where none is compiled.
#[cfg_attr(not(feature = "processor"), allow(dead_code, unused_imports))]
mod release;
#[cfg(feature = "rewrite")]
mod rewrite;
mod sampling;
mod standalone_cross_attention;
mod watch;
mod workspaces;

pub use array::{Array, ArrayMut, OwnedArray};
pub use backbone::{
    Backbone, BackboneCheckpoint, BackboneConfig, BackboneFeatures, BackboneInputs, BackboneKeep,
    BackboneLoadOptions, BackboneRecord, FeatureBatch, LanguageConfig, VisionConfig,
};
pub use config::HeadConfig;
pub use engine::Engine;
pub use error::{Error, ErrorKind, Problem, Result};
pub use gram::Gram;
pub use head::action_head::ActionHead;
pub use head::context::Context;
pub use head::encode::Features;
pub use head::guidance::Guidance;
pub use head::load::LoadOptions;
pub use head::plan::tensor_shapes;
pub use head::sample::Sampling;
pub use head::stored::TensorFacts;
pub use head::velocity::NoisyActions;
pub use inspect::groups::{Group, Groups, Tokens};
pub use inspect::intervention::{Intervention, Patch};
pub use inspect::linalg;
pub use inspect::trace::{Keep, Recorded, StepBlock, Trace, TraceOptions};
pub use nn::source::memory::{ElementsRef, TensorView, TensorViews};
pub use ops::interruptible;
#[cfg(feature = "processor")]
pub use policy::{Policy, PolicyContext, PolicyLoadOptions};
pub use precision::Precision;
#[cfg(feature = "processor")]
pub use processor::{
    Frame, Observation, Prepared, Processor, ProcessorOptions, ProcessorSource, Tokenizer, TokenizerFiles,
    View,
};
pub use profile::{Counter, Part, Profile, Profiling};
pub use recognise::HeadCheckpoint;
#[cfg(feature = "processor")]
pub use release::Preprocessing;
pub use release::Version;
#[cfg(feature = "rewrite")]
pub use rewrite::{
    ConvertOptions, ConvertReport, Float, MergedTokens, QuantizeReport, QuantizedWeights, ResizeOptions,
    ResizeReport, RewriteOptions, Rounded, RoundedLayer, RoundingErrors, Written, convert, gptq,
    merge_future_tokens, open_base, quantize, quantized_weights, resize, resized_config, round_layer,
};
pub use saccade_vla_checkpoint as files;
#[cfg(feature = "peak")]
pub use saccade_vla_kernels::peak;
pub use saccade_vla_kernels::{
    Arithmetic, CpuReport, Isa, StayOnThisThread, default_num_threads, stay_on_this_thread,
};
pub use sampling::chunking::Chunking;
pub use sampling::integrator::Integrator;
pub use standalone_cross_attention::{CrossAttention, KeyOptions, KeyValues};
pub use watch::{LinearWatch, WatchedLinear};
