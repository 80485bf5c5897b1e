//! SigLIP, the vision tower of N1.5 and N1.6, with the connector behind it.

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch};

use super::block::{BlockNames, VisionBlock};
use super::buffers::{EncodedViews, VisionBuffers};
use super::connector::{Connector, ConnectorNames, ConnectorSizes, join};
use super::positions::{Taps, antialiased, interpolate};
use crate::alloc::sized;
use crate::backbone::config::{BackboneConfig, CHANNELS, PatchOrder, PixelOrder, VisionConfig};
use crate::backbone::inputs::ViewPixels;
use crate::backbone::released::Names;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::grouped_attention::{Projections, Qkv};
use crate::nn::linear::Linear;
use crate::nn::norm::LayerNorm;
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;
use crate::precision::Role;
use crate::profile::Part;

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

/// What the connector's norm adds to the variance.
const CONNECTOR_EPS: f32 = 1e-5;

/// Patches, blocks, a norm, and the connector.
pub(crate) struct Siglip {
    patch_embedding: Linear,
    /// `(positions, width)`, a square.
    positions: Vec<f32>,
    blocks: Vec<VisionBlock>,
    post_layernorm: LayerNorm,
    connector: Connector,
    config: VisionConfig,
    pixels: PixelOrder,
    patches: PatchOrder,
}

impl Siglip {
    /// From `embeddings`, `encoder.layers` and `post_layernorm`, and from the connector.
    pub(crate) fn new(
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
        let layers = tower.at("encoder.layers");
        let blocks: Result<_> = (0..vision.num_layers)
            .map(|index| VisionBlock::new(&layers.at(index), vision, &BLOCK))
            .collect();
        let blocks = blocks?;
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

    /// The tokens of views, and their patches after the last norm.
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
        self.embed(engine, views, patch_vectors, &mut block.linear, x)?;
        for layer in &self.blocks {
            check_interrupted()?;
            layer.run(engine, None, &counts, block, x)?;
        }
        let y = sized(&mut block.y, x.len())?;
        self.post_layernorm.apply(engine, x, y)?;
        let merge = self.config.merge;
        let joined: &[f32] = match merge {
            1 => y,
            _ => {
                let joined = sized(&mut connector.joined, y.len())?;
                let mut first = 0;
                for view in views {
                    let range = first..first + view.num_patches() * width;
                    join(
                        merge,
                        self.patches,
                        view.grid,
                        &y[range.clone()],
                        &mut joined[range.clone()],
                    );
                    first = range.end;
                }
                joined
            }
        };
        let tokens = patches / self.config.patches_of_token();
        let mut encoded = EncodedViews::new(tokens * self.connector.out_features())?;
        let memory = ([&mut connector.normed, &mut connector.hidden], &mut block.linear);
        self.connector
            .apply(engine, joined, memory, &mut encoded.tokens)?;
        Ok(encoded)
    }

    /// `x = patches W^T + b + positions`.
    fn embed(
        &self,
        engine: Engine,
        views: &[ViewPixels<'_>],
        patch_vectors: &mut Activations,
        scratch: &mut LinearScratch,
        x: &mut [f32],
    ) -> Result<()> {
        let (width, side) = (self.config.width, self.config.table_side());
        let elements = self.patch_embedding.in_features();
        let patch_vectors = sized(patch_vectors, x.len() / width * elements)?;
        let mut vectors = patch_vectors.chunks_exact_mut(elements);
        let mut rows = x.chunks_exact_mut(width);
        for view in views {
            check_interrupted()?;
            self.cut(view, &mut vectors);
            let [by_row, by_column]: [Vec<Taps>; 2] = view.grid.map(|count| antialiased(side, count));
            for taps in &by_row {
                for (columns, x) in by_column.iter().zip(&mut rows) {
                    interpolate(&self.positions, side, [taps, columns], x);
                }
            }
        }
        self.patch_embedding
            .apply(engine, patch_vectors, Epilogue::Add, x, scratch)
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
                        for (x, to) in to.chunks_exact_mut(CHANNELS).enumerate() {
                            to.copy_from_slice(&lines.map(|line| line[x]));
                        }
                    }
                }
            }
        }
    }
}
