//! The back ends that a model's description is run against.

pub(crate) mod file;
pub(crate) mod memory;
pub(crate) mod planner;
pub(crate) mod sizer;
