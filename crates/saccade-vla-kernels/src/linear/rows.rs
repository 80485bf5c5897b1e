//! Activations as a product reads them: rounded or quantised row by row, on several threads.

use crate::aligned::{AlignedBuffer, AllocError, elements};
use crate::gemm::outliers::Outliers;
use crate::gemm::{Gemm, Quantized, Source};
use crate::parts::part_start;
use crate::pool::parallel_for;
use crate::rows::Rows;

/// Memory for activations on their way through [`PackedLinear::apply`](super::PackedLinear::apply): one for all layers that are called one
/// after the other. It grows to what the largest of them needs.
pub struct LinearScratch {
    words: AlignedBuffer<u32>,
    quantized: AlignedBuffer<Quantized>,
    outliers: AlignedBuffer<Outliers>,
}

/// Rows in the scratch.
pub(super) struct Converted<'a> {
    pub words: *const u32,
    /// Of each row, for int8.
    pub quantized: &'a [Quantized],
    /// Of each row, if they were kept apart; otherwise empty.
    pub outliers: &'a [Outliers],
}

/// Whether rows are quantised, and what is kept apart then.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Conversion {
    Rounded,
    Quantized,
    QuantizedWithoutOutliers,
}

/// Elements from which a second thread pays.
const ELEMENTS_FOR_THREADS: usize = 1 << 16;

/// Elements of one task.
const ELEMENTS_PER_TASK: usize = 1 << 13;

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
        conversion: Conversion,
        threads: usize,
        x: Rows<'_>,
    ) -> Result<Converted<'_>, AllocError> {
        let (rows, width, shape) = (x.num_rows(), x.num_columns(), gemm.shape());
        let groups = rows.div_ceil(shape.row_group);
        let held = groups * shape.row_group + shape.rows_beyond;
        let words = elements(held, stride)?;
        if self.words.len() < words {
            self.words = AlignedBuffer::zeroed(words)?;
        }
        if conversion != Conversion::Rounded && self.quantized.len() < rows {
            self.quantized = AlignedBuffer::zeroed(rows)?;
        }
        let keeps_outliers = conversion == Conversion::QuantizedWithoutOutliers;
        if keeps_outliers && self.outliers.len() < rows {
            self.outliers = AlignedBuffer::zeroed(rows)?;
        }
        let elements_given = rows.saturating_mul(width);
        let tasks = elements_given.div_ceil(ELEMENTS_PER_TASK).clamp(1, groups.max(1));
        let threads = if elements_given < ELEMENTS_FOR_THREADS {
            1
        } else {
            threads
        };
        let source = SharedSource(Source {
            x: x.as_ptr(),
            x_stride: x.row_stride() as isize,
            in_features: width,
            words: self.words.as_mut_ptr(),
            quantized: self.quantized.as_mut_ptr(),
            outliers: keeps_outliers.then(|| self.outliers.as_mut_ptr()),
        });
        parallel_for(threads, tasks, &|task| {
            let source = &source;
            let first = |task| rows.min(part_start(groups, task, tasks) * shape.row_group);
            // SAFETY: tasks have different groups of rows, for which there is room.
            unsafe { gemm.convert(&source.0, first(task)..first(task + 1)) };
        });
        Ok(Converted {
            words: self.words.as_ptr(),
            quantized: &self.quantized,
            outliers: if keeps_outliers {
                &self.outliers[..rows]
            } else {
                &[]
            },
        })
    }
}

impl Default for LinearScratch {
    fn default() -> Self {
        Self::new()
    }
}

struct SharedSource(Source);

// SAFETY: tasks read `x` and write different rows of the scratch, both borrowed for the whole call.
unsafe impl Sync for SharedSource {}
