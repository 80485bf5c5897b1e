//! The configuration of an action head.

mod checkpoint_config;
mod consistency;
mod head_config;
mod json;

#[cfg(feature = "rewrite")]
pub(crate) use checkpoint_config::HEAD_KEY;
pub(crate) use checkpoint_config::{CheckpointConfig, OWN_KEY, Object};
pub use head_config::HeadConfig;
pub(crate) use head_config::Reads;
