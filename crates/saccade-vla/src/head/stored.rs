//! The tensors of a checkpoint, one by one: their facts and values, whatever type they are stored in.

use saccade_vla_checkpoint::spec::SCALE_SUFFIX;
use saccade_vla_checkpoint::{Dtype, Elements};

use super::plan::tensor_specs;
use crate::error::Result;
use crate::recognise::HeadCheckpoint;

/// A tensor, by what its file's header says.
#[derive(Clone, Debug)]
pub struct TensorFacts {
    /// Its name, prefix included.
    pub name: String,
    /// Its type in the words of safetensors: `F32`, `BF16`.
    pub dtype: String,
    /// The shape of its values, see [`HeadCheckpoint::shape`].
    pub shape: Vec<usize>,
    /// Its bytes in the file.
    pub nbytes: u64,
}

impl HeadCheckpoint {
    /// The shape of the values of tensor `name`; none if there is none. Of int4, which has two values in a byte, it is
    /// that of the head's config; outside the head every byte counts twice.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<Vec<usize>> {
        let stored = self.checkpoint.shape(name)?.to_vec();
        let is_int4 = self.checkpoint.dtype(name).is_ok_and(|dtype| dtype == Dtype::U8)
            && self.checkpoint.shape(&format!("{name}{SCALE_SUFFIX}")).is_some();
        if !is_int4 {
            return Some(stored);
        }
        let of_config = || {
            let specs = tensor_specs(&self.config).unwrap_or_default();
            specs.into_iter().map(|spec| (spec.name, spec.shape)).collect()
        };
        let in_head = name.strip_prefix(self.prefix);
        let shapes = self.shapes.get_or_init(of_config);
        let known = in_head.and_then(|name| shapes.get(name)).cloned();
        Some(known.unwrap_or_else(|| match stored[..] {
            [rows, bytes] => vec![rows, 2 * bytes],
            _ => stored,
        }))
    }

    /// Tensor `name`, or one slice of its first axis, as float32; int8 and int4 times their scales.
    ///
    /// # Errors
    /// [`Error::File`](crate::Error::File) if it is not there or damaged.
    pub fn read(&self, name: &str, index: Option<usize>) -> Result<(Vec<f32>, Vec<usize>)> {
        let shape = self.shape(name).unwrap_or_default();
        let elements = match index {
            None => self.checkpoint.read(name)?,
            Some(index) => self
                .checkpoint
                .read_slices(name, index..index.saturating_add(1))?,
        };
        let bytes = match &elements {
            Elements::Int4 { values, scales } => values.len() / scales.len().max(1),
            _ => 0,
        };
        let mut values = elements.into_f32()?;
        if let [_, width] = shape[..]
            && 2 * bytes > width
        {
            // The half of a byte after an odd number of values.
            let mut place = 0..;
            values.retain(|_| place.next().is_some_and(|place| place % (2 * bytes) < width));
        }
        Ok((values, shape[usize::from(index.is_some())..].to_vec()))
    }

    /// All tensors of the checkpoint, sorted by name; without those that are in two files, which
    /// [`HeadCheckpoint::check`] refuses in a head.
    pub fn tensors(&self) -> impl Iterator<Item = TensorFacts> {
        let checkpoint = &self.checkpoint;
        checkpoint.names().filter_map(|name| {
            Some(TensorFacts {
                name: name.to_owned(),
                dtype: format!("{:?}", checkpoint.dtype(name).ok()?),
                shape: self.shape(name)?,
                nbytes: checkpoint.nbytes(name).ok()?,
            })
        })
    }
}
