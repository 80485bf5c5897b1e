//! Views of matrices that are stored row-major or column-major.

use std::ops::Range;

use crate::rows::Rows;

/// A matrix `(num_rows, num_columns)` as weights may be stored: row-major with any row stride, or the
/// transpose of that.
///
/// ```
/// use saccade_vla_kernels::{Matrix, Rows};
/// let in_major = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]; // (in_features 3, out_features 2)
/// let weight = Matrix::from(Rows::new(&in_major, 2)).transpose();
/// assert_eq!((weight.num_rows(), weight.num_columns(), weight.get(1, 2)), (2, 3, 6.0));
/// ```
#[derive(Debug)]
pub struct Matrix<'a, T = f32> {
    rows: Rows<'a, T>,
    /// Whether the rows of the matrix are the columns of `rows`.
    is_transposed: bool,
}

impl<T> Clone for Matrix<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Matrix<'_, T> {}

impl<'a, T> From<Rows<'a, T>> for Matrix<'a, T> {
    fn from(rows: Rows<'a, T>) -> Self {
        let is_transposed = false;
        Self { rows, is_transposed }
    }
}

impl<'a, T: Copy> Matrix<'a, T> {
    /// All of `data` as rows of `num_columns` elements, one after the other.
    ///
    /// # Panics
    /// If `data` does not hold whole rows.
    #[must_use]
    #[track_caller]
    pub fn new(data: &'a [T], num_columns: usize) -> Self {
        Rows::new(data, num_columns).into()
    }

    /// Number of rows: `out_features` of a weight.
    #[must_use]
    pub fn num_rows(&self) -> usize {
        if self.is_transposed {
            self.rows.num_columns()
        } else {
            self.rows.num_rows()
        }
    }

    /// Number of columns: `in_features` of a weight.
    #[must_use]
    pub fn num_columns(&self) -> usize {
        self.transpose().num_rows()
    }

    /// Rows as columns.
    #[must_use]
    pub fn transpose(self) -> Self {
        let is_transposed = !self.is_transposed;
        Self {
            is_transposed,
            ..self
        }
    }

    /// The rows in `rows`.
    ///
    /// # Panics
    /// If not all of them exist.
    #[must_use]
    #[track_caller]
    pub fn rows(self, rows: Range<usize>) -> Self {
        let rows = if self.is_transposed {
            self.rows.columns(rows)
        } else {
            self.rows.rows(rows)
        };
        Self { rows, ..self }
    }

    /// The columns in `columns`.
    ///
    /// # Panics
    /// If not all of them exist.
    #[must_use]
    #[track_caller]
    pub fn columns(self, columns: Range<usize>) -> Self {
        self.transpose().rows(columns).transpose()
    }

    /// Element `(row, column)`.
    ///
    /// # Panics
    /// If there is no such element.
    #[must_use]
    #[track_caller]
    #[inline]
    pub fn get(&self, row: usize, column: usize) -> T {
        assert!(
            row < self.num_rows() && column < self.num_columns(),
            "element ({row}, {column}) of ({}, {})",
            self.num_rows(),
            self.num_columns()
        );
        if self.is_transposed {
            self.rows.row(column)[row]
        } else {
            self.rows.row(row)[column]
        }
    }

    /// Row number `row` where its elements are contiguous.
    ///
    /// # Panics
    /// If there is no such row.
    #[must_use]
    #[track_caller]
    pub fn contiguous_row(&self, row: usize) -> Option<&'a [T]> {
        assert!(row < self.num_rows(), "row {row} of {}", self.num_rows());
        match (self.is_transposed, self.num_columns()) {
            (false, _) => Some(self.rows.row(row)),
            (true, 0) => Some(&[]),
            (true, 1) => Some(&self.rows.row(0)[row..=row]),
            (true, _) => None,
        }
    }
}
