//! A loaded backbone: its layers, its config and the memory that its calls share.

use saccade_vla_kernels::LinearScratch;

use super::config::BackboneConfig;
use super::layers::BackboneLayers;
use super::qwen3::LanguageWorkspace;
use super::vision::VisionWorkspace;
use crate::alloc::Scratch;
use crate::engine::Engine;
use crate::workspaces::Workspaces;

/// A loaded vision-language backbone. Immutable; serves any number of threads at once.
pub struct Backbone {
    pub(super) config: BackboneConfig,
    pub(super) engine: Engine,
    /// Tells features of this backbone from those of others.
    pub(super) id: u64,
    pub(super) layers: BackboneLayers,
    pub(super) nbytes: usize,
    pub(super) workspaces: Workspaces<BackboneWorkspace>,
}

/// Memory kept between calls.
#[derive(Default)]
pub(super) struct BackboneWorkspace {
    pub vision: VisionWorkspace,
    pub language: LanguageWorkspace,
    /// Features where a last layer changes their width.
    pub projected: Scratch,
    pub linear: LinearScratch,
}

impl Backbone {
    /// Sizes and switches.
    #[must_use]
    pub fn config(&self) -> &BackboneConfig {
        &self.config
    }

    /// The instruction set, threads and precision of its calls.
    #[must_use]
    pub fn engine(&self) -> Engine {
        self.engine
    }

    /// Bytes of weights in memory.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        self.nbytes
    }
}
