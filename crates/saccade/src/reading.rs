//! A head's tensors in a checkpoint, read ahead while its layers are made.

use std::ops::Range;

use saccade_checkpoint::{Checkpoint, Elements, ReadAhead, Wanted};

use crate::error::Result;
use crate::layers::TensorSource;

/// The tensors under a prefix.
pub(crate) struct HeadTensors<'a> {
    tensors: &'a ReadAhead<'a>,
    prefix: &'static str,
}

impl HeadTensors<'_> {
    /// Calls `load` with tensors that are read ahead in the order `wanted`, whose names are without the prefix.
    pub(crate) fn read_ahead<R>(
        checkpoint: &Checkpoint,
        prefix: &'static str,
        mut wanted: Vec<Wanted>,
        load: impl FnOnce(&HeadTensors<'_>) -> Result<R>,
    ) -> Result<R> {
        for one in &mut wanted {
            one.name.insert_str(0, prefix);
        }
        checkpoint.read_ahead(wanted, |tensors| load(&HeadTensors { tensors, prefix }))
    }
}

impl TensorSource for HeadTensors<'_> {
    fn tensor(&self, name: &str) -> Result<Elements> {
        Ok(self.tensors.take(&format!("{}{name}", self.prefix), None)?)
    }

    fn slices(&self, name: &str, slices: Range<usize>) -> Result<Elements> {
        Ok(self
            .tensors
            .take(&format!("{}{name}", self.prefix), Some(slices))?)
    }

    fn give_back(&self, used: Elements) {
        self.tensors.give_back(used);
    }
}
