//! What a vision tower makes of views, and the memory that it needs for that.

use saccade_vla_kernels::Activations;

use super::block::BlockBuffers;
use super::connector::ConnectorBuffers;
use crate::alloc::filled;
use crate::error::Result;

/// What a tower makes of views, one after the other.
pub(crate) struct EncodedViews {
    /// `(tokens, width of the language model)`.
    pub tokens: Vec<f32>,
    /// The same, to be added after the first layers of the language model.
    pub deepstack: Vec<Vec<f32>>,
}

impl EncodedViews {
    /// Room for `len` elements of tokens.
    pub(crate) fn new(len: usize) -> Result<Self> {
        Ok(Self {
            tokens: filled("tokens of views", len, 0.0)?,
            deepstack: Vec::new(),
        })
    }
}

/// Memory of one call that is kept for the next.
#[derive(Default)]
pub(crate) struct VisionBuffers {
    /// `(patches, width)`.
    pub x: Activations,
    /// The pixels of patches, `(patches, elements)`.
    pub patch_vectors: Activations,
    pub block: BlockBuffers,
    pub connector: ConnectorBuffers,
}
