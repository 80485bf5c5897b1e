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
    pub(crate) unsafe fn block(&self, rows: Range<usize>, columns: Range<usize>) -> RowsMut<'_, T> {
        RowsMut::of(self.0.first, self.0.shape)
            .rows(rows)
            .columns(columns)
    }
}
