//! Layers: built from named weights, run by the kernels.

pub(crate) mod attention;
pub(crate) mod embedding;
pub(crate) mod feed_forward;
pub(crate) mod grouped_attention;
pub(crate) mod kv_cache;
pub(crate) mod linear;
pub(crate) mod norm;
pub(crate) mod rope;
pub(crate) mod sequences;
pub(crate) mod source;
pub(crate) mod weights;
