//! SigLIP, the vision tower of N1.5 and N1.6, with the connector behind it.

use saccade_vla_kernels::{Epilogue, Rows, RowsMut};

use super::block::{BlockNames, VisionBlock};
use super::connector::{Connector, ConnectorNames, ConnectorSizes, pixel_shuffle};
use super::positions::{Taps, antialiased, interpolate};
use super::tower::{TokensWorkspace, VisionTower};
use crate::alloc::Scratch;
use crate::array::OwnedArray;
use crate::backbone::config::{BackboneConfig, CHANNELS, VisionConfig};
use crate::backbone::inputs::ViewPixels;
use crate::engine::Kernels;
use crate::error::Result;
use crate::nn::grouped_attention::{Projections, Qkv};
use crate::nn::linear::Linear;
use crate::nn::norm::LayerNorm;
use crate::nn::rope::Rope;
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;
use crate::precision::Role;
use crate::profile::Part;
use crate::release::{Names, PatchOrder, PixelOrder};

const BLOCK: BlockNames = BlockNames {
    norms: ["layer_norm1", "layer_norm2"],
    attention: "self_attn",
    projections: Projections {
        qkv: Qkv::Separate(["q_proj", "k_proj", "v_proj"]),
        out: "out_proj",
        qkv_bias: true,
        out_bias: true,
    },
    mlp: ["fc1", "fc2"],
};

const CONNECTOR: ConnectorNames = ConnectorNames {
    norm: "0",
    layers: ["1", "3"],
};

/// Added to the variance in the connector's norm.
const CONNECTOR_EPS: f32 = 1e-5;

/// Patches, blocks, a norm, and the connector.
pub(super) struct Siglip {
    patch_embedding: Linear,
    /// `(positions, width)`, a square.
    positions: OwnedArray,
    blocks: Vec<VisionBlock>,
    post_layernorm: LayerNorm,
    connector: Connector,
    config: VisionConfig,
    pixels: PixelOrder,
    patches: PatchOrder,
}

impl Siglip {
    /// From `embeddings`, `encoder.layers` and `post_layernorm`, and from the connector.
    pub(super) fn new(
        weights: &Weights<'_>,
        names: &Names,
        config: &BackboneConfig,
        (pixels, patches): (PixelOrder, PatchOrder),
    ) -> Result<Self> {
        let vision = &config.vision;
        let (width, size) = (vision.width, vision.patch_size);
        let tower = weights.at(names.vision);
        let embeddings = tower.at("embeddings");
        let patch_embedding = match pixels {
            PixelOrder::ChannelFirst => vec![width, CHANNELS, size, size],
            PixelOrder::ChannelLast => vec![width, size * size * CHANNELS],
        };
        let patch_embedding =
            Linear::windows(&embeddings.at("patch_embedding"), &patch_embedding, Role::Other)?;
        let positions = embeddings.at("position_embedding");
        let positions = positions.table([vision.num_positions, width], vision.num_positions)?;
        let blocks = VisionBlock::all(&tower.at("encoder.layers"), vision, &BLOCK)?;
        let post_layernorm = LayerNorm::new(&tower.at("post_layernorm"), width, vision.norm_eps as f32)?;
        let connector = weights.at(names.connector.unwrap_or_default());
        let (joined, output) = (vision.patches_of_token() * width, config.language.width);
        let connector = match vision.connector_layers {
            1 => Connector::linear(&connector.at("0"), joined, output)?,
            _ => {
                let sizes = ConnectorSizes {
                    norm: joined,
                    input: joined,
                    hidden: output,
                    output,
                };
                Connector::new(&connector, &CONNECTOR, &sizes, CONNECTOR_EPS)?
            }
        };
        Ok(Self {
            patch_embedding: patch_embedding.counted(Part::Patches),
            positions,
            blocks,
            post_layernorm,
            connector,
            config: vision.clone(),
            pixels,
            patches,
        })
    }

    /// Writes the patches of an image, row by row, to the next of `vectors`.
    fn cut<'a>(&self, view: &ViewPixels<'_>, vectors: &mut impl Iterator<Item = &'a mut [f32]>) {
        let size = self.config.patch_size;
        let [rows, columns] = view.grid;
        let (height, width) = (rows * size, columns * size);
        let places = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        for ((row, column), vector) in places.zip(vectors) {
            let line = |channel: usize, y: usize| {
                let first = (channel * height + row * size + y) * width + column * size;
                &view.pixels[first..first + size]
            };
            match self.pixels {
                PixelOrder::ChannelFirst => {
                    let lines = (0..CHANNELS).flat_map(|channel| (0..size).map(move |y| (channel, y)));
                    for ((channel, y), to) in lines.zip(vector.chunks_exact_mut(size)) {
                        to.copy_from_slice(line(channel, y));
                    }
                }
                PixelOrder::ChannelLast => {
                    for (y, to) in vector.chunks_exact_mut(size * CHANNELS).enumerate() {
                        let lines: [_; CHANNELS] = std::array::from_fn(|channel| line(channel, y));
                        for (x, to) in to.as_chunks_mut::<CHANNELS>().0.iter_mut().enumerate() {
                            to.copy_from_slice(&lines.map(|line| line[x]));
                        }
                    }
                }
            }
        }
    }
}

impl VisionTower for Siglip {
    fn embed(
        &self,
        kernels: &mut Kernels<'_>,
        views: &[ViewPixels<'_>],
        patch_vectors: &mut Scratch,
        mut x: RowsMut<'_>,
    ) -> Result<Option<Rope>> {
        let side = self.config.table_side();
        let mut patch_vectors = patch_vectors.rows(x.num_rows(), self.patch_embedding.in_features())?;
        let (mut vectors, mut rows) = (patch_vectors.iter_mut(), x.iter_mut());
        for view in views {
            check_interrupted()?;
            self.cut(view, &mut vectors);
            let [by_row, by_column]: [Vec<Taps>; 2] = view.grid.map(|count| antialiased(side, count));
            for taps in &by_row {
                for (columns, x) in by_column.iter().zip(&mut rows) {
                    interpolate(self.positions.rows(), side, [taps, columns], x);
                }
            }
        }
        drop((vectors, rows));
        self.patch_embedding
            .apply(kernels, patch_vectors.as_rows(), Epilogue::Add, x)?;
        Ok(None)
    }

    fn blocks(&self) -> &[VisionBlock] {
        &self.blocks
    }

    fn tokens<'a>(
        &self,
        kernels: &mut Kernels<'_>,
        views: &[ViewPixels<'_>],
        x: Rows<'a>,
        workspace: &'a mut TokensWorkspace,
    ) -> Result<(Rows<'a>, Vec<f32>)> {
        let connector = &mut workspace.connector;
        let (width, patches_of_token) = (x.num_columns(), self.config.patches_of_token());
        let y = workspace.normed.rows(x.num_rows(), width)?;
        self.post_layernorm.apply(kernels.engine, x, y)?;
        let y = workspace.normed.as_rows();
        if self.config.merge == 1 {
            return Ok((y, self.connector.tokens(kernels, y, connector)?));
        }
        let count = x.num_rows() / patches_of_token;
        let mut tokens = workspace.joined.rows(count, patches_of_token * width)?;
        let mut first = 0;
        for view in views {
            let patches = first..first + view.num_patches();
            let own = first / patches_of_token..patches.end / patches_of_token;
            first = patches.end;
            let (y, tokens) = (y.rows(patches), tokens.reborrow().rows(own));
            pixel_shuffle(self.config.merge, self.patches, view.grid, y, tokens);
        }
        Ok((y, self.connector.tokens(kernels, tokens.as_rows(), connector)?))
    }
}
