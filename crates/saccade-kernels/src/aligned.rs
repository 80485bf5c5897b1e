//! Memory that begins on a cache line, so that whole vectors never straddle two.

use std::alloc::{Layout, alloc_zeroed, dealloc, handle_alloc_error};
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;

/// A cache line, and the widest vector.
const ALIGNMENT: usize = 64;

mod sealed {
    /// Types for which all bytes zero is a value.
    pub trait Zeroable: Copy + Send + Sync {}
    impl Zeroable for f32 {}
    impl Zeroable for u32 {}
}

/// A fixed number of elements on a 64-byte boundary, zero at first.
pub(crate) struct AlignedBuffer<T: sealed::Zeroable> {
    pointer: NonNull<T>,
    len: usize,
}

// SAFETY: the buffer owns its memory alone, and its elements are plain numbers.
unsafe impl<T: sealed::Zeroable> Send for AlignedBuffer<T> {}
// SAFETY: as above; shared references only read.
unsafe impl<T: sealed::Zeroable> Sync for AlignedBuffer<T> {}

impl<T: sealed::Zeroable> AlignedBuffer<T> {
    pub(crate) fn zeroed(len: usize) -> Self {
        let layout = Self::layout(len);
        if layout.size() == 0 {
            return Self {
                pointer: NonNull::dangling(),
                len,
            };
        }
        // SAFETY: the layout is not of size zero.
        let memory = unsafe { alloc_zeroed(layout) };
        let pointer = NonNull::new(memory.cast()).unwrap_or_else(|| handle_alloc_error(layout));
        Self { pointer, len }
    }

    fn layout(len: usize) -> Layout {
        let layout = Layout::array::<T>(len).and_then(|layout| layout.align_to(ALIGNMENT));
        layout.expect("weights fit in the address space")
    }
}

impl<T: sealed::Zeroable> Drop for AlignedBuffer<T> {
    fn drop(&mut self) {
        let layout = Self::layout(self.len);
        if layout.size() != 0 {
            // SAFETY: the memory was allocated with this layout.
            unsafe { dealloc(self.pointer.as_ptr().cast(), layout) };
        }
    }
}

impl<T: sealed::Zeroable> Clone for AlignedBuffer<T> {
    fn clone(&self) -> Self {
        let mut copy = Self::zeroed(self.len);
        copy.copy_from_slice(self);
        copy
    }
}

impl<T: sealed::Zeroable> Deref for AlignedBuffer<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        // SAFETY: `len` elements were allocated, and zero bytes are values of them.
        unsafe { std::slice::from_raw_parts(self.pointer.as_ptr(), self.len) }
    }
}

impl<T: sealed::Zeroable> DerefMut for AlignedBuffer<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        // SAFETY: as above, and the reference is the only one.
        unsafe { std::slice::from_raw_parts_mut(self.pointer.as_ptr(), self.len) }
    }
}
