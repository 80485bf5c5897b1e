//! The vision-language backbone: camera views and words in, features for the action head out.

mod checkpoint;
pub(crate) mod config;
mod consistency;
mod encode;
mod feature_batch;
mod features;
mod inputs;
mod json;
mod layers;
mod load;
mod model;
mod qwen3;
mod recognise;
mod reuse;
mod token_positions;
mod vision;

pub use checkpoint::BackboneCheckpoint;
#[cfg(all(test, feature = "processor"))]
pub(crate) use checkpoint::published_specs;
pub use config::{BackboneConfig, LanguageConfig, VisionConfig};
pub use encode::BackboneKeep;
pub use feature_batch::FeatureBatch;
pub use features::{BackboneFeatures, BackboneRecord};
pub use inputs::BackboneInputs;
pub use load::BackboneLoadOptions;
pub use model::Backbone;
#[cfg(feature = "processor")]
pub(crate) use recognise::backbones_in;
