#![doc = include_str!("../README.md")]
//!
//! # Where things are
//!
//! [`Isa`] names an instruction set and finds the best one; every kernel takes one, or packs weights for one. Matrices are [`Rows`] and
//! [`RowsMut`], views with a row stride. [`PackedLinear`] is the linear layer, [`PackedKeyValues`] the KV cache of [`attention`], and
//! [`quantize_rows`] the rule of int8 weights, [`quantize_rows_int4`] of int4. [`layer_norm`], [`rms_norm`], [`rotary_embedding`] and the activations work on rows;
//! [`resize_area`] and its neighbours on images, bit for bit as OpenCV, Pillow and torch do.
//!
//! Memory whose size the caller decides is claimed with an error, [`AllocError`], where there is none. [`parallel_for`] runs on the pool,
//! [`interruptible`] stops long calls, [`default_num_threads`] counts the cores that this process may use.

mod activation;
mod aligned;
mod attention;
#[cfg_attr(
    not(all(target_arch = "x86_64", not(saccade_portable))),
    allow(
        dead_code,
        reason = "only x86-64 asks for all of it; its tests run everywhere"
    )
)]
mod cpu;
mod gemm;
mod image;
mod isa;
mod linear;
mod matrix;
mod norm;
mod parts;
#[cfg(feature = "peak")]
pub mod peak;
mod pool;
mod rotary;
mod rows;
mod simd;
mod threads;
#[cfg_attr(
    not(any(
        all(target_arch = "x86_64", not(saccade_portable)),
        feature = "software-tiles"
    )),
    allow(dead_code, reason = "no unit multiplies tiles there")
)]
mod tiles;
mod weights;

pub use activation::{exp, gelu_erf, gelu_tanh, relu, silu};
pub use aligned::{AlignedVec, AllocError};
pub use attention::{LogitBias, Mask, PackedKeyValues, attention};
pub use cpu::CpuReport;
pub use half::bf16;
pub use image::{
    FloatImage, Image, WeightRounding, resize_area, resize_cubic_u8, resize_linear_f32, resize_linear_u8,
};
pub use isa::{ISA_VARIABLE, Isa, IsaError};
pub use linear::{Epilogue, KernelError, LinearScratch, PackedLinear};
pub use matrix::Matrix;
pub use norm::layer::layer_norm;
pub use norm::rms::{rms_norm, rms_norm_in_place};
pub use pool::{
    Interrupted, MAX_THREADS, StayOnThisThread, interrupted, interruptible, parallel_for, stay_on_this_thread,
};
pub use rotary::rotary_embedding;
pub use rows::{Rows, RowsMut};
pub use threads::{NUM_THREADS_VARIABLE, NumThreadsError, default_num_threads};
pub use weights::{Arithmetic, Element, WeightRef, quantize_rows, quantize_rows_int4};
