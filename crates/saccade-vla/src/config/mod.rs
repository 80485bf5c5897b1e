//! The configuration of an action head.

mod agreement;
mod head_config;
mod json;
mod versions;
mod whole;

pub use head_config::HeadConfig;
pub(crate) use head_config::Reads;
pub(crate) use versions::{Feature, Version};
pub(crate) use whole::{HEAD_KEY, OWN_KEY, Object, WholeConfig};
