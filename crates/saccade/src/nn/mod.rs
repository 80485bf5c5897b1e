//! Layers: built from named weights, run by the kernels.

pub(crate) mod attention;
pub(crate) mod file;
pub(crate) mod linear;
pub(crate) mod mlp;
pub(crate) mod norm;
pub(crate) mod planner;
pub(crate) mod sizer;
pub(crate) mod weights;
