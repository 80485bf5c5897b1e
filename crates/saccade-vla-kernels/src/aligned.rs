//! Memory that begins on a cache line, so that no vector spans two of them; and the error of memory that the system refuses.

use std::alloc::{Layout, alloc, alloc_zeroed, dealloc};
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;

/// A cache line, and the widest vector.
const ALIGNMENT: usize = 64;

/// A huge page of x86-64, and of ARM with pages of 4 kB. Where pages have 64 kB, a huge one has 512 MB: memory is then aligned so in vain, but
/// nobody waits for lookups either, of which 64 kB need few.
const HUGE_PAGE: usize = 2 << 20;

/// The system has refused memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("out of memory: {bytes} bytes were asked for")]
pub struct AllocError {
    /// What was asked for; `usize::MAX` where it does not fit into the address space.
    pub bytes: usize,
}

/// `count * size`, where that fits into the address space.
pub(crate) fn elements(count: usize, size: usize) -> Result<usize, AllocError> {
    count.checked_mul(size).ok_or(AllocError { bytes: usize::MAX })
}

/// Types for which all bytes zero is a value.
///
/// # Safety
/// That is so.
pub(crate) unsafe trait Zeroable: Copy + Send + Sync {}
// SAFETY: zero bytes are the number zero.
unsafe impl Zeroable for f32 {}
// SAFETY: as above.
unsafe impl Zeroable for u32 {}
// SAFETY: as above.
unsafe impl Zeroable for i32 {}

/// A fixed number of elements on a 64-byte boundary.
pub(crate) struct AlignedBuffer<T: Zeroable> {
    pointer: NonNull<T>,
    len: usize,
}

// SAFETY: the buffer owns its memory alone, and its elements are plain numbers.
unsafe impl<T: Zeroable> Send for AlignedBuffer<T> {}
// SAFETY: as above; shared references only read.
unsafe impl<T: Zeroable> Sync for AlignedBuffer<T> {}

impl<T: Zeroable> AlignedBuffer<T> {
    /// No elements, and no memory.
    pub(crate) fn empty() -> Self {
        Self {
            pointer: NonNull::dangling(),
            len: 0,
        }
    }

    /// `len` zeros.
    pub(crate) fn zeroed(len: usize) -> Result<Self, AllocError> {
        let layout = Self::layout(len)?;
        if layout.size() != 0 && layout.align() == ALIGNMENT {
            // SAFETY: the layout is not of size zero.
            let memory = unsafe { alloc_zeroed(layout) };
            return Self::owned(memory, len, layout);
        }
        // SAFETY: the memory is written at once.
        unsafe {
            let buffer = Self::unwritten(len)?;
            buffer.pointer.as_ptr().write_bytes(0, len);
            Ok(buffer)
        }
    }

    /// Memory that nothing has been written to: the threads that write it first also wait for its pages.
    ///
    /// # Safety
    /// Every element is written, through [`AlignedBuffer::pointer`], before the buffer is used as a slice.
    pub(crate) unsafe fn unwritten(len: usize) -> Result<Self, AllocError> {
        let layout = Self::layout(len)?;
        if layout.size() == 0 {
            return Ok(Self {
                pointer: NonNull::dangling(),
                len,
            });
        }
        // SAFETY: the layout is not of size zero.
        let memory = unsafe { alloc(layout) };
        let buffer = Self::owned(memory, len, layout)?;
        if layout.align() == HUGE_PAGE {
            // Before it is touched: pages are given at first touch.
            // SAFETY: the memory was just allocated.
            unsafe { advise_huge_pages(memory, layout.size()) };
        }
        Ok(buffer)
    }

    fn owned(memory: *mut u8, len: usize, layout: Layout) -> Result<Self, AllocError> {
        match NonNull::new(memory.cast()) {
            Some(pointer) => Ok(Self { pointer, len }),
            None => Err(AllocError { bytes: layout.size() }),
        }
    }

    /// Where the first element is.
    pub(crate) fn pointer(&mut self) -> *mut T {
        self.pointer.as_ptr()
    }

    /// A copy.
    pub(crate) fn try_clone(&self) -> Result<Self, AllocError> {
        let mut copy = Self::zeroed(self.len)?;
        copy.copy_from_slice(self);
        Ok(copy)
    }

    fn layout(len: usize) -> Result<Layout, AllocError> {
        let of = |alignment| {
            let layout = Layout::array::<T>(len).and_then(|layout| layout.align_to(alignment));
            layout.map_err(|_| AllocError { bytes: usize::MAX })
        };
        let layout = of(ALIGNMENT)?;
        if layout.size() < HUGE_PAGE {
            Ok(layout)
        } else {
            of(HUGE_PAGE)
        }
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

impl<T: Zeroable> Drop for AlignedBuffer<T> {
    fn drop(&mut self) {
        // A buffer whose layout cannot be was never made.
        if let Ok(layout) = Self::layout(self.len)
            && layout.size() != 0
        {
            // SAFETY: the memory was allocated with this layout.
            unsafe { dealloc(self.pointer.as_ptr().cast(), layout) };
        }
    }
}

impl<T: Zeroable> Deref for AlignedBuffer<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        // SAFETY: `len` elements were allocated, and zero bytes are values of them.
        unsafe { std::slice::from_raw_parts(self.pointer.as_ptr(), self.len) }
    }
}

impl<T: Zeroable> DerefMut for AlignedBuffer<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        // SAFETY: as above, and the reference is the only one.
        unsafe { std::slice::from_raw_parts_mut(self.pointer.as_ptr(), self.len) }
    }
}

/// Numbers that begin on a cache line, and of which there may be more or fewer from call to call: activations between layers.
///
/// Vectors of AVX-512 are whole cache lines. In a `Vec`, which begins anywhere, each of them lies across two: int8 `sample` of N1.5 took
/// 1.02 to 1.08 times as long, bfloat16 1.01 to 1.04 times (Intel with AMX, 2 threads).
///
/// ```
/// let mut hidden = saccade_vla_kernels::Activations::new();
/// hidden.reserve(5)?;
/// hidden.resize(3);
/// hidden.fill(1.0);
/// hidden.resize(5);
/// assert_eq!(hidden[..], [1.0, 1.0, 1.0, 0.0, 0.0]);
/// hidden.reserve(6)?;
/// assert!(hidden.is_empty());
/// # Ok::<(), saccade_vla_kernels::AllocError>(())
/// ```
pub struct Activations {
    /// Only the first `len` elements are sure to have been written.
    memory: AlignedBuffer<f32>,
    len: usize,
}

impl Activations {
    /// None, and no memory.
    #[must_use]
    pub fn new() -> Self {
        Self {
            memory: AlignedBuffer::empty(),
            len: 0,
        }
    }

    /// Makes room for `len` of them in all. Where that takes other memory, the memory so far is given back first, and none are left: peak
    /// memory is that of the larger number, not of both.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory; none are left then either.
    pub fn reserve(&mut self, len: usize) -> Result<(), AllocError> {
        if len > self.memory.len {
            *self = Self::new();
            // SAFETY: elements are written before they are counted in `len`, and no others are read.
            self.memory = unsafe { AlignedBuffer::unwritten(len)? };
        }
        Ok(())
    }

    /// Sets their number. The first ones keep their values, new ones are zero.
    ///
    /// # Panics
    /// If there is no room for them.
    pub fn resize(&mut self, len: usize) {
        assert!(
            len <= self.memory.len,
            "{len} activations, room for {}",
            self.memory.len
        );
        if len > self.len {
            // SAFETY: there is room.
            unsafe { self.memory.pointer().add(self.len).write_bytes(0, len - self.len) };
        }
        self.len = len;
    }
}

impl Default for Activations {
    fn default() -> Self {
        Self::new()
    }
}

impl Deref for Activations {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        // SAFETY: so many elements were written.
        unsafe { std::slice::from_raw_parts(self.memory.pointer.as_ptr(), self.len) }
    }
}

impl DerefMut for Activations {
    fn deref_mut(&mut self) -> &mut [f32] {
        // SAFETY: as above, and the reference is the only one.
        unsafe { std::slice::from_raw_parts_mut(self.memory.pointer.as_ptr(), self.len) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_that_cannot_be_had_is_an_error() {
        let huge = AlignedBuffer::<f32>::zeroed(usize::MAX / 2);
        assert_eq!(huge.err(), Some(AllocError { bytes: usize::MAX }));
        let large = isize::MAX as usize / 4 - HUGE_PAGE;
        let error = AlignedBuffer::<f32>::zeroed(large).err().unwrap();
        assert_eq!(error.bytes, 4 * large);
        assert_eq!(
            error.to_string(),
            format!("out of memory: {} bytes were asked for", 4 * large)
        );
    }

    #[test]
    fn buffers_of_every_size_are_zero_at_first() {
        for len in [0, 1, 17, 1 << 10, HUGE_PAGE / 4, HUGE_PAGE] {
            let buffer = AlignedBuffer::<u32>::zeroed(len).unwrap();
            assert!(buffer.iter().all(|&element| element == 0) && buffer.len() == len);
            assert_eq!(buffer.as_ptr().addr() % if len > 0 { ALIGNMENT } else { 1 }, 0);
        }
    }

    #[test]
    fn activations_are_kept_within_their_memory() {
        let mut activations = Activations::new();
        assert!(activations.is_empty());
        activations.reserve(3).unwrap();
        activations.resize(3);
        activations.copy_from_slice(&[1.0, 2.0, 3.0]);
        for (len, expected) in [(2, &[1.0, 2.0][..]), (3, &[1.0, 2.0, 0.0]), (0, &[])] {
            activations.reserve(len).unwrap();
            activations.resize(len);
            assert_eq!(activations[..], *expected);
        }
    }

    #[test]
    fn activations_that_need_other_memory_begin_anew() {
        let mut activations = Activations::new();
        for len in [3, HUGE_PAGE] {
            activations.reserve(len).unwrap();
            assert!(activations.is_empty());
            activations.resize(len);
            assert!(activations.iter().all(|&element| element == 0.0));
            activations.fill(1.0);
        }
        let error = activations.reserve(usize::MAX / 2).unwrap_err();
        assert_eq!(error, AllocError { bytes: usize::MAX });
        assert!(activations.is_empty());
        activations.reserve(HUGE_PAGE).unwrap();
        activations.resize(HUGE_PAGE);
        assert!(activations.iter().all(|&element| element == 0.0));
        assert_eq!(activations.as_ptr().addr() % ALIGNMENT, 0);
    }

    #[test]
    #[should_panic(expected = "3 activations, room for 2")]
    fn activations_need_room() {
        let mut activations = Activations::new();
        activations.reserve(2).unwrap();
        activations.resize(3);
    }
}
