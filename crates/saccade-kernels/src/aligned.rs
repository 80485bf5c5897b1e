//! Memory that begins on a cache line, so that whole vectors never straddle two.

use std::alloc::{Layout, alloc, alloc_zeroed, dealloc, handle_alloc_error};
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;

/// A cache line, and the widest vector.
const ALIGNMENT: usize = 64;

/// A huge page of x86-64 and most others.
const HUGE_PAGE: usize = 2 << 20;

mod sealed {
    /// Types for which all bytes zero is a value.
    pub trait Zeroable: Copy + Send + Sync {}
    impl Zeroable for f32 {}
    impl Zeroable for u32 {}
    impl Zeroable for i32 {}
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
        if layout.size() != 0 && layout.align() == ALIGNMENT {
            // SAFETY: the layout is not of size zero.
            let memory = unsafe { alloc_zeroed(layout) };
            let pointer = NonNull::new(memory.cast()).unwrap_or_else(|| handle_alloc_error(layout));
            return Self { pointer, len };
        }
        // SAFETY: the memory is written at once.
        unsafe {
            let buffer = Self::unwritten(len);
            buffer.pointer.as_ptr().write_bytes(0, len);
            buffer
        }
    }

    /// Memory that nothing was written to yet, so that whoever writes it first, maybe on several threads, also waits for its pages.
    ///
    /// # Safety
    /// Every element is written, through [`AlignedBuffer::pointer`], before the buffer is used as a slice.
    pub(crate) unsafe fn unwritten(len: usize) -> Self {
        let layout = Self::layout(len);
        if layout.size() == 0 {
            return Self {
                pointer: NonNull::dangling(),
                len,
            };
        }
        // SAFETY: the layout is not of size zero.
        let memory = unsafe { alloc(layout) };
        let pointer = NonNull::new(memory.cast()).unwrap_or_else(|| handle_alloc_error(layout));
        if layout.align() == HUGE_PAGE {
            // Before it is touched: pages are given at first touch.
            // SAFETY: the memory was just allocated.
            unsafe { advise_huge_pages(memory, layout.size()) };
        }
        Self { pointer, len }
    }

    /// Where the first element is.
    pub(crate) fn pointer(&mut self) -> *mut T {
        self.pointer.as_ptr()
    }

    fn layout(len: usize) -> Layout {
        let alignment = if len * size_of::<T>() < HUGE_PAGE {
            ALIGNMENT
        } else {
            HUGE_PAGE
        };
        let layout = Layout::array::<T>(len).and_then(|layout| layout.align_to(alignment));
        layout.expect("weights fit in the address space")
    }
}

/// Asks for huge pages: weights are streamed, and with small pages the CPU looks up an address every 4 kB of them.
///
/// # Safety
/// `memory` is `size` bytes that nobody else uses.
unsafe fn advise_huge_pages(memory: *mut u8, size: usize) {
    #[cfg(target_os = "linux")]
    // SAFETY: advice changes neither contents nor validity of the memory. It may be refused: then pages stay small.
    unsafe {
        libc::madvise(memory.cast(), size, libc::MADV_HUGEPAGE);
    }
    #[cfg(not(target_os = "linux"))]
    let _ = (memory, size);
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
