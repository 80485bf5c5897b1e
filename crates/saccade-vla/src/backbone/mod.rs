//! The vision-language backbone: camera views and words in, features for the action head out.

mod agreement;
pub(crate) mod config;
mod encode;
mod features;
mod inputs;
mod json;
mod layers;
mod load;
mod model;
mod plan;
mod published;
mod qwen3;
mod recognise;
mod released;
mod reuse;
mod vision;

pub use config::{BackboneConfig, LanguageConfig, VisionConfig};
pub use encode::BackboneKeep;
pub use features::{BackboneFeatures, BackboneRecord};
pub use inputs::BackboneInputs;
pub use load::BackboneLoadOptions;
pub use model::Backbone;
pub use published::PublishedBackbone;
