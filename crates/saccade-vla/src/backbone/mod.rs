//! The vision-language backbone: camera views and words in, features for the action head out.

mod agreement;
pub(crate) mod config;
mod connector;
mod encode;
mod features;
mod inputs;
mod json;
mod layers;
mod load;
mod model;
mod plan;
mod positions;
mod prefix;
mod published;
mod qwen3;
mod qwen3_vl;
mod recognise;
mod released;
mod siglip;
mod vision;
mod vision_block;
mod vision_buffers;

pub use config::{BackboneConfig, LanguageConfig, VisionConfig};
pub use encode::BackboneKeep;
pub use features::{BackboneFeatures, BackboneRecord};
pub use inputs::BackboneInputs;
pub use load::BackboneLoadOptions;
pub use model::Backbone;
pub use published::PublishedBackbone;
