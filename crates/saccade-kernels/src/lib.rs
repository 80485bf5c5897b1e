//! Packed linear layers, fused attention, norms and the private thread pool: the numerics of saccade, knowing nothing of GR00T.
//!
//! Every kernel is written once over a small vector type and compiled for each instruction set ([`Isa`]); this is the only crate of saccade
//! with `unsafe` code. What all kernels promise: a row's result has the same bits whatever the number of rows, its place among
//! them, and the number of threads.

mod activation;
mod aligned;
mod attention;
mod isa;
mod linear;
mod norm;
pub mod peak;
mod pool;
mod rows;
mod simd;
mod threads;

pub use activation::{exp, gelu_tanh, relu, silu};
pub use aligned::AllocError;
pub use attention::{LogitBias, Mask, PackedKeyValues, attention};
pub use half::bf16;
pub use isa::{ISA_VARIABLE, Isa, IsaError};
pub use linear::{
    Arithmetic, Element, Epilogue, KernelError, LinearScratch, PackedLinear, WeightRef, quantize_rows,
};
pub use norm::layer_norm;
pub use pool::{Interrupted, interrupted, interruptible, parallel_for};
pub use rows::{Matrix, Rows, RowsMut};
pub use threads::{NUM_THREADS_VARIABLE, NumThreadsError, default_num_threads};
