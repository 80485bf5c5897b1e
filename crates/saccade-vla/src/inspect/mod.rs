//! Looking inside a head: what to change while it runs, and what to keep.

pub(crate) mod call_sizes;
mod check;
pub(crate) mod compiled;
pub(crate) mod groups;
pub(crate) mod intervention;
pub mod linalg;
pub(crate) mod trace;
