//! A loaded backbone: its layers, its config and the memory that its calls share.

use saccade_vla_kernels::{Activations, Isa};

use super::config::BackboneConfig;
use super::layers::BackboneLayers;
use super::qwen3::LanguageBuffers;
use super::vision::buffers::VisionBuffers;
use crate::engine::Engine;
use crate::error::Result;
use crate::head::action_head::next_id;
use crate::precision::Precision;
use crate::workspaces::Workspaces;

/// A loaded vision-language backbone. Immutable; serves any number of threads at once.
pub struct Backbone {
    pub(super) config: BackboneConfig,
    pub(super) engine: Engine,
    /// Tells features of this backbone from those of others.
    pub(super) id: u64,
    pub(super) layers: BackboneLayers,
    nbytes: usize,
    workspaces: Workspaces<BackboneBuffers>,
}

/// Memory of one call, kept for the next call.
#[derive(Default)]
pub(super) struct BackboneBuffers {
    pub vision: VisionBuffers,
    pub language: LanguageBuffers,
    /// Features where a last layer changes their width.
    pub projected: Activations,
}

impl Backbone {
    /// A backbone of `layers`, which hold `nbytes` of weights.
    pub(super) fn new(config: BackboneConfig, engine: Engine, layers: BackboneLayers, nbytes: usize) -> Self {
        Self {
            config,
            engine,
            id: next_id(),
            layers,
            nbytes,
            workspaces: Workspaces::new(),
        }
    }

    /// Sizes and switches.
    #[must_use]
    pub fn config(&self) -> &BackboneConfig {
        &self.config
    }

    /// Threads that a call uses.
    #[must_use]
    pub fn num_threads(&self) -> usize {
        self.engine.threads
    }

    /// What it computes in.
    #[must_use]
    pub fn precision(&self) -> Precision {
        self.engine.precision
    }

    /// The instruction set that the kernels use.
    #[must_use]
    pub fn isa(&self) -> Isa {
        self.engine.isa
    }

    /// Bytes of weights in memory.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        self.nbytes
    }

    pub(super) fn with_buffers<R>(&self, call: impl FnOnce(&mut BackboneBuffers) -> Result<R>) -> Result<R> {
        self.workspaces.with(BackboneBuffers::default, call)
    }
}
