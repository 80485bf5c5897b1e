//! Views of matrices with any two strides.

use std::ops::Range;

use crate::rows::Rows;

/// A matrix `(num_rows, num_columns)` with any strides, as weights may be stored: row-major, or the transpose of that.
///
/// ```
/// use saccade_vla_kernels::{Matrix, Rows};
/// let in_major = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]; // (in_features 3, out_features 2)
/// let weight = Matrix::from(Rows::new(&in_major, 2)).transpose();
/// assert_eq!((weight.num_rows(), weight.num_columns(), weight.get(1, 2)), (2, 3, 6.0));
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a, T = f32> {
    data: &'a [T],
    num_rows: usize,
    num_columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a, T> From<Rows<'a, T>> for Matrix<'a, T> {
    fn from(rows: Rows<'a, T>) -> Self {
        Self {
            data: rows.data(),
            num_rows: rows.num_rows(),
            num_columns: rows.num_columns(),
            row_stride: rows.row_stride(),
            column_stride: 1,
        }
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
        self.num_rows
    }

    /// Number of columns: `in_features` of a weight.
    #[must_use]
    pub fn num_columns(&self) -> usize {
        self.num_columns
    }

    /// Rows as columns.
    #[must_use]
    pub fn transpose(self) -> Self {
        Self {
            data: self.data,
            num_rows: self.num_columns,
            num_columns: self.num_rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
        }
    }

    /// The rows in `rows`.
    ///
    /// # Panics
    /// If not all of them are there.
    #[must_use]
    #[track_caller]
    pub fn rows(self, rows: Range<usize>) -> Self {
        assert!(
            rows.start <= rows.end && rows.end <= self.num_rows,
            "rows {rows:?} of {}",
            self.num_rows
        );
        let empty = rows.is_empty() || self.num_columns == 0;
        let first = if empty { 0 } else { rows.start * self.row_stride };
        Self {
            data: &self.data[first..],
            num_rows: rows.len(),
            ..self
        }
    }

    /// The columns in `columns`.
    ///
    /// # Panics
    /// If not all of them are there.
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
            row < self.num_rows && column < self.num_columns,
            "element ({row}, {column}) of ({}, {})",
            self.num_rows,
            self.num_columns
        );
        self.data[row * self.row_stride + column * self.column_stride]
    }

    /// Row number `row` where its elements are contiguous.
    ///
    /// # Panics
    /// If there is no such row.
    #[must_use]
    #[track_caller]
    pub fn contiguous_row(&self, row: usize) -> Option<&'a [T]> {
        assert!(row < self.num_rows, "row {row} of {}", self.num_rows);
        if self.num_columns == 0 {
            return Some(&[]);
        }
        (self.column_stride == 1 || self.num_columns == 1)
            .then(|| &self.data[row * self.row_stride..][..self.num_columns])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transposed_matrix_has_the_same_elements() {
        let data: Vec<u32> = (0..12).collect();
        let matrix = Matrix::new(&data, 4);
        let turned = matrix.transpose();
        assert_eq!((turned.num_rows(), turned.num_columns()), (4, 3));
        for (row, column) in (0..3).flat_map(|row| (0..4).map(move |column| (row, column))) {
            assert_eq!(matrix.get(row, column), turned.get(column, row));
        }
        assert_eq!(turned.rows(1..3).columns(2..3).get(1, 0), matrix.get(2, 2));
        assert_eq!(matrix.contiguous_row(1), Some(&data[4..8]));
        assert_eq!(turned.contiguous_row(1), None);
    }

    #[test]
    fn a_matrix_without_columns_has_rows() {
        let none: [f32; 0] = [];
        let matrix = Matrix::from(Rows::strided(&none, 3, 0, 0));
        assert_eq!(matrix.transpose().num_columns(), 3);
        assert_eq!(matrix.rows(2..3).contiguous_row(0), Some(&none[..]));
    }
}
