//! The vision tower of Qwen3-VL, which N1.7 has, with the mergers that make tokens of its patches.

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch};

use super::block::{BlockNames, VisionBlock};
use super::buffers::{EncodedViews, VisionBuffers};
use super::connector::{Connector, ConnectorNames, ConnectorSizes};
use super::positions::{Taps, evenly_spaced, interpolate, patch_places, vision_turns};
use crate::alloc::{reserve, sized};
use crate::backbone::config::{BackboneConfig, CHANNELS, Tower, VisionConfig};
use crate::backbone::inputs::ViewPixels;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::grouped_attention::{Projections, Qkv};
use crate::nn::linear::Linear;
use crate::nn::rope::{Rotation, Turn};
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
pub(crate) struct Qwen3Vl {
    patch_embed: Linear,
    /// `(positions, width)`, a square.
    positions: Vec<f32>,
    blocks: Vec<VisionBlock>,
    merger: Connector,
    deepstack_mergers: Vec<Connector>,
    turns: Vec<Turn>,
    config: VisionConfig,
}

impl Qwen3Vl {
    /// From `patch_embed`, `pos_embed`, `blocks`, `merger` and `deepstack_merger_list`.
    pub(crate) fn new(weights: &Weights<'_>, config: &BackboneConfig) -> Result<Self> {
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
        let blocks: Result<_> = (0..vision.num_layers)
            .map(|index| VisionBlock::new(&weights.at("blocks").at(index), vision, &BLOCK))
            .collect();
        let blocks = blocks?;
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
            turns: vision_turns(vision),
            config: vision.clone(),
        })
    }

    /// The tokens of views.
    pub(crate) fn encode(
        &self,
        engine: Engine,
        views: &[ViewPixels<'_>],
        buffers: &mut VisionBuffers,
    ) -> Result<EncodedViews> {
        let counts: Vec<usize> = views.iter().map(ViewPixels::num_patches).collect();
        let (patches, width) = (counts.iter().sum::<usize>(), self.config.width);
        let VisionBuffers {
            x,
            patch_vectors,
            block,
            connector,
        } = buffers;
        let x = sized(x, patches * width)?;
        let rotation = self.embed(engine, views, patch_vectors, &mut block.linear, x)?;
        let tokens = patches / self.config.patches_of_token() * self.merger.out_features();
        let mut encoded = EncodedViews::new(tokens)?;
        let mut mergers = self
            .config
            .deepstack
            .iter()
            .zip(&self.deepstack_mergers)
            .peekable();
        for (index, layer) in self.blocks.iter().enumerate() {
            check_interrupted()?;
            layer.run(engine, Some(&rotation), &counts, block, x)?;
            if let Some((_, merger)) = mergers.next_if(|(after, _)| **after == index) {
                let mut rows = EncodedViews::new(tokens)?.tokens;
                let memory = ([&mut connector.normed, &mut connector.hidden], &mut block.linear);
                merger.apply(engine, x, memory, &mut rows)?;
                encoded.deepstack.push(rows);
            }
        }
        let memory = ([&mut connector.normed, &mut connector.hidden], &mut block.linear);
        self.merger.apply(engine, x, memory, &mut encoded.tokens)?;
        Ok(encoded)
    }

    /// `x = patches W^T + b + positions`; the angles by which heads are rotated.
    fn embed(
        &self,
        engine: Engine,
        views: &[ViewPixels<'_>],
        patch_vectors: &mut Activations,
        scratch: &mut LinearScratch,
        x: &mut [f32],
    ) -> Result<Rotation> {
        let (width, side) = (self.config.width, self.config.table_side());
        let rows = x.len() / width;
        let patch_vectors = sized(patch_vectors, rows * self.patch_embed.in_features())?;
        let mut places = Vec::new();
        reserve("positions", &mut places, rows)?;
        let mut rows = x.chunks_exact_mut(width);
        let mut first = 0;
        for view in views {
            check_interrupted()?;
            patch_vectors[first..][..view.pixels.len()].copy_from_slice(view.pixels);
            first += view.pixels.len();
            let [by_row, by_column]: [Vec<Taps>; 2] = view.grid.map(|count| evenly_spaced(side, count));
            let of_view = patch_places(self.config.merge, view.grid)?;
            for ([row, column], x) in of_view.iter().zip(&mut rows) {
                interpolate(&self.positions, side, [&by_row[*row], &by_column[*column]], x);
            }
            places.extend(of_view);
        }
        self.patch_embed
            .apply(engine, patch_vectors, Epilogue::Add, x, scratch)?;
        Rotation::new(self.config.head_dim, &self.turns, &places)
    }
}
