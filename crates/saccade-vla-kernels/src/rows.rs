//! Views of matrices whose rows are contiguous.

mod shape;
mod shared;

use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::ops::Range;

use shape::RowShape;
pub(crate) use shared::SharedRows;

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
// SAFETY: a shared reference to the view only reads, as the view itself does.
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

/// The sizes and the parts of both views.
macro_rules! sizes_and_parts {
    () => {
        /// Number of rows.
        #[inline]
        #[must_use]
        pub fn num_rows(&self) -> usize {
            self.shape.num_rows
        }

        /// Elements of a row.
        #[inline]
        #[must_use]
        pub fn num_columns(&self) -> usize {
            self.shape.num_columns
        }

        /// Elements from one row to the next.
        #[inline]
        #[must_use]
        pub fn row_stride(&self) -> usize {
            self.shape.row_stride
        }

        /// The rows in `rows`.
        ///
        /// # Panics
        /// If not all of them exist.
        #[must_use]
        #[track_caller]
        #[inline]
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
        #[inline]
        pub fn columns(self, columns: Range<usize>) -> Self {
            let (shape, start) = self.shape.columns(&columns);
            Self::of(self.first.wrapping_add(start), shape)
        }
    };
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

    /// As [`Self::strided`], of memory that is initialised where the rows are.
    ///
    /// # Safety
    /// The elements of all rows are initialised.
    ///
    /// # Panics
    /// If `data` is too short.
    pub(crate) unsafe fn initialised(
        data: &'a [MaybeUninit<T>],
        num_rows: usize,
        num_columns: usize,
        row_stride: usize,
    ) -> Self {
        let rows = Rows::strided(data, num_rows, num_columns, row_stride);
        Self::of(rows.first.cast(), rows.shape)
    }

    fn of(first: *const T, shape: RowShape) -> Self {
        let borrowed = PhantomData;
        Self {
            first,
            shape,
            borrowed,
        }
    }

    sizes_and_parts!();

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
    #[inline]
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &'a [T]> + use<'a, T> {
        let rows = *self;
        (0..rows.num_rows()).map(move |row| rows.row(row))
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
        Self::of(first, RowShape::new(num_rows, num_columns, row_stride))
    }

    fn of(first: *mut T, shape: RowShape) -> Self {
        let borrowed = PhantomData;
        Self {
            first,
            shape,
            borrowed,
        }
    }

    sizes_and_parts!();

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
    #[inline]
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
