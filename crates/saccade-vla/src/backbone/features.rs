//! What a backbone returns and holds: features, and what later calls may take from them.

use std::sync::Arc;

use saccade_vla_kernels::PackedKeyValues;

use crate::alloc::{filled, product, reserve, reserved};
use crate::array::OwnedArray;
use crate::error::Result;

/// The features of some prompts. Immutable; serves any number of calls and threads.
pub struct BackboneFeatures {
    /// The backbone that made them.
    pub(super) backbone: u64,
    pub(super) prompts: Vec<Arc<EncodedPrompt>>,
    pub(super) num_tokens: usize,
    pub(super) feature_dim: usize,
    pub(super) recorded: BackboneRecord,
}

/// Recorded parts of a call.
#[derive(Default)]
pub struct BackboneRecord {
    /// The rows after each layer of the language model, before anything is added to them:
    /// `(batch, tokens, width)`, by layer.
    pub hidden: Vec<OwnedArray>,
    /// The patches of each view after the vision tower, `(patches, vision width)`, by prompt and view.
    pub vision: Vec<Vec<OwnedArray>>,
    /// The tokens of each view, `(tokens, width)`, by prompt and view.
    pub image_tokens: Vec<Vec<OwnedArray>>,
}

/// A prompt that was encoded.
pub(super) struct EncodedPrompt {
    pub ids: Vec<i64>,
    pub attended: Vec<bool>,
    pub views: Vec<Arc<View>>,
    /// The places of image tokens, ascending: those of the first view first.
    pub image_tokens: Vec<usize>,
    /// `(tokens, feature_dim)`.
    pub features: Vec<f32>,
    /// By layer, of the tokens that may be attended to.
    pub keys_values: Vec<PackedKeyValues>,
}

/// A view that was encoded.
pub(super) struct View {
    pub pixels: Vec<f32>,
    /// Rows and columns of patches.
    pub grid: [usize; 2],
    pub num_tokens: usize,
    /// `(tokens, width of the language model)`.
    pub tokens: Vec<f32>,
    /// The same, to be added after the first layers of the language model.
    pub deepstack: Vec<Vec<f32>>,
    /// The patches after the vision tower where they are recorded, else empty.
    pub patches: Vec<f32>,
}

impl BackboneFeatures {
    /// Prompts.
    #[must_use]
    pub fn batch(&self) -> usize {
        self.prompts.len()
    }

    /// Tokens of each prompt.
    #[must_use]
    pub fn num_tokens(&self) -> usize {
        self.num_tokens
    }

    /// Width of the features.
    #[must_use]
    pub fn feature_dim(&self) -> usize {
        self.feature_dim
    }

    /// The features of prompt number `prompt`, `(num_tokens, feature_dim)`.
    ///
    /// # Panics
    /// If there is no such prompt.
    #[must_use]
    pub fn features(&self, prompt: usize) -> &[f32] {
        &self.prompts[prompt].features
    }

    /// A copy of the features of all prompts, `(batch, num_tokens, feature_dim)`.
    ///
    /// # Errors
    /// [`Error::Memory`](crate::Error::Memory).
    pub fn all_features(&self) -> Result<Vec<f32>> {
        let mut all = Vec::new();
        let sizes = [self.batch(), self.num_tokens, self.feature_dim];
        let len = product("backbone_features", &sizes)?;
        reserve("backbone_features", &mut all, len)?;
        for prompt in &self.prompts {
            all.extend_from_slice(&prompt.features);
        }
        Ok(all)
    }

    /// For each token of prompt number `prompt` whether it may be attended to, as it was given.
    ///
    /// # Panics
    /// If there is no such prompt.
    #[must_use]
    pub fn attention_mask(&self, prompt: usize) -> &[bool] {
        &self.prompts[prompt].attended
    }

    /// For each token of all prompts, `(batch, num_tokens)`, whether it may be attended to, and whether it is one of a view.
    ///
    /// # Errors
    /// [`Error::Memory`](crate::Error::Memory).
    pub fn masks(&self) -> Result<(OwnedArray<bool>, OwnedArray<bool>)> {
        let shape = [self.batch(), self.num_tokens];
        let len = product("masks", &shape)?;
        let mut attended = reserved("masks", len)?;
        let mut image = filled("masks", len, false)?;
        for (prompt, image) in self.prompts.iter().zip(image.chunks_exact_mut(self.num_tokens)) {
            attended.extend_from_slice(&prompt.attended);
            for &place in &prompt.image_tokens {
                image[place] = true;
            }
        }
        Ok((
            OwnedArray::new(attended, &shape)?,
            OwnedArray::new(image, &shape)?,
        ))
    }

    /// The places of the image tokens of prompt number `prompt`, by view.
    ///
    /// # Panics
    /// If there is no such prompt.
    pub fn views(&self, prompt: usize) -> impl Iterator<Item = &[usize]> {
        let prompt = &self.prompts[prompt];
        let mut left = prompt.image_tokens.as_slice();
        prompt.views.iter().map(move |view| {
            let (own, rest) = left.split_at(view.num_tokens);
            left = rest;
            own
        })
    }

    /// Hands over what was recorded.
    #[must_use]
    pub fn take_recorded(&mut self) -> BackboneRecord {
        std::mem::take(&mut self.recorded)
    }

    /// Bytes held, without what was recorded: features, pixels and tokens of views, keys and values. What
    /// several features share is counted in each of them.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        self.prompts.iter().map(|prompt| prompt.nbytes()).sum()
    }
}

impl EncodedPrompt {
    fn nbytes(&self) -> usize {
        let keys_values: usize = self.keys_values.iter().map(PackedKeyValues::nbytes).sum();
        let views: usize = self.views.iter().map(|view| view.nbytes()).sum();
        let tokens = size_of::<i64>() * self.ids.len() + self.attended.len();
        let places = size_of::<usize>() * self.image_tokens.len();
        keys_values + views + tokens + places + size_of::<f32>() * self.features.len()
    }
}

impl View {
    fn nbytes(&self) -> usize {
        let deepstack: usize = self.deepstack.iter().map(Vec::len).sum();
        size_of::<f32>() * (self.pixels.len() + self.tokens.len() + deepstack + self.patches.len())
    }
}
