//! The layers of the head, from the names of their tensors: the one place that lists them.

use super::action_encoder::ActionEncoder;
use super::dit::Dit;
use super::embodiment_layers::EmbodimentMlp;
use super::embodiments::Embodiments;
use super::vl_encoder::VlEncoder;
use crate::array::OwnedArray;
use crate::config::HeadConfig;
use crate::error::Result;
use crate::nn::weights::Weights;

/// Every layer with weights.
pub(crate) struct HeadLayers {
    /// `(num_future_tokens, width)`.
    pub future_tokens: OwnedArray,
    pub vl: VlEncoder,
    pub state_encoder: EmbodimentMlp,
    pub action_encoder: ActionEncoder,
    /// One for each of [`HeadConfig::decoders`]; their outputs are concatenated.
    pub decoders: Vec<EmbodimentMlp>,
    pub dit: Dit,
}

impl HeadLayers {
    /// The layers of a head of this config, for these of its embodiments.
    pub(crate) fn new(
        weights: &Weights<'_>,
        config: &HeadConfig,
        embodiments: Embodiments<'_>,
    ) -> Result<Self> {
        let (width, hidden, future) = (config.width, config.hidden_dim, config.num_future_tokens);
        let future_tokens = weights.at("future_tokens").table([future, width], future)?;
        let positions = match config.add_pos_embed {
            true => Some(
                weights
                    .at("position_embedding")
                    .table([config.max_positions, width], config.action_horizon)?,
            ),
            false => None,
        };
        let states = config.state_dim * config.state_history;
        Ok(Self {
            future_tokens,
            vl: VlEncoder::new(weights, config)?,
            state_encoder: EmbodimentMlp::new(
                &weights.at("state_encoder"),
                embodiments,
                [states, hidden, width],
            )?,
            action_encoder: ActionEncoder::new(
                &weights.at("action_encoder"),
                embodiments,
                config,
                positions,
            )?,
            decoders: config
                .decoders
                .iter()
                .map(|(name, width)| {
                    EmbodimentMlp::new(&weights.at(name), embodiments, [hidden, hidden, *width])
                })
                .collect::<Result<_>>()?,
            dit: Dit::new(&weights.at("model"), config)?,
        })
    }
}
