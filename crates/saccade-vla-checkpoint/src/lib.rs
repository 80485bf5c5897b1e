#![doc = include_str!("../README.md")]
//!
//! # Where things are
//!
//! [`Checkpoint`] is one `.safetensors` file or a directory of shards, [`Elements`] a tensor in memory, [`ReadAhead`] reads the next
//! tensors meanwhile. [`CheckpointWriter`] writes a directory that appears whole or not at all, and [`Companions`] are the files next to
//! weights that a copy takes along. [`spec`] compares the tensors that are there with those that a model needs. [`Error`] says which
//! argument is to blame, what was expected and what was given.

#![forbid(unsafe_code)]

mod adapter;
mod ahead;
mod companions;
mod elements;
mod error;
mod header;
mod index;
mod lfs;
mod names;
mod reader;
mod source;
pub mod spec;
mod unique_map;
mod writer;

pub use adapter::{ADAPTER_CONFIG, ADAPTER_WEIGHTS, directory_of};
pub use ahead::{ReadAhead, Wanted};
pub use companions::{Companions, OWN_CONFIG};
pub use elements::Elements;
pub use error::{Error, Problem, Result, printable, probe_allocation, reserve, show_bytes, show_shape};
/// The type of the elements of [`Elements::Bf16`].
pub use half::bf16;
pub use names::plain_name;
pub use reader::Checkpoint;
/// The types that tensors are stored in.
pub use safetensors::Dtype;
pub use source::read_text;
pub use spec::TensorSpec;
pub use unique_map::UniqueMap;
pub use writer::{CheckpointWriter, PlannedTensor};
