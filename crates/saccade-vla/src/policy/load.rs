//! Loading a whole checkpoint.

use std::path::{Path, PathBuf};

use super::Policy;
use crate::backbone::{Backbone, BackboneLoadOptions};
use crate::error::Result;
use crate::head::action_head::ActionHead;
use crate::head::load::LoadOptions;
use crate::processor::{ProcessorSource, TokenizerFiles};
use crate::release::Preprocessing;

/// How a policy is loaded.
///
/// ```
/// use saccade_vla::{BackboneLoadOptions, PolicyLoadOptions, Precision};
/// let backbone = BackboneLoadOptions { precision: Precision::Int8, ..BackboneLoadOptions::default() };
/// let options = PolicyLoadOptions { backbone, ..PolicyLoadOptions::default() };
/// assert_eq!(options.head.precision, Precision::Float32);
/// ```
#[derive(Clone, Debug, Default)]
pub struct PolicyLoadOptions {
    /// How the backbone is loaded.
    pub backbone: BackboneLoadOptions,
    /// How the action head is loaded.
    pub head: LoadOptions,
    /// A `tokenizer.json`, or a directory with a tokenizer; default that of the checkpoint.
    pub tokenizer: Option<PathBuf>,
    /// The program whose preprocessing is followed; default that of the program that wrote the checkpoint.
    pub preprocessing: Option<Preprocessing>,
    /// Options of the processor, a JSON object, in place of the checkpoint's.
    pub processor: Option<String>,
}

impl Policy {
    /// Loads a policy from `source`, a checkpoint with a backbone and an action head: one `.safetensors` file, or a
    /// directory of one or more of them.
    ///
    /// # Errors
    /// Those of [`ProcessorSource::open`], [`ProcessorSource::processor`], [`Backbone::load`] and
    /// [`ActionHead::load`].
    pub fn load(source: &Path, options: &PolicyLoadOptions) -> Result<Self> {
        let files = options.tokenizer.as_deref().map(TokenizerFiles::at).transpose()?;
        let processor = ProcessorSource::open(source)?.processor(
            files.as_ref(),
            options.preprocessing,
            options.processor.as_deref(),
        )?;
        // The larger part first: what loading needs for a while then adds to less.
        let backbone = Backbone::load(source, &options.backbone)?;
        let head = ActionHead::load(source, &options.head)?;
        Ok(Self::new(processor, backbone, head))
    }
}
