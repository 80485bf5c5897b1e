//! Views of matrices whose rows are contiguous.

use std::marker::PhantomData;
use std::ops::Range;

/// A matrix `(num_rows, num_columns)` whose rows are contiguous, with any number of elements from one row to
/// the next.
///
/// ```
/// use saccade_vla_kernels::Rows;
/// let data = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
/// let x = Rows::new(&data, 3);
/// assert_eq!((x.num_rows(), x.row(1)), (2, &[4.0, 5.0, 6.0][..]));
/// assert_eq!(x.columns(1..3).row(0), [2.0, 3.0]);
/// ```
#[derive(Debug)]
pub struct Rows<'a, T = f32> {
    /// Row 0; for as long as `'a`, the elements of all rows may be read.
    first: *const T,
    shape: RowShape,
    borrowed: PhantomData<&'a [T]>,
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
    /// Row 0; for as long as `'a`, nothing else reads or writes the elements of any row. What is between rows
    /// may be another view's. Rows do not overlap.
    first: *mut T,
    shape: RowShape,
    borrowed: PhantomData<&'a mut [T]>,
}

// SAFETY: the view is a shared reference to its elements.
unsafe impl<T: Sync> Send for Rows<'_, T> {}
// SAFETY: as for Send.
unsafe impl<T: Sync> Sync for Rows<'_, T> {}
// SAFETY: the view is an exclusive reference to its elements.
unsafe impl<T: Send> Send for RowsMut<'_, T> {}
// SAFETY: a shared reference to the view only reads.
unsafe impl<T: Sync> Sync for RowsMut<'_, T> {}

impl<T> Clone for Rows<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Rows<'_, T> {}

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
            // Rows without elements are all at the beginning, wherever that is: no pointer to one is outside
            // the data.
            row_stride: if num_columns == 0 { 0 } else { row_stride },
        }
    }

    /// The elements of row `row`.
    #[track_caller]
    #[inline]
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
        Self::of(data.as_ptr(), RowShape::contiguous(data.len(), num_columns))
    }

    /// `num_rows` rows of `num_columns` elements, the first at the beginning of `data`, each `row_stride`
    /// elements after the one before.
    ///
    /// # Panics
    /// If `data` is too short.
    #[must_use]
    #[track_caller]
    pub fn strided(data: &'a [T], num_rows: usize, num_columns: usize, row_stride: usize) -> Self {
        let shape = RowShape::strided(data.len(), num_rows, num_columns, row_stride);
        Self::of(data.as_ptr(), shape)
    }

    fn of(first: *const T, shape: RowShape) -> Self {
        let borrowed = PhantomData;
        Self {
            first,
            shape,
            borrowed,
        }
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
    #[inline]
    pub fn row(&self, row: usize) -> &'a [T] {
        let Range { start, end } = self.shape.row(row);
        // SAFETY: the row exists, so its elements may be read for as long as the view lives.
        unsafe { std::slice::from_raw_parts(self.first.add(start), end - start) }
    }

    /// The rows, first to last.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &'a [T]> + use<'a, T> {
        let rows = *self;
        (0..rows.num_rows()).map(move |row| rows.row(row))
    }

    /// The rows in `rows`.
    ///
    /// # Panics
    /// If not all of them exist.
    #[must_use]
    #[track_caller]
    pub fn rows(&self, rows: Range<usize>) -> Self {
        let (shape, start) = self.shape.rows(&rows);
        Self::of(self.first.wrapping_add(start), shape)
    }

    /// The columns in `columns` of all rows.
    ///
    /// # Panics
    /// If not all of them exist.
    #[must_use]
    #[track_caller]
    pub fn columns(&self, columns: Range<usize>) -> Self {
        let (shape, start) = self.shape.columns(&columns);
        Self::of(self.first.wrapping_add(start), shape)
    }

    /// Each `count` consecutive rows as one.
    ///
    /// # Panics
    /// If there is something between the rows, or if `count` does not divide their number.
    #[must_use]
    #[track_caller]
    pub fn joined(&self, count: usize) -> Self {
        let RowShape {
            num_rows,
            num_columns,
            row_stride,
        } = self.shape;
        assert!(
            row_stride == num_columns && num_rows.checked_rem(count) == Some(0),
            "{num_rows} rows of {num_columns} elements, {row_stride} apart: expected contiguous rows, {count} in each"
        );
        Self::of(
            self.first,
            RowShape::contiguous(num_rows * num_columns, num_columns * count),
        )
    }

    /// The first element of the first row.
    pub(crate) fn as_ptr(&self) -> *const T {
        self.first
    }
}

impl<'a> Rows<'a> {
    /// The same rows as words.
    pub(crate) fn bits(self) -> Rows<'a, u32> {
        Rows::of(self.first.cast(), self.shape)
    }
}

impl<'a, T> RowsMut<'a, T> {
    /// All of `data` as rows of `num_columns` elements, one after the other.
    ///
    /// # Panics
    /// If `data` does not hold whole rows.
    #[must_use]
    #[track_caller]
    pub fn new(data: &'a mut [T], num_columns: usize) -> Self {
        let shape = RowShape::contiguous(data.len(), num_columns);
        Self::of(data.as_mut_ptr(), shape)
    }

    /// `num_rows` rows of `num_columns` elements, the first at the beginning of `data`, each `row_stride`
    /// elements after the one before.
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
        Self::of(data.as_mut_ptr(), shape)
    }

    /// Rows of memory that is not a slice, because what is between them may be in use elsewhere, or not
    /// initialised.
    ///
    /// # Safety
    /// From `first` on there are `num_rows` rows of `num_columns` elements, `row_stride` apart and not
    /// overlapping. They are initialised, and nothing else reads or writes them for as long as `'a`.
    pub(crate) unsafe fn from_raw(
        first: *mut T,
        num_rows: usize,
        num_columns: usize,
        row_stride: usize,
    ) -> Self {
        Self::of(
            first,
            RowShape {
                num_rows,
                num_columns,
                row_stride,
            },
        )
    }

    fn of(first: *mut T, shape: RowShape) -> Self {
        let borrowed = PhantomData;
        Self {
            first,
            shape,
            borrowed,
        }
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
    #[inline]
    pub fn row_mut(&mut self, row: usize) -> &mut [T] {
        let Range { start, end } = self.shape.row(row);
        // SAFETY: the row exists, and the view is borrowed for as long as its elements are.
        unsafe { std::slice::from_raw_parts_mut(self.first.add(start), end - start) }
    }

    /// The rows, first to last.
    pub fn iter_mut(&mut self) -> impl ExactSizeIterator<Item = &mut [T]> {
        let (first, shape) = (self.first, self.shape);
        (0..shape.num_rows).map(move |row| {
            let Range { start, end } = shape.row(row);
            // SAFETY: the row exists and is visited once, rows do not overlap, and the view is borrowed for
            // as long as their elements are.
            unsafe { std::slice::from_raw_parts_mut(first.add(start), end - start) }
        })
    }

    /// The same rows, to be read.
    #[must_use]
    pub fn as_rows(&self) -> Rows<'_, T> {
        Rows::of(self.first, self.shape)
    }

    /// The same rows for a shorter time.
    #[must_use]
    pub fn reborrow(&mut self) -> RowsMut<'_, T> {
        RowsMut::of(self.first, self.shape)
    }

    /// The rows in `rows`.
    ///
    /// # Panics
    /// If not all of them exist.
    #[must_use]
    #[track_caller]
    pub fn rows(self, rows: Range<usize>) -> Self {
        let (shape, start) = self.shape.rows(&rows);
        Self::of(self.first.wrapping_add(start), shape)
    }

    /// The columns in `columns` of all rows.
    ///
    /// # Panics
    /// If not all of them exist.
    #[must_use]
    #[track_caller]
    pub fn columns(self, columns: Range<usize>) -> Self {
        let (shape, start) = self.shape.columns(&columns);
        Self::of(self.first.wrapping_add(start), shape)
    }

    /// The first element of the first row.
    pub(crate) fn as_mut_ptr(&mut self) -> *mut T {
        self.first
    }
}

impl<T: Copy> RowsMut<'_, T> {
    /// Copies `from`, of the same shape.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn copy_from(&mut self, from: Rows<'_, T>) {
        assert_eq!(
            (self.num_rows(), self.num_columns()),
            (from.num_rows(), from.num_columns()),
            "rows and columns of both"
        );
        for (to, from) in self.iter_mut().zip(from.iter()) {
            to.copy_from_slice(from);
        }
    }

    /// Sets all elements of all rows to `value`.
    pub fn fill(&mut self, value: T) {
        self.iter_mut().for_each(|row| row.fill(value));
    }
}

/// Rows that the tasks of a loop write to, each a block of its own.
pub(crate) struct SharedRows<'a, T = f32>(RowsMut<'a, T>);

// SAFETY: elements are reached through `block` alone, whose callers use no element twice at a time.
unsafe impl<T: Send> Sync for SharedRows<'_, T> {}

impl<'a, T> SharedRows<'a, T> {
    pub(crate) fn new(rows: RowsMut<'a, T>) -> Self {
        Self(rows)
    }

    /// Some columns of some rows.
    ///
    /// # Safety
    /// No two blocks that exist at the same time have an element in common.
    ///
    /// # Panics
    /// If not all of them exist.
    #[track_caller]
    pub(crate) unsafe fn block(&self, rows: Range<usize>, columns: Range<usize>) -> RowsMut<'_, T> {
        RowsMut::of(self.0.first, self.0.shape)
            .rows(rows)
            .columns(columns)
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
    fn rows_are_visited_copied_and_filled_without_what_is_between_them() {
        let (source, mut data) = (counted(8), vec![100; 11]);
        let x = Rows::strided(&source, 3, 2, 3);
        assert_eq!(x.iter().collect::<Vec<_>>(), [[0, 1], [3, 4], [6, 7]]);
        let mut out = RowsMut::strided(&mut data, 3, 2, 4);
        out.copy_from(x);
        out.reborrow().rows(1..2).fill(9);
        assert_eq!(data, [0, 1, 100, 100, 9, 9, 100, 100, 6, 7, 100]);
        let mut one = RowsMut::strided(&mut data, 1, 2, 0);
        assert_eq!(one.iter_mut().count(), 1);
        let mut empty = RowsMut::strided(&mut data, 3, 0, 0);
        assert!(empty.iter_mut().len() == 3 && empty.iter_mut().all(|row| row.is_empty()));
    }

    #[test]
    fn blocks_of_shared_rows_are_apart() {
        let mut data = counted(24);
        let shared = SharedRows::new(RowsMut::strided(&mut data, 4, 5, 6));
        // SAFETY: the two have no element in common.
        let (mut left, mut right) = unsafe { (shared.block(1..3, 0..2), shared.block(0..4, 2..5)) };
        left.fill(100);
        right.row_mut(3).fill(200);
        assert_eq!(left.as_rows().row(1), [100, 100]);
        assert_eq!(right.as_rows().row(1), [8, 9, 10]);
        assert_eq!(data[18..], [18, 19, 200, 200, 200, 23]);
        assert_eq!(data[6..14], [100, 100, 8, 9, 10, 11, 100, 100]);
    }

    #[test]
    fn contiguous_rows_are_joined() {
        let data = counted(13);
        let joined = Rows::strided(&data, 6, 2, 2).joined(3);
        assert_eq!((joined.num_rows(), joined.row(1)), (2, &[6, 7, 8, 9, 10, 11][..]));
    }

    #[test]
    #[should_panic(expected = "expected contiguous rows, 2 in each")]
    fn rows_that_are_apart_are_not_joined() {
        let _ = Rows::strided(&[0.0; 9], 2, 2, 3).joined(2);
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
