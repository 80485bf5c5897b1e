//! A loaded head: its layers, its config and the memory that its calls share.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use saccade_kernels::Isa;

use super::layers::HeadLayers;
use super::workspace::Workspace;
use crate::array::Array;
use crate::config::{HeadConfig, Reads};
use crate::engine::Engine;
use crate::error::{Error, Result};
use crate::precision::Precision;

/// A loaded action head. Immutable; serves any number of threads at once.
pub struct ActionHead {
    pub(super) config: HeadConfig,
    pub(super) engine: Engine,
    /// Tells contexts of this head from those of others.
    pub(super) id: u64,
    pub(super) embodiment_ids: Vec<usize>,
    pub(super) layers: HeadLayers,
    nbytes: usize,
    workspaces: Mutex<Vec<Workspace>>,
}

impl ActionHead {
    /// A head of `layers`, which hold `nbytes` of weights.
    pub(super) fn new(
        config: HeadConfig,
        engine: Engine,
        embodiment_ids: Vec<usize>,
        layers: HeadLayers,
        nbytes: usize,
    ) -> Self {
        Self {
            config,
            engine,
            id: next_id(),
            embodiment_ids,
            layers,
            nbytes,
            workspaces: Mutex::new(Vec::new()),
        }
    }

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

    /// The learned future tokens, `(num_future_tokens, width)`: what the future rows are before the first block.
    #[must_use]
    pub fn future_tokens(&self) -> Array<'_> {
        self.layers.future_tokens.view()
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

    /// Runs `call` with a workspace. The list is never waited for: a thread that finds its lock taken makes a workspace of its own, so that
    /// callers never stop each other, and a fork that copies a taken lock leaves the child slower, not stuck.
    pub(super) fn with_workspace<R>(&self, call: impl FnOnce(&mut Workspace) -> Result<R>) -> Result<R> {
        let kept = self.workspaces.try_lock().ok().and_then(|mut kept| kept.pop());
        let mut workspace = kept.unwrap_or_else(Workspace::new);
        let result = call(&mut workspace);
        // One that grew until memory ran out is not kept.
        if !matches!(result, Err(Error::Memory { .. }))
            && let Ok(mut kept) = self.workspaces.try_lock()
        {
            kept.push(workspace);
        }
        result
    }
}

fn next_id() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}
