//! The layers of a backbone, from the names of their tensors: the one place that lists them.

use super::config::BackboneConfig;
use super::qwen3::Qwen3;
use super::recognise::{Recognised, TensorNames};
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

impl BackboneLayers {
    /// The layers of a backbone of this config, whose tensors have these names.
    ///
    /// # Errors
    /// Those of the source of the weights.
    fn new(weights: &Weights<'_>, names: &TensorNames, config: &BackboneConfig) -> Result<Self> {
        let language = &config.language;
        // First, while little else is in memory: it is by far the largest tensor.
        let embedding = Embedding::new(
            &weights.at(&names.embedding),
            [language.vocab_size, language.width],
        )?;
        let names = &names.parts;
        Ok(Self {
            embedding,
            vision: Vision::new(weights, names, config)?,
            language: Qwen3::new(&weights.at(names.language), language)?,
            projection: match config.project_to_dim {
                Some(width) => {
                    let layer = weights.at(names.projection);
                    Some(Linear::new(&layer, language.width, width, Role::Other)?.counted(Part::Output))
                }
                None => None,
            },
        })
    }
}

impl Recognised {
    /// The layers of the backbone.
    ///
    /// # Errors
    /// Those of the source of the weights.
    pub(super) fn layers(&self, weights: &Weights<'_>) -> Result<BackboneLayers> {
        BackboneLayers::new(weights, &self.names, &self.config)
    }
}
