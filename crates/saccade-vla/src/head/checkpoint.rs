//! A checkpoint of a head that is not loaded: the check of its tensors, and the bytes of weights that the
//! head would hold.

use saccade_vla_checkpoint::spec;

use super::embodiments::Embodiments;
use super::layers::HeadLayers;
use super::plan::{is_unused, specs_of};
use crate::engine::Engine;
use crate::error::{Error, Result, ensure};
use crate::nn::source::sizer::nbytes;
use crate::precision::Precision;
use crate::recognise::HeadCheckpoint;

impl HeadCheckpoint {
    /// Checks that exactly the head's tensors are under the prefix, each of the right shape and a readable
    /// type. Tensors that only training uses may be there too.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] that lists every tensor that is missing, unknown, misshaped or of another type.
    pub fn check(&self) -> Result<()> {
        let is_unused = |name: &str, shape: &[usize]| is_unused(&self.config, name, shape);
        let expected = specs_of(&self.config, |name| self.has(name))?;
        let problems = self.checkpoint.problems(self.prefix, &expected, is_unused);
        ensure!(problems.is_empty(), Checkpoint, "source"; "{}", spec::list(&problems, "the config"));
        Ok(())
    }

    /// True if the head has a tensor `name`, without the prefix.
    pub(super) fn has(&self, name: &str) -> bool {
        self.checkpoint.shape(&format!("{}{name}", self.prefix)).is_some()
    }

    /// [`ActionHead::nbytes`](crate::ActionHead::nbytes) of a head with this number of embodiments.
    ///
    /// # Errors
    /// [`Error::Isa`] for an unknown instruction set in the environment; [`Error::Checkpoint`] and
    /// [`Error::Packing`] for a tensor that is not there or has too many inputs for int8.
    pub fn nbytes(&self, precision: Precision, num_embodiments: usize) -> Result<usize> {
        let engine = Engine::new(precision, Some(1))?;
        let dtype = |name: &str| Ok(self.checkpoint.dtype(&format!("{}{name}", self.prefix))?);
        let ids: Vec<usize> = (0..num_embodiments).collect();
        let embodiments = Embodiments {
            ids: &ids,
            count: self.config.num_embodiments.max(num_embodiments),
        };
        nbytes(engine, dtype, |weights| {
            HeadLayers::new(weights, &self.config, embodiments)
        })
    }
}
