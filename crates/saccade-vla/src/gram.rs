//! What linear layers are given, as sums of squares: the Gram matrices that calibrated rounding needs.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use saccade_vla_kernels::{Rows, parallel_for};
use std::sync::Mutex;

use crate::alloc::{filled, product, reserved};
use crate::array::{Array, unravel};
use crate::error::{Error, Result, bail, ensure, show_shape};
use crate::ops::check_interrupted;

/// What memory is asked for.
const GRAM: &str = "calibration";

/// Rows that are added together. Sums are float32, so that the 8192 inputs of the widest layers take 268 MB;
/// what is lost beside float64 is a millionth, and [`gptq`](crate::gptq) adds a hundredth to the diagonal.
const TOGETHER: usize = 256;

/// Rows of a band, which one thread computes: always the same, so that bits do not depend on the threads.
const BAND: usize = 256;

/// `X^T X` of the rows `X` that a linear layer was given, its Gram matrix.
///
/// ```
/// use saccade_vla::{Array, Gram};
/// let mut gram = Gram::new(2)?;
/// gram.add(Array::new(&[1.0, 2.0, 0.0, 1.0], &[2, 2])?, 1)?;
/// assert_eq!((gram.num_rows(), gram.get(1, 0), gram.get(1, 1)), (2, 2.0, 5.0));
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Gram {
    width: usize,
    num_rows: usize,
    /// The lower triangle, row after row; what is above the diagonal is not used.
    sums: Vec<f32>,
}

impl Gram {
    /// That of no rows yet, of `width` inputs.
    ///
    /// # Errors
    /// [`Error::Input`] if there are none, [`Error::Memory`].
    pub fn new(width: usize) -> Result<Self> {
        ensure!(width > 0, Input, "width"; expected "at least 1"; got "0");
        Ok(Self {
            width,
            num_rows: 0,
            sums: filled(GRAM, product(GRAM, &[width, width])?, 0.0)?,
        })
    }

    /// Bytes of a Gram matrix of this many inputs.
    #[must_use]
    pub fn nbytes_of(width: usize) -> usize {
        width.saturating_mul(width).saturating_mul(size_of::<f32>())
    }

    /// Number of inputs of the layer.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of rows that were added.
    #[must_use]
    pub fn num_rows(&self) -> usize {
        self.num_rows
    }

    /// The sum of the products of two inputs.
    ///
    /// # Panics
    /// If there are fewer inputs.
    #[must_use]
    pub fn get(&self, first: usize, second: usize) -> f32 {
        let (row, column) = (first.max(second), first.min(second));
        assert!(
            row < self.width,
            "inputs: expected less than {}, got {row}",
            self.width
        );
        self.sums[row * self.width + column]
    }

    /// Adds the rows of `x (rows, width)`, on up to `threads` threads, with the same bits on any number of them.
    ///
    /// # Errors
    /// [`Error::Shape`]; [`Error::Input`] for values that are not finite, and for sums that overflow float32;
    /// [`Error::Memory`] and [`Error::Interrupted`], after which the matrix is not to be used.
    pub fn add(&mut self, x: Array<'_>, threads: usize) -> Result<()> {
        let [num_rows, width] = *x.shape() else {
            bail!(Shape, "x"; expected "two axes, (rows, width)"; got "{}", show_shape(x.shape()));
        };
        ensure!(
            width == self.width, Shape, "x";
            expected "(rows, width) = ({num_rows}, {})", self.width; got "({num_rows}, {width})"
        );
        if num_rows == 0 {
            return Ok(());
        }
        self.add_rows(Rows::new(x.check_finite("x")?.data(), width), threads)?;
        self.check_finite("x")
    }

    /// Adds finite rows.
    pub(crate) fn add_rows(&mut self, x: Rows<'_>, threads: usize) -> Result<()> {
        let width = self.width;
        let mut together = reserved(GRAM, TOGETHER.min(x.num_rows()) * width)?;
        for first in (0..x.num_rows()).step_by(TOGETHER) {
            check_interrupted()?;
            let last = x.num_rows().min(first + TOGETHER);
            together.clear();
            x.rows(first..last)
                .iter()
                .for_each(|row| together.extend_from_slice(row));
            let x = MatRef::from_row_major_slice(&together, last - first, width);
            let bands: Vec<_> = self.sums.chunks_mut(BAND * width).map(Mutex::new).collect();
            parallel_for(threads, bands.len(), &|band| {
                let mut sums = bands[band].try_lock().expect("each band is one task");
                let (start, rows) = (band * BAND, sums.len() / width);
                let end = start + rows;
                // Not by its stride: `from_row_major_slice_with_stride_mut` of faer 0.24 mixes up rows and columns.
                let sums = MatMut::from_row_major_slice_mut(&mut sums, rows, width).subcols_mut(0, end);
                let own = x.subcols(start, rows).transpose();
                matmul(sums, Accum::Add, own, x.subcols(0, end), 1.0, Par::Seq);
            });
            check_interrupted()?;
            self.num_rows += last - first;
        }
        Ok(())
    }

    /// Checks that no sum overflowed.
    pub(crate) fn check_finite(&self, name: &str) -> Result<()> {
        let lower = (0..self.width).flat_map(|row| {
            let row_sums = &self.sums[row * self.width..][..=row];
            row_sums
                .iter()
                .enumerate()
                .map(move |(column, sum)| (row, column, sum))
        });
        for (row, column, sum) in lower {
            if !sum.is_finite() {
                let place = show_shape(&unravel(row * self.width + column, &[self.width; 2]));
                bail!(Input, name; expected "inputs whose squares sum to finite float32"; got "{sum} at {place}");
            }
        }
        Ok(())
    }
}
