//! A back end that reads a model's tensors from a checkpoint, ahead of the layers that are made of them.

use saccade_vla_checkpoint::{Checkpoint, Elements, ReadAhead, Wanted};

use super::{Request, Source, Tensor};
use crate::error::Result;

/// The tensors under a prefix.
pub(crate) struct FileSource<'a> {
    tensors: &'a ReadAhead<'a>,
    prefix: &'static str,
}

impl FileSource<'_> {
    /// Calls `load` with tensors that are read ahead in the order `wanted`, whose names are without the
    /// prefix.
    pub(crate) fn read_ahead<R>(
        checkpoint: &Checkpoint,
        prefix: &'static str,
        mut wanted: Vec<Wanted>,
        load: impl FnOnce(&FileSource<'_>) -> Result<R>,
    ) -> Result<R> {
        for one in &mut wanted {
            one.name.insert_str(0, prefix);
        }
        checkpoint.read_ahead(wanted, |tensors| load(&FileSource { tensors, prefix }))
    }
}

impl Source for FileSource<'_> {
    fn tensor(&self, request: &Request) -> Result<Tensor> {
        let Request { spec, slices, .. } = request;
        if spec.shape.contains(&0) {
            return Ok(Tensor::Held(Elements::F32(Vec::new())));
        }
        let name = format!("{}{}", self.prefix, spec.name);
        Ok(Tensor::Held(self.tensors.take(&name, slices.clone())?))
    }

    fn give_back(&self, used: Elements) {
        self.tensors.give_back(used);
    }
}
