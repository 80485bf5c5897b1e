//! Checkpoint files: reading safetensors strictly, writing them all or nothing, and the files next to them.
//!
//! [`Checkpoint`] is one `.safetensors` file or a directory of shards. Headers are read and checked when it is opened; tensors are read when
//! asked for, by position, so that any number of threads can read from one [`Checkpoint`]. [`CheckpointWriter`] writes a directory that
//! appears whole or not at all. [`spec`] compares the tensors that are there with those that a model needs.
//!
//! Nothing here knows a model or computes anything.

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

pub use adapter::{ADAPTER_CONFIG, ADAPTER_WEIGHTS};
pub use ahead::{ReadAhead, Wanted};
pub use companions::{Companions, OWN_CONFIG};
pub use elements::Elements;
pub use error::{Error, Problem, Result, granted, printable, reserve, show_bytes, show_shape};
pub use names::plain_name;
pub use reader::Checkpoint;
/// The types that tensors are stored in.
pub use safetensors::Dtype;
pub use source::read_text;
pub use spec::TensorSpec;
pub use unique_map::UniqueMap;
pub use writer::{CheckpointWriter, PlannedTensor};
