//! Tables of which only a few rows are read in a call: never packed.

use saccade_vla_checkpoint::Elements;

use super::source::Tensor;
use super::weights::Weights;
use crate::error::Result;

/// A row for each id, `weight (num_rows, width)`.
pub(crate) struct Embedding {
    /// None of an outline.
    rows: Elements,
    width: usize,
}

impl Embedding {
    /// From `weight (num_rows, width)`.
    pub(crate) fn new(weights: &Weights<'_>, [num_rows, width]: [usize; 2]) -> Result<Self> {
        let rows = match weights.looked_up([num_rows, width])? {
            Tensor::Held(rows) => rows,
            Tensor::Outline(_) => Elements::F32(Vec::new()),
        };
        Ok(Self { rows, width })
    }

    /// Writes row `id`, which is there, to `out (width)`.
    pub(crate) fn look_up(&self, id: usize, out: &mut [f32]) {
        let row = id * self.width..(id + 1) * self.width;
        match &self.rows {
            Elements::F32(rows) => out.copy_from_slice(&rows[row]),
            Elements::Bf16(rows) => {
                for (out, element) in out.iter_mut().zip(&rows[row]) {
                    *out = element.to_f32();
                }
            }
            Elements::Int4 { .. } => unreachable!("tables are floating point or int8"),
            Elements::Int8 { values, scales } => {
                for (out, value) in out.iter_mut().zip(&values[row]) {
                    *out = f32::from(*value) * scales[id];
                }
            }
        }
    }
}
