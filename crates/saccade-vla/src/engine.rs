//! What computes: the instruction set, the number of threads and the precision.

use saccade_vla_kernels::Isa;

use crate::error::{Error, Result, problem};
use crate::precision::Precision;

/// The most threads that can be asked for: far more than any machine has cores, far fewer than make starting them a problem.
const MAX_THREADS: usize = 1024;

/// Which instruction set and how many threads the kernels use, and how precisely they compute.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Engine {
    pub isa: Isa,
    pub threads: usize,
    pub precision: Precision,
}

impl Engine {
    /// What the environment, `precision` and `num_threads` ask for.
    ///
    /// # Errors
    /// [`Error::Input`] for a number of threads out of range, and for what the environment names but this machine lacks.
    pub(crate) fn new(precision: Precision, num_threads: Option<usize>) -> Result<Self> {
        let isa = Isa::from_env()?;
        let threads = match num_threads {
            Some(threads) if (1..=MAX_THREADS).contains(&threads) => threads,
            Some(threads) => {
                return Err(Error::Input(problem!(
                    "num_threads"; expected "1 to {MAX_THREADS}"; got "{threads}"
                )));
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
