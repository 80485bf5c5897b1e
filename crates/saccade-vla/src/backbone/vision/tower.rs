//! The steps in which vision towers differ, and the memory that they share.

use saccade_vla_kernels::{Rows, RowsMut};

use super::block::{BlockWorkspace, VisionBlock};
use super::connector::{Connector, ConnectorWorkspace};
use crate::alloc::Scratch;
use crate::backbone::inputs::ViewPixels;
use crate::engine::Kernels;
use crate::error::Result;
use crate::nn::rope::Rope;

/// A vision tower with its connector.
pub(super) trait VisionTower {
    /// Writes `patches W^T + b + positions` to `x (patches, width)`; the angles by which heads are rotated,
    /// if they are.
    fn embed(
        &self,
        kernels: &mut Kernels<'_>,
        views: &[ViewPixels<'_>],
        patch_vectors: &mut Scratch,
        x: RowsMut<'_>,
    ) -> Result<Option<Rope>>;

    /// The blocks, first to last.
    fn blocks(&self) -> &[VisionBlock];

    /// The connector to the first layers of the language model that follows block number `block`, if one
    /// does.
    fn deepstack(&self, _block: usize) -> Option<&Connector> {
        None
    }

    /// The patches after the last block, normed if the tower has a norm there, and the tokens made of them.
    fn tokens<'a>(
        &self,
        kernels: &mut Kernels<'_>,
        views: &[ViewPixels<'_>],
        x: Rows<'a>,
        workspace: &'a mut TokensWorkspace,
    ) -> Result<(Rows<'a>, Vec<f32>)>;
}

/// Memory kept between calls.
#[derive(Default)]
pub(crate) struct VisionWorkspace {
    /// `(patches, width)`.
    pub(super) x: Scratch,
    /// The pixels of patches, `(patches, elements)`.
    pub(super) patch_vectors: Scratch,
    pub(super) block: BlockWorkspace,
    pub(super) tokens: TokensWorkspace,
}

/// The part of it that makes tokens.
#[derive(Default)]
pub(super) struct TokensWorkspace {
    /// The patches after the last norm, `(patches, width)`.
    pub normed: Scratch,
    /// Squares of patches, `(tokens, patches of a token * width)`.
    pub joined: Scratch,
    pub connector: ConnectorWorkspace,
}
