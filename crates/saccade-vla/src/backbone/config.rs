//! The sizes and switches of a backbone.

use crate::release::{PatchOrder, PixelOrder, Version};

/// The sizes and switches of a vision-language backbone: of its vision tower, of the connector behind that,
/// and of its language model.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct BackboneConfig {
    /// Release of the architecture. The other fields define what the backbone computes.
    pub version: Version,
    /// Of the tower that encodes each view by itself, and of the connector that makes tokens of its patches.
    pub vision: VisionConfig,
    /// Of the model that reads tokens of views and words.
    pub language: LanguageConfig,
    /// Width of the features where a last layer changes it (`project_to_dim`).
    pub project_to_dim: Option<usize>,
    /// The id in the prompt that a token of a view takes the place of (`image_token_index`,
    /// `image_token_id`).
    pub image_token_id: usize,
}

/// The sizes of a vision tower and its connector.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct VisionConfig {
    /// Width of the patches (`hidden_size`).
    pub width: usize,
    /// Blocks.
    pub num_layers: usize,
    /// Attention heads.
    pub num_heads: usize,
    /// Width of one of these heads; `num_heads * head_dim == width`.
    pub head_dim: usize,
    /// Hidden width of the feed-forward layers (`intermediate_size`).
    pub hidden_dim: usize,
    /// What the norms add to the variance.
    pub norm_eps: f64,
    /// Pixels on each side of a patch.
    pub patch_size: usize,
    /// Height and width of every view in pixels; none if views may have any number of whole tokens.
    pub image_size: Option<usize>,
    /// Rows of the table of positions, which is a square of patches.
    pub num_positions: usize,
    /// A token is made of a square of patches with this many on each side.
    pub merge: usize,
    /// Linear layers of the connector, one or two.
    pub connector_layers: usize,
    /// Blocks whose output is added to the first layers of the language model as well.
    pub deepstack: Vec<usize>,
    pub(crate) tower: Tower,
}

/// The sizes of a language model, of which only the first layers are kept.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct LanguageConfig {
    /// Width of the tokens (`hidden_size`).
    pub width: usize,
    /// Layers that are kept (`select_layer`).
    pub num_layers: usize,
    /// Attention heads of the queries.
    pub num_heads: usize,
    /// Attention heads of keys and values, a divisor of `num_heads`.
    pub num_kv_heads: usize,
    /// Width of one of these heads.
    pub head_dim: usize,
    /// Hidden width of the feed-forward layers (`intermediate_size`).
    pub hidden_dim: usize,
    /// Token ids (`vocab_size`).
    pub vocab_size: usize,
    /// What the norms add to the mean of the squares.
    pub norm_eps: f64,
    /// Base of the frequencies of the rotary positions.
    pub rope_theta: f64,
    /// How many of the pairs of a head turn with time, height and width; none if all turn with the place in
    /// the prompt.
    pub mrope_section: Option<[usize; 3]>,
    /// Whether the features are normed.
    pub has_final_norm: bool,
}

/// What kind of vision tower it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Tower {
    /// SigLIP: images in, a norm at the end.
    Siglip {
        /// The order of the pixels in a patch.
        pixels: PixelOrder,
        /// The order of the elements of the patches that make a token.
        patches: PatchOrder,
    },
    /// That of Qwen3-VL: patches in, in groups that make a token; rotary positions.
    Qwen3Vl {
        /// Elements of a patch: all channels and frames of its pixels.
        patch_elements: usize,
        /// Frames of a patch.
        frames: usize,
    },
}

/// Channels of a pixel.
pub(crate) const CHANNELS: usize = 3;

impl BackboneConfig {
    /// Width of the features.
    #[must_use]
    pub fn feature_dim(&self) -> usize {
        self.project_to_dim.unwrap_or(self.language.width)
    }
}

impl VisionConfig {
    /// Patches on each side of the table of positions.
    pub(crate) fn table_side(&self) -> usize {
        self.num_positions.isqrt()
    }

    /// Patches that make a token.
    pub(crate) fn patches_of_token(&self) -> usize {
        self.merge * self.merge
    }

    /// Pixels on each side of a token.
    pub(crate) fn token_size(&self) -> usize {
        self.patch_size * self.merge
    }
}
