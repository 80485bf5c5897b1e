//! The thin singular value decomposition.

use faer::diag::DiagMut;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::svd::{ComputeSvdVectors, svd, svd_scratch};
use faer::{Par, Spec};

use super::matrix::{MATRIX, Matrix};
use crate::alloc::filled;
use crate::error::{Error, Result, problem};
use crate::ops::check_interrupted;

/// `x = left^T diag(singular) right`: as many singular values as `x` has rows or columns, whichever are fewer.
pub(super) struct Svd {
    /// The left singular vectors, one a row.
    pub left: Matrix,
    /// Descending.
    pub singular: Vec<f64>,
    /// The right singular vectors, one a row.
    pub right: Matrix,
    /// Singular values up to this are rounding, as in NumPy's `matrix_rank`.
    pub rounding: f64,
}

impl Svd {
    /// Decomposes `x`, which is scaled on the way.
    pub(super) fn new(mut x: Matrix) -> Result<Self> {
        let scale = x.scale_by_power_of_two();
        let (rows, columns) = (x.rows(), x.columns());
        let size = rows.min(columns);
        let mut left = Matrix::zeros(size, rows)?;
        let mut right = Matrix::zeros(size, columns)?;
        let mut singular = filled(MATRIX, size, 0.0)?;
        let (vectors, params) = (ComputeSvdVectors::Thin, Spec::default());
        let scratch = svd_scratch::<f64>(rows, columns, vectors, vectors, Par::Seq, params);
        let mut memory = MemBuffer::try_new(scratch).map_err(|_| Error::Memory {
            what: MATRIX,
            bytes: scratch.size_bytes(),
        })?;
        check_interrupted()?;
        svd(
            x.view(),
            DiagMut::from_slice_mut(&mut singular),
            Some(left.view_mut().transpose_mut()),
            Some(right.view_mut().transpose_mut()),
            Par::Seq,
            MemStack::new(&mut memory),
            params,
        )
        .map_err(|_| Error::Input(problem!("x"; "the singular value decomposition did not converge")))?;
        check_interrupted()?;
        singular.iter_mut().for_each(|value| *value *= scale);
        let rounding = singular[0] * rows.max(columns) as f64 * f64::EPSILON;
        Ok(Self {
            left,
            singular,
            right,
            rounding,
        })
    }

    /// How many singular values are more than rounding.
    pub(super) fn rank(&self) -> usize {
        self.singular
            .iter()
            .filter(|&&value| value > self.rounding)
            .count()
    }
}
