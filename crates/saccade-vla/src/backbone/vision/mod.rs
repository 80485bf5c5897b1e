//! The vision tower of a backbone: SigLIP's or that of Qwen3-VL, for views of which as many are encoded together as memory should hold.

mod block;
pub(crate) mod buffers;
mod connector;
pub(crate) mod positions;
mod qwen3_vl;
mod siglip;

use std::sync::Arc;

use self::buffers::VisionBuffers;
use self::qwen3_vl::Qwen3Vl;
use self::siglip::Siglip;
use crate::alloc::{collected, reserve};
use crate::backbone::config::{BackboneConfig, Tower};
use crate::backbone::features::View;
use crate::backbone::inputs::{ViewPixels, num_tokens};
use crate::backbone::released::Names;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::weights::Weights;

/// Patches that are encoded together. More read the weights less often; fewer keep the activations small: at 2048 patches the weights are
/// read once for 8 views, and the largest buffer is 35 MB at N1.5's size.
const VISION_ROWS: usize = 2048;

/// A vision tower with its connector.
pub(crate) enum Vision {
    Siglip(Siglip),
    Qwen3Vl(Qwen3Vl),
}

impl Vision {
    pub(crate) fn new(weights: &Weights<'_>, names: &Names, config: &BackboneConfig) -> Result<Self> {
        Ok(match config.vision.tower {
            Tower::Siglip { pixels, patches } => {
                Self::Siglip(Siglip::new(weights, names, config, (pixels, patches))?)
            }
            Tower::Qwen3Vl { .. } => Self::Qwen3Vl(Qwen3Vl::new(&weights.at(names.vision), config)?),
        })
    }

    /// Encodes views, each by itself; `record` keeps their patches as well.
    pub(crate) fn encode(
        &self,
        engine: Engine,
        config: &BackboneConfig,
        views: &[ViewPixels<'_>],
        record: bool,
        buffers: &mut VisionBuffers,
    ) -> Result<Vec<Arc<View>>> {
        let mut encoded = Vec::new();
        reserve("views", &mut encoded, views.len())?;
        let mut left = views;
        while !left.is_empty() {
            let mut rows = 0;
            let together = left.iter().take_while(|view| {
                rows += view.num_patches();
                rows <= VISION_ROWS
            });
            let (group, rest) = left.split_at(together.count().max(1));
            left = rest;
            let made = match self {
                Self::Siglip(tower) => tower.encode(engine, group, buffers)?,
                Self::Qwen3Vl(tower) => tower.encode(engine, group, buffers)?,
            };
            let (mut token, mut patch) = (0, 0);
            for view in group {
                let num_tokens = num_tokens(&config.vision, view);
                let tokens = token..token + num_tokens * config.language.width;
                let patches = patch..patch + view.num_patches() * config.vision.width;
                (token, patch) = (tokens.end, patches.end);
                let copy = |from: &[f32]| {
                    let from = &from[tokens.clone()];
                    collected("tokens of views", from.len(), from.iter().copied())
                };
                encoded.push(Arc::new(View {
                    pixels: collected("pixel_values", view.pixels.len(), view.pixels.iter().copied())?,
                    grid: view.grid,
                    num_tokens,
                    tokens: copy(&made.tokens)?,
                    deepstack: made
                        .deepstack
                        .iter()
                        .map(|rows| copy(rows))
                        .collect::<Result<_>>()?,
                    patches: match record {
                        true => {
                            let from = &self.patches(buffers)[patches];
                            collected("record", from.len(), from.iter().copied())?
                        }
                        false => Vec::new(),
                    },
                }));
            }
        }
        Ok(encoded)
    }

    /// The patches after the last block, and after the norm that follows if there is one.
    fn patches<'a>(&self, buffers: &'a VisionBuffers) -> &'a [f32] {
        match self {
            Self::Siglip(_) => &buffers.block.y,
            Self::Qwen3Vl(_) => &buffers.x,
        }
    }
}
