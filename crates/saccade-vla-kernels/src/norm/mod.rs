//! Norms of rows: LayerNorm and RMSNorm.

pub(crate) mod layer;
pub(crate) mod rms;
