//! Products on NEON, whose instructions take an element of a row by lane, or multiply two rows by two columns.

pub(crate) mod bf16;
mod by_lane;
mod chains;
pub(crate) mod float32;
pub(crate) mod int8;
mod pairs;
mod quantizing;
mod tile;
