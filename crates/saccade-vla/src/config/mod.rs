//! The configuration of an action head.

mod checkpoint_config;
mod consistency;
mod head_config;
mod json;
mod values;

#[cfg(feature = "rewrite")]
pub(crate) use checkpoint_config::HEAD_KEY;
pub(crate) use checkpoint_config::{CheckpointConfig, OWN_KEY};
pub use head_config::HeadConfig;
pub(crate) use head_config::Reads;
#[cfg(any(feature = "processor", feature = "rewrite"))]
pub(crate) use values::asks_for_nothing;
#[cfg(feature = "rewrite")]
pub(crate) use values::object_in;
pub(crate) use values::{
    MAX_LAYERS, MAX_SIZE, Object, Problems, config_object, object_in_any, whole_numbers,
};
