//! How many bytes of weights a head would hold, without loading it.

use super::embodiments::Embodiments;
use super::layers::HeadLayers;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::sizer::Sizer;
use crate::nn::weights::Builder;
use crate::precision::Precision;
use crate::recognise::Published;

impl Published {
    /// What [`ActionHead::nbytes`](crate::ActionHead::nbytes) would be with this number of embodiments.
    ///
    /// # Errors
    /// [`Error::Input`](crate::Error::Input) for an unknown instruction set in the environment;
    /// [`Error::Checkpoint`](crate::Error::Checkpoint) for a tensor that is not there or has too many inputs for int8.
    pub fn nbytes(&self, precision: Precision, num_embodiments: usize) -> Result<usize> {
        let engine = Engine::new(precision, Some(1))?;
        let dtype = |name: &str| Ok(self.checkpoint.dtype(&format!("{}{name}", self.prefix))?);
        let sizer = Sizer::new(engine, dtype);
        let builder = Builder::new(&sizer, engine);
        let ids: Vec<usize> = (0..num_embodiments).collect();
        let embodiments = Embodiments {
            ids: &ids,
            count: self.config.num_embodiments.max(num_embodiments),
        };
        HeadLayers::new(&builder.weights(), &self.config, embodiments)?;
        Ok(builder.nbytes())
    }
}
