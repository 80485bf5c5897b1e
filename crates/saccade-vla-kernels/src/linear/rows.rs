//! Activations as a product reads them: rounded or quantised row by row, on several threads.

use crate::aligned::{AlignedBuffer, AllocError, elements};
use crate::gemm::outliers::Outliers;
use crate::gemm::{Conversion, Gemm, Quantized};
use crate::parts::{part, threads_and_tasks};
use crate::pool::parallel_for;
use crate::rows::{Rows, RowsMut, SharedRows};

/// Memory for activations on their way through [`PackedLinear::apply`](super::PackedLinear::apply): one for
/// all layers that are called one after the other. It grows to what the largest of them needs.
pub struct LinearScratch {
    words: AlignedBuffer<u32>,
    quantized: AlignedBuffer<Quantized>,
    outliers: AlignedBuffer<Outliers>,
}

/// Rows in the scratch.
pub(super) struct Converted<'a> {
    /// In whole groups.
    pub words: Rows<'a, u32>,
    /// Of each row, for int8.
    pub quantized: &'a [Quantized],
    /// Of each row, if they were kept apart; otherwise empty.
    pub outliers: &'a [Outliers],
}

/// Whether rows are quantised, and what is kept apart then.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum RowConversion {
    Rounded,
    Quantized,
    QuantizedWithoutOutliers,
}

impl LinearScratch {
    /// Empty: memory is claimed by the first call that needs it.
    #[must_use]
    pub fn new() -> Self {
        Self {
            words: AlignedBuffer::empty(),
            quantized: AlignedBuffer::empty(),
            outliers: AlignedBuffer::empty(),
        }
    }

    /// Bytes held.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        size_of::<u32>() * self.words.len()
            + size_of::<Quantized>() * self.quantized.len()
            + size_of::<Outliers>() * self.outliers.len()
    }

    /// The rows of `x` as `gemm` reads them, `stride` words apart.
    pub(super) fn convert(
        &mut self,
        gemm: &dyn Gemm,
        stride: usize,
        conversion: RowConversion,
        threads: usize,
        x: Rows<'_>,
    ) -> Result<Converted<'_>, AllocError> {
        let (rows, width, shape) = (x.num_rows(), x.num_columns(), gemm.shape());
        let groups = rows.div_ceil(shape.row_group);
        let held = groups * shape.row_group;
        let words = elements(held, stride)?;
        if self.words.len() < words {
            self.words = AlignedBuffer::zeroed(words)?;
        }
        let is_quantized = conversion != RowConversion::Rounded;
        if is_quantized && self.quantized.len() < rows {
            self.quantized = AlignedBuffer::zeroed(rows)?;
        }
        let keeps_outliers = conversion == RowConversion::QuantizedWithoutOutliers;
        if keeps_outliers && self.outliers.len() < rows {
            self.outliers = AlignedBuffer::zeroed(rows)?;
        }
        let group_words = shape.row_group * stride;
        let to_words = SharedRows::new(RowsMut::new(&mut self.words[..words], group_words));
        let kept = |is_kept| if is_kept { rows } else { 0 };
        let to_quantized = SharedRows::new(RowsMut::new(&mut self.quantized[..kept(is_quantized)], 1));
        let to_outliers = SharedRows::new(RowsMut::new(&mut self.outliers[..kept(keeps_outliers)], 1));
        let (threads, tasks) = threads_and_tasks(threads, rows, width, groups);
        let tasks = tasks.max(1);
        parallel_for(threads, tasks, &|task| {
            let groups = part(groups, task, tasks);
            let given = (groups.start * shape.row_group).min(rows)..(groups.end * shape.row_group).min(rows);
            // SAFETY: tasks have different groups of rows.
            let conversion = unsafe {
                Conversion {
                    x: x.rows(given.clone()),
                    words: to_words.block(groups, 0..group_words),
                    quantized: is_quantized.then(|| to_quantized.block(given.clone(), 0..1)),
                    outliers: keeps_outliers.then(|| to_outliers.block(given, 0..1)),
                }
            };
            gemm.convert(conversion);
        });
        Ok(Converted {
            words: Rows::strided(&self.words, held, stride, stride),
            quantized: &self.quantized,
            outliers: &self.outliers[..kept(keeps_outliers)],
        })
    }
}

impl Default for LinearScratch {
    fn default() -> Self {
        Self::new()
    }
}
