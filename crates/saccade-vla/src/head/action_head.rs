//! A loaded head: its layers, its config and the memory that its calls share.

use super::layers::HeadLayers;
use super::state_dropout::StateDropout;
use super::workspace::Workspace;
use crate::array::Array;
use crate::config::{HeadConfig, Reads};
use crate::engine::Engine;
use crate::error::Result;
use crate::workspaces::Workspaces;

/// A loaded action head. Immutable; serves any number of threads at once.
///
/// A checkpoint of GR00T-H may hold `dropout_prob_by_embodiment`, how often its training set the state of
/// each embodiment to zero. The states of embodiments for which it always did so (above 0.999) are set to
/// zero here too, as the released class does; the other entries act in training only.
pub struct ActionHead {
    pub(super) config: HeadConfig,
    pub(super) engine: Engine,
    /// Tells contexts of this head from those of others.
    pub(super) id: u64,
    pub(super) embodiment_ids: Vec<usize>,
    pub(super) layers: HeadLayers,
    pub(super) state_dropout: StateDropout,
    pub(super) nbytes: usize,
    pub(super) workspaces: Workspaces<Workspace>,
}

impl ActionHead {
    /// Sizes and switches.
    #[must_use]
    pub fn config(&self) -> &HeadConfig {
        &self.config
    }

    /// The loaded embodiments, ascending.
    #[must_use]
    pub fn embodiment_ids(&self) -> &[usize] {
        &self.embodiment_ids
    }

    /// The learned future tokens, `(num_future_tokens, width)`: what the future rows are before the first
    /// block.
    #[must_use]
    pub fn future_tokens(&self) -> Array<'_> {
        self.layers.future_tokens.view()
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

    /// The kinds of cross-attention blocks that there are.
    pub(super) fn kinds(&self) -> Vec<Reads> {
        let mut kinds = Vec::new();
        for reads in (0..self.config.num_layers).filter_map(|block| self.config.reads(block)) {
            if !kinds.contains(&reads) {
                kinds.push(reads);
            }
        }
        kinds
    }

    /// Runs `call` with a workspace.
    pub(super) fn with_workspace<R>(&self, call: impl FnOnce(&mut Workspace) -> Result<R>) -> Result<R> {
        self.workspaces.with(Workspace::default, call)
    }
}
