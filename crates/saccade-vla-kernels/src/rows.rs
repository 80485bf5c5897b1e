//! Views of matrices whose rows are contiguous.

use std::ops::Range;

/// A matrix `(num_rows, num_columns)` whose rows are contiguous, with any number of elements from one row to the next.
///
/// ```
/// use saccade_vla_kernels::Rows;
/// let data = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
/// let x = Rows::new(&data, 3);
/// assert_eq!((x.num_rows(), x.row(1)), (2, &[4.0, 5.0, 6.0][..]));
/// assert_eq!(x.columns(1..3).row(0), [2.0, 3.0]);
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a, T = f32> {
    /// From the first element on; ends at the last one or later.
    data: &'a [T],
    shape: RowShape,
}

/// [`Rows`] that can be written to.
///
/// ```
/// use saccade_vla_kernels::RowsMut;
/// let mut data = [0.0; 6];
/// let mut out = RowsMut::new(&mut data, 3);
/// out.row_mut(1).fill(2.0);
/// assert_eq!(data, [0.0, 0.0, 0.0, 2.0, 2.0, 2.0]);
/// ```
#[derive(Debug)]
pub struct RowsMut<'a, T = f32> {
    /// As in [`Rows`].
    data: &'a mut [T],
    shape: RowShape,
}

/// How many rows and columns, and elements from one row to the next.
#[derive(Clone, Copy, Debug)]
struct RowShape {
    num_rows: usize,
    num_columns: usize,
    row_stride: usize,
}

impl RowShape {
    /// Of `len` elements as rows of `num_columns`.
    #[track_caller]
    fn contiguous(len: usize, num_columns: usize) -> Self {
        let num_rows = len.checked_div(num_columns).unwrap_or(0);
        assert_eq!(
            num_rows * num_columns,
            len,
            "data: expected whole rows of {num_columns} elements"
        );
        Self {
            num_rows,
            num_columns,
            row_stride: num_columns,
        }
    }

    /// Of `len` elements, which must hold all rows.
    #[track_caller]
    fn strided(len: usize, num_rows: usize, num_columns: usize, row_stride: usize) -> Self {
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
        Self {
            num_rows,
            num_columns,
            // Rows without elements are all at the beginning, wherever that is: no pointer to one is outside the data.
            row_stride: if num_columns == 0 { 0 } else { row_stride },
        }
    }

    /// The elements of row `row`.
    #[track_caller]
    fn row(&self, row: usize) -> Range<usize> {
        assert!(row < self.num_rows, "row {row} of {}", self.num_rows);
        // The data may end before a row without elements.
        let first = if self.num_columns == 0 {
            0
        } else {
            row * self.row_stride
        };
        first..first + self.num_columns
    }

    /// The shape of some of the rows, and where they begin.
    #[track_caller]
    fn rows(&self, rows: &Range<usize>) -> (Self, usize) {
        assert!(
            rows.start <= rows.end && rows.end <= self.num_rows,
            "rows {rows:?} of {}",
            self.num_rows
        );
        let part = Self {
            num_rows: rows.len(),
            ..*self
        };
        (
            part,
            if part.is_empty() {
                0
            } else {
                rows.start * self.row_stride
            },
        )
    }

    /// The shape of some of the columns, and where they begin.
    #[track_caller]
    fn columns(&self, columns: &Range<usize>) -> (Self, usize) {
        assert!(
            columns.start <= columns.end && columns.end <= self.num_columns,
            "columns {columns:?} of {}",
            self.num_columns
        );
        let part = Self {
            num_columns: columns.len(),
            ..*self
        };
        (part, if part.is_empty() { 0 } else { columns.start })
    }

    fn is_empty(&self) -> bool {
        self.num_rows == 0 || self.num_columns == 0
    }
}

impl<'a, T> Rows<'a, T> {
    /// All of `data` as rows of `num_columns` elements, one after the other.
    ///
    /// # Panics
    /// If `data` does not hold whole rows.
    #[must_use]
    #[track_caller]
    pub fn new(data: &'a [T], num_columns: usize) -> Self {
        let shape = RowShape::contiguous(data.len(), num_columns);
        Self { data, shape }
    }

    /// `num_rows` rows of `num_columns` elements, the first at the beginning of `data`, each `row_stride` elements after the one before.
    ///
    /// # Panics
    /// If `data` is too short.
    #[must_use]
    #[track_caller]
    pub fn strided(data: &'a [T], num_rows: usize, num_columns: usize, row_stride: usize) -> Self {
        let shape = RowShape::strided(data.len(), num_rows, num_columns, row_stride);
        Self { data, shape }
    }

    /// Number of rows.
    #[must_use]
    pub fn num_rows(&self) -> usize {
        self.shape.num_rows
    }

    /// Elements of a row.
    #[must_use]
    pub fn num_columns(&self) -> usize {
        self.shape.num_columns
    }

    /// Elements from one row to the next.
    #[must_use]
    pub fn row_stride(&self) -> usize {
        self.shape.row_stride
    }

    /// Row number `row`.
    ///
    /// # Panics
    /// If there is no such row.
    #[must_use]
    #[track_caller]
    pub fn row(&self, row: usize) -> &'a [T] {
        &self.data[self.shape.row(row)]
    }

    /// The rows in `rows`.
    ///
    /// # Panics
    /// If not all of them are there.
    #[must_use]
    #[track_caller]
    pub fn rows(&self, rows: Range<usize>) -> Self {
        let (shape, first) = self.shape.rows(&rows);
        let data = &self.data[first..];
        Self { data, shape }
    }

    /// The columns in `columns` of all rows.
    ///
    /// # Panics
    /// If not all of them are there.
    #[must_use]
    #[track_caller]
    pub fn columns(&self, columns: Range<usize>) -> Self {
        let (shape, first) = self.shape.columns(&columns);
        let data = &self.data[first..];
        Self { data, shape }
    }

    /// The first element of the first row.
    pub(crate) fn as_ptr(&self) -> *const T {
        self.data.as_ptr()
    }

    /// All rows and what is between them.
    pub(crate) fn data(&self) -> &'a [T] {
        self.data
    }
}

impl<'a, T> RowsMut<'a, T> {
    /// As [`Rows::new`].
    ///
    /// # Panics
    /// If `data` does not hold whole rows.
    #[must_use]
    #[track_caller]
    pub fn new(data: &'a mut [T], num_columns: usize) -> Self {
        let shape = RowShape::contiguous(data.len(), num_columns);
        Self { data, shape }
    }

    /// As [`Rows::strided`].
    ///
    /// # Panics
    /// If `data` is too short, or rows overlap.
    #[must_use]
    #[track_caller]
    pub fn strided(data: &'a mut [T], num_rows: usize, num_columns: usize, row_stride: usize) -> Self {
        let shape = RowShape::strided(data.len(), num_rows, num_columns, row_stride);
        assert!(
            num_rows <= 1 || num_columns <= row_stride,
            "row_stride: expected at least the {num_columns} elements of a row, got {row_stride}"
        );
        Self { data, shape }
    }

    /// Number of rows.
    #[must_use]
    pub fn num_rows(&self) -> usize {
        self.shape.num_rows
    }

    /// Elements of a row.
    #[must_use]
    pub fn num_columns(&self) -> usize {
        self.shape.num_columns
    }

    /// Elements from one row to the next.
    #[must_use]
    pub fn row_stride(&self) -> usize {
        self.shape.row_stride
    }

    /// Row number `row`.
    ///
    /// # Panics
    /// If there is no such row.
    #[must_use]
    #[track_caller]
    pub fn row_mut(&mut self, row: usize) -> &mut [T] {
        &mut self.data[self.shape.row(row)]
    }

    /// The same rows, to be read.
    #[must_use]
    pub fn as_rows(&self) -> Rows<'_, T> {
        Rows {
            data: self.data,
            shape: self.shape,
        }
    }

    /// The same rows for a shorter time.
    #[must_use]
    pub fn reborrow(&mut self) -> RowsMut<'_, T> {
        RowsMut {
            data: self.data,
            shape: self.shape,
        }
    }

    /// The rows in `rows`.
    ///
    /// # Panics
    /// If not all of them are there.
    #[must_use]
    #[track_caller]
    pub fn rows(self, rows: Range<usize>) -> Self {
        let (shape, first) = self.shape.rows(&rows);
        let data = &mut self.data[first..];
        Self { data, shape }
    }

    /// The columns in `columns` of all rows.
    ///
    /// # Panics
    /// If not all of them are there.
    #[must_use]
    #[track_caller]
    pub fn columns(self, columns: Range<usize>) -> Self {
        let (shape, first) = self.shape.columns(&columns);
        let data = &mut self.data[first..];
        Self { data, shape }
    }

    /// The first element of the first row.
    pub(crate) fn as_mut_ptr(&mut self) -> *mut T {
        self.data.as_mut_ptr()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(len: usize) -> Vec<u32> {
        (0..).take(len).collect()
    }

    #[test]
    fn parts_of_rows_are_where_they_should_be() {
        let mut data = counted(23);
        let x = Rows::strided(&data, 4, 5, 6);
        assert_eq!((x.num_rows(), x.num_columns(), x.row_stride()), (4, 5, 6));
        assert_eq!(x.rows(1..3).columns(2..4).row(1), [14, 15]);
        assert_eq!(x.columns(4..5).rows(3..4).row(0), [22]);
        assert_eq!(x.rows(4..4).num_rows(), 0);
        assert_eq!(x.columns(5..5).row(3), [0_u32; 0]);
        let mut out = RowsMut::strided(&mut data, 4, 5, 6);
        out.reborrow().rows(1..2).columns(1..3).row_mut(0).fill(100);
        assert_eq!(out.as_rows().row(1), [6, 100, 100, 9, 10]);
    }

    #[test]
    fn views_without_elements() {
        let none: [f32; 0] = [];
        assert_eq!(Rows::new(&none, 7).num_rows(), 0);
        assert_eq!(Rows::new(&none, 0).num_rows(), 0);
        for row_stride in [0, 5] {
            let x = Rows::strided(&none, 3, 0, row_stride);
            assert_eq!((x.num_rows(), x.row(2)), (3, &none[..]));
            assert_eq!(x.row_stride(), 0, "no pointer to a row leaves the data");
        }
    }

    #[test]
    #[should_panic(expected = "data: expected whole rows of 4 elements")]
    fn a_part_of_a_row_is_refused() {
        let _ = Rows::new(&[0.0; 7], 4);
    }

    #[test]
    #[should_panic(expected = "data: expected room for 3 rows of 2 elements, 4 apart, got 9 elements")]
    fn data_that_is_too_short_is_refused() {
        let _ = Rows::strided(&[0.0; 9], 3, 2, 4);
    }

    #[test]
    #[should_panic(expected = "data: expected room")]
    fn a_size_that_overflows_is_refused() {
        let _ = Rows::strided(&[0.0; 9], usize::MAX, 2, usize::MAX / 2);
    }

    #[test]
    #[should_panic(expected = "row_stride: expected at least the 3 elements of a row, got 2")]
    fn rows_to_write_that_overlap_are_refused() {
        let _ = RowsMut::strided(&mut [0.0; 9], 3, 3, 2);
    }

    #[test]
    #[should_panic(expected = "rows 1..4 of 3")]
    fn rows_that_are_not_there_are_refused() {
        let _ = Rows::new(&[0.0; 6], 2).rows(1..4);
    }
}
