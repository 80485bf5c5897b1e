//! The vision tower of a backbone: SigLIP's or that of Qwen3-VL. Views are encoded in batches, bounded by the
//! memory of their activations.

mod block;
mod connector;
mod positions;
mod qwen3_vl;
mod siglip;
mod tower;

use std::sync::Arc;

use saccade_vla_kernels::Rows;

use self::qwen3_vl::Qwen3Vl;
use self::siglip::Siglip;
use self::tower::VisionTower;
pub(super) use self::tower::VisionWorkspace;
use super::config::{BackboneConfig, Tower};
use super::features::View;
use super::inputs::{ViewPixels, num_tokens};
use crate::alloc::{collected, copied, reserved};
use crate::engine::Kernels;
use crate::error::Result;
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;
use crate::release::Names;

/// Patches that are encoded together. More read the weights less often; fewer keep the activations small: at
/// 2048 patches the weights are read once for 8 views, and the largest buffer is 35 MB at N1.5's size.
const VISION_ROWS: usize = 2048;

/// A vision tower with its connector.
pub(super) struct Vision(Box<dyn VisionTower + Send + Sync>);

/// Encoded views, one after the other.
struct EncodedViews<'a> {
    /// The patches after the last block, and after the norm that follows if there is one.
    patches: Rows<'a>,
    /// `(tokens, width of the language model)`.
    tokens: Vec<f32>,
    /// The same, to be added after the first layers of the language model.
    deepstack: Vec<Vec<f32>>,
}

impl Vision {
    pub(super) fn new(weights: &Weights<'_>, names: &Names, config: &BackboneConfig) -> Result<Self> {
        Ok(Self(match config.vision.tower {
            Tower::Siglip { pixels, patches } => {
                Box::new(Siglip::new(weights, names, config, (pixels, patches))?)
            }
            Tower::Qwen3Vl { .. } => Box::new(Qwen3Vl::new(&weights.at(names.vision), config)?),
        }))
    }

    /// Encodes views, each by itself; `record` keeps their patches as well.
    pub(super) fn encode(
        &self,
        kernels: &mut Kernels<'_>,
        config: &BackboneConfig,
        views: &[ViewPixels<'_>],
        record: bool,
        workspace: &mut VisionWorkspace,
    ) -> Result<Vec<Arc<View>>> {
        let width = config.language.width;
        let mut encoded = reserved("views", views.len())?;
        let mut left = views;
        while !left.is_empty() {
            let mut rows = 0;
            let together = left.iter().take_while(|view| {
                rows += view.num_patches();
                rows <= VISION_ROWS
            });
            let (group, rest) = left.split_at(together.count().max(1));
            left = rest;
            let made = self.encode_together(kernels, config, group, workspace)?;
            let (mut token, mut patch) = (0, 0);
            for view in group {
                let num_tokens = num_tokens(&config.vision, view);
                let (tokens, patches) = (token..token + num_tokens, patch..patch + view.num_patches());
                (token, patch) = (tokens.end, patches.end);
                let own = |all| copied("tokens of views", Rows::new(all, width).rows(tokens.clone()));
                encoded.push(Arc::new(View {
                    pixels: collected("pixel_values", view.pixels.len(), view.pixels.iter().copied())?,
                    grid: view.grid,
                    num_tokens,
                    tokens: own(&made.tokens)?,
                    deepstack: made
                        .deepstack
                        .iter()
                        .map(|rows| own(rows))
                        .collect::<Result<_>>()?,
                    patches: match record {
                        true => copied("record", made.patches.rows(patches))?,
                        false => Vec::new(),
                    },
                }));
            }
        }
        Ok(encoded)
    }

    /// Encodes views in one batch.
    fn encode_together<'a>(
        &self,
        kernels: &mut Kernels<'_>,
        config: &BackboneConfig,
        views: &[ViewPixels<'_>],
        workspace: &'a mut VisionWorkspace,
    ) -> Result<EncodedViews<'a>> {
        let counts: Vec<usize> = views.iter().map(ViewPixels::num_patches).collect();
        let mut rows = workspace.x.rows(counts.iter().sum(), config.vision.width)?;
        let patch_vectors = &mut workspace.patch_vectors;
        let rope = self.0.embed(kernels, views, patch_vectors, rows.reborrow())?;
        let (block, tokens) = (&mut workspace.block, &mut workspace.tokens);
        let mut deepstack = Vec::new();
        for (index, layer) in self.0.blocks().iter().enumerate() {
            check_interrupted()?;
            layer.run(kernels, rope.as_ref(), &counts, block, rows.reborrow())?;
            if let Some(merger) = self.0.deepstack(index) {
                let joined = rows.as_rows().joined(config.vision.patches_of_token());
                deepstack.push(merger.tokens(kernels, joined, &mut tokens.connector)?);
            }
        }
        let (patches, tokens) = self.0.tokens(kernels, views, workspace.x.as_rows(), tokens)?;
        Ok(EncodedViews {
            patches,
            tokens,
            deepstack,
        })
    }
}
