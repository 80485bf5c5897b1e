//! Rows that the tasks of a parallel loop write to.

use std::ops::Range;

use super::RowsMut;

/// Rows that the tasks of a loop write to, each a block of its own.
pub(crate) struct SharedRows<'a, T = f32>(RowsMut<'a, T>);

// SAFETY: elements are reached through `block` alone, whose callers use no element twice at a time.
unsafe impl<T: Send> Sync for SharedRows<'_, T> {}

impl<'a, T> SharedRows<'a, T> {
    pub(crate) fn new(rows: RowsMut<'a, T>) -> Self {
        Self(rows)
    }

    /// The first element, which others may be writing.
    pub(crate) fn as_ptr(&self) -> *const T {
        self.0.first
    }

    /// Elements from one row to the next.
    pub(crate) fn row_stride(&self) -> usize {
        self.0.row_stride()
    }

    /// Some columns of some rows.
    ///
    /// # Safety
    /// No two blocks that exist at the same time have an element in common.
    ///
    /// # Panics
    /// If not all of them exist.
    #[track_caller]
    #[inline]
    pub(crate) unsafe fn block(&self, rows: Range<usize>, columns: Range<usize>) -> RowsMut<'_, T> {
        RowsMut::of(self.0.first, self.0.shape)
            .rows(rows)
            .columns(columns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_of_shared_rows_are_apart() {
        let mut data = (0..24_u32).collect::<Vec<_>>();
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
    fn rows_of_memory_without_elements_stay_where_they_begin() {
        // SAFETY: there are no elements.
        let mut rows = unsafe { RowsMut::<u32>::from_raw(std::ptr::dangling_mut(), 3, 0, 5) };
        assert_eq!((rows.row_stride(), rows.row_mut(2).len()), (0, 0));
    }
}
