//! The layers of a backbone, from the names of their tensors: the one place that lists them.

use super::qwen3::Qwen3;
use super::recognise::Recognised;
use super::vision::Vision;
use crate::error::Result;
use crate::nn::embedding::Embedding;
use crate::nn::linear::Linear;
use crate::nn::weights::Weights;
use crate::precision::Role;
use crate::profile::Part;

/// Every layer with weights.
pub(super) struct BackboneLayers {
    pub embedding: Embedding,
    pub vision: Vision,
    pub language: Qwen3,
    /// The last layer, if the features have a width of their own.
    pub projection: Option<Linear>,
}

impl Recognised {
    /// The layers of the backbone.
    pub(super) fn layers(&self, weights: &Weights<'_>) -> Result<BackboneLayers> {
        let (names, language) = (&self.names.parts, &self.config.language);
        Ok(BackboneLayers {
            // First, while little else is in memory: it is by far the largest tensor.
            embedding: Embedding::new(
                &weights.at(&self.names.embedding),
                [language.vocab_size, language.width],
            )?,
            vision: Vision::new(weights, names, &self.config)?,
            language: Qwen3::new(&weights.at(names.language), language)?,
            projection: match self.config.project_to_dim {
                Some(width) => {
                    let layer = weights.at(names.projection);
                    Some(Linear::new(&layer, language.width, width, Role::Other)?.counted(Part::Output))
                }
                None => None,
            },
        })
    }
}
