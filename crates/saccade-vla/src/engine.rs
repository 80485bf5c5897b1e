//! The engine of a model: instruction set, number of threads and precision.

use std::sync::atomic::{AtomicU64, Ordering};

use saccade_vla_kernels::{Isa, LinearScratch, MAX_THREADS};

use crate::error::{Error, Result, bail};
use crate::precision::Precision;

/// The instruction set, threads and precision that a model computes with.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub struct Engine {
    /// The instruction set that the kernels use.
    pub isa: Isa,
    /// Threads that a call uses.
    pub threads: usize,
    /// The arithmetic of each kind of layer.
    pub precision: Precision,
}

impl Engine {
    /// The engine that the environment, `precision` and `num_threads` ask for.
    ///
    /// # Errors
    /// [`Error::Input`] for a number of threads out of range, and for what the environment names but this
    /// machine lacks.
    pub(crate) fn new(precision: Precision, num_threads: Option<usize>) -> Result<Self> {
        let isa = Isa::from_env()?;
        let threads = match num_threads {
            Some(threads) if (1..=MAX_THREADS).contains(&threads) => threads,
            Some(threads) => {
                bail!(Input, "num_threads"; expected "1 to {MAX_THREADS}"; got "{threads}");
            }
            None => saccade_vla_kernels::default_num_threads()?.get(),
        };
        Ok(Self {
            isa,
            threads,
            precision,
        })
    }
}

/// The engine that a layer runs on, and the scratch memory of linear layers: they run one after the other, so
/// all of a call share it.
pub(crate) struct Kernels<'a> {
    pub engine: Engine,
    pub scratch: &'a mut LinearScratch,
}

impl<'a> Kernels<'a> {
    pub(crate) fn new(engine: Engine, scratch: &'a mut LinearScratch) -> Self {
        Self { engine, scratch }
    }
}

/// A number that no other model of this process has.
pub(crate) fn next_id() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}
