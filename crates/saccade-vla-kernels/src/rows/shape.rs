//! The shape of views of rows.

use std::ops::Range;

/// How many rows and columns, and elements from one row to the next: 0 where rows have no elements.
#[derive(Clone, Copy, Debug)]
pub(super) struct RowShape {
    pub num_rows: usize,
    pub num_columns: usize,
    pub row_stride: usize,
}

impl RowShape {
    /// Rows without elements are all at the beginning, wherever that is: no pointer to one is outside the data.
    #[inline]
    pub(super) fn new(num_rows: usize, num_columns: usize, row_stride: usize) -> Self {
        Self {
            num_rows,
            num_columns,
            row_stride: if num_columns == 0 { 0 } else { row_stride },
        }
    }

    /// Of `len` elements as rows of `num_columns`.
    #[track_caller]
    pub(super) fn contiguous(len: usize, num_columns: usize) -> Self {
        let num_rows = len.checked_div(num_columns).unwrap_or(0);
        assert_eq!(
            num_rows * num_columns,
            len,
            "data: expected whole rows of {num_columns} elements"
        );
        Self::new(num_rows, num_columns, num_columns)
    }

    /// Of `len` elements, which must hold all rows.
    #[track_caller]
    pub(super) fn strided(len: usize, num_rows: usize, num_columns: usize, row_stride: usize) -> Self {
        let end = match num_rows.checked_sub(1) {
            Some(last) if num_columns > 0 => last
                .checked_mul(row_stride)
                .and_then(|last| last.checked_add(num_columns)),
            _ => Some(0),
        };
        assert!(
            end.is_some_and(|end| end <= len),
            "data: expected room for {num_rows} rows of {num_columns} elements, {row_stride} apart, got {len} elements"
        );
        Self::new(num_rows, num_columns, row_stride)
    }

    /// The elements of row `row`.
    #[track_caller]
    #[inline]
    pub(super) fn row(&self, row: usize) -> Range<usize> {
        assert!(row < self.num_rows, "row {row} of {}", self.num_rows);
        let first = row * self.row_stride;
        first..first + self.num_columns
    }

    /// The shape of some of the rows, and where they begin.
    #[track_caller]
    #[inline]
    pub(super) fn rows(&self, rows: &Range<usize>) -> (Self, usize) {
        assert!(
            rows.start <= rows.end && rows.end <= self.num_rows,
            "rows {rows:?} of {}",
            self.num_rows
        );
        self.part(
            rows.len(),
            self.num_columns,
            rows.start.wrapping_mul(self.row_stride),
        )
    }

    /// The shape of some of the columns, and where they begin.
    #[track_caller]
    #[inline]
    pub(super) fn columns(&self, columns: &Range<usize>) -> (Self, usize) {
        assert!(
            columns.start <= columns.end && columns.end <= self.num_columns,
            "columns {columns:?} of {}",
            self.num_columns
        );
        self.part(self.num_rows, columns.len(), columns.start)
    }

    /// A part that begins at `start`, or wherever these rows do if it has no elements.
    #[inline]
    fn part(&self, num_rows: usize, num_columns: usize, start: usize) -> (Self, usize) {
        let part = Self::new(num_rows, num_columns, self.row_stride);
        (part, if part.is_empty() { 0 } else { start })
    }

    #[inline]
    fn is_empty(&self) -> bool {
        self.num_rows == 0 || self.num_columns == 0
    }
}
