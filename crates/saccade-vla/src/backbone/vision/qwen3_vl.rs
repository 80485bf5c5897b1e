//! The vision tower of Qwen3-VL, which N1.7 has, with the mergers that make tokens of its patches.

use saccade_vla_kernels::{Epilogue, Rows, RowsMut};

use super::block::{BlockNames, VisionBlock};
use super::connector::{Connector, ConnectorNames, ConnectorSizes};
use super::positions::{Taps, evenly_spaced, interpolate, patch_places, vision_rope_pairs};
use super::tower::{TokensWorkspace, VisionTower};
use crate::alloc::{Scratch, reserved};
use crate::array::OwnedArray;
use crate::backbone::config::{BackboneConfig, CHANNELS, Tower, VisionConfig};
use crate::backbone::inputs::ViewPixels;
use crate::engine::Kernels;
use crate::error::Result;
use crate::nn::grouped_attention::{Projections, Qkv};
use crate::nn::linear::Linear;
use crate::nn::rope::{Rope, RopePair};
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;
use crate::precision::Role;
use crate::profile::Part;

const BLOCK: BlockNames = BlockNames {
    norms: ["norm1", "norm2"],
    attention: "attn",
    projections: Projections {
        qkv: Qkv::Stacked("qkv"),
        out: "proj",
        qkv_bias: true,
        out_bias: true,
    },
    mlp: ["linear_fc1", "linear_fc2"],
};

const MERGER: ConnectorNames = ConnectorNames {
    norm: "norm",
    layers: ["linear_fc1", "linear_fc2"],
};

/// Patches, blocks, and the mergers of the last block and of those in `deepstack`.
pub(super) struct Qwen3Vl {
    patch_embed: Linear,
    /// `(positions, width)`, a square.
    positions: OwnedArray,
    blocks: Vec<VisionBlock>,
    merger: Connector,
    deepstack_mergers: Vec<Connector>,
    rope_pairs: Vec<RopePair>,
    config: VisionConfig,
}

impl Qwen3Vl {
    /// From `patch_embed`, `pos_embed`, `blocks`, `merger` and `deepstack_merger_list`.
    pub(super) fn new(weights: &Weights<'_>, config: &BackboneConfig) -> Result<Self> {
        let vision = &config.vision;
        let (width, size) = (vision.width, vision.patch_size);
        let frames = match vision.tower {
            Tower::Qwen3Vl { frames, .. } => frames,
            Tower::Siglip { .. } => 1,
        };
        let shape = [width, CHANNELS, frames, size, size];
        let patch_embed = Linear::windows(&weights.at("patch_embed.proj"), &shape, Role::Other)?;
        let positions = weights.at("pos_embed");
        let positions = positions.table([vision.num_positions, width], vision.num_positions)?;
        let blocks = VisionBlock::all(&weights.at("blocks"), vision, &BLOCK)?;
        let joined = vision.patches_of_token() * width;
        let merger = |weights: &Weights<'_>, norm| {
            let sizes = ConnectorSizes {
                norm,
                input: joined,
                hidden: joined,
                output: config.language.width,
            };
            Connector::new(weights, &MERGER, &sizes, vision.norm_eps as f32)
        };
        let list = weights.at("deepstack_merger_list");
        let deepstack_mergers: Result<_> = (0..vision.deepstack.len())
            .map(|index| merger(&list.at(index), joined))
            .collect();
        Ok(Self {
            patch_embed: patch_embed.counted(Part::Patches),
            positions,
            blocks,
            // Normed patch by patch, the others token by token.
            merger: merger(&weights.at("merger"), width)?,
            deepstack_mergers: deepstack_mergers?,
            rope_pairs: vision_rope_pairs(vision),
            config: vision.clone(),
        })
    }
}

impl VisionTower for Qwen3Vl {
    fn embed(
        &self,
        kernels: &mut Kernels<'_>,
        views: &[ViewPixels<'_>],
        patch_vectors: &mut Scratch,
        mut x: RowsMut<'_>,
    ) -> Result<Option<Rope>> {
        let (side, elements) = (self.config.table_side(), self.patch_embed.in_features());
        let mut patch_vectors = patch_vectors.rows(x.num_rows(), elements)?;
        let mut places = reserved("positions", x.num_rows())?;
        let mut rows = x.iter_mut();
        for view in views {
            check_interrupted()?;
            let own = places.len()..places.len() + view.num_patches();
            let mut vectors = patch_vectors.reborrow().rows(own);
            vectors.copy_from(Rows::new(view.pixels, elements));
            let [by_row, by_column]: [Vec<Taps>; 2] = view.grid.map(|count| evenly_spaced(side, count));
            let of_view = patch_places(self.config.merge, view.grid)?;
            for (&[row, column], x) in of_view.iter().zip(&mut rows) {
                let taps = [&by_row[row], &by_column[column]];
                interpolate(self.positions.rows(), side, taps, x);
            }
            places.extend(of_view);
        }
        drop(rows);
        self.patch_embed
            .apply(kernels, patch_vectors.as_rows(), Epilogue::Add, x)?;
        Rope::new(self.config.head_dim, &self.rope_pairs, &places).map(Some)
    }

    fn blocks(&self) -> &[VisionBlock] {
        &self.blocks
    }

    fn deepstack(&self, block: usize) -> Option<&Connector> {
        let index = self.config.deepstack.iter().position(|after| *after == block)?;
        self.deepstack_mergers.get(index)
    }

    fn tokens<'a>(
        &self,
        kernels: &mut Kernels<'_>,
        _views: &[ViewPixels<'_>],
        x: Rows<'a>,
        workspace: &'a mut TokensWorkspace,
    ) -> Result<(Rows<'a>, Vec<f32>)> {
        Ok((x, self.merger.tokens(kernels, x, &mut workspace.connector)?))
    }
}
