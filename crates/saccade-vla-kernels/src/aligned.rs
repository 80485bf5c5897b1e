//! Memory that begins on a cache line, so that no vector spans two of them; and the error of memory that the system refuses.

use std::ops::{Deref, DerefMut};

pub(crate) use bytemuck::Zeroable;
use bytemuck::allocation::try_zeroed_vec;

/// A cache line, and the widest vector.
const ALIGNMENT: usize = 64;

/// A huge page of x86-64, and of ARM with pages of 4 kB. Pages of 64 kB have huge ones of 512 MB, which memory is not
/// aligned to; with them few addresses are looked up anyway.
const HUGE_PAGE: usize = 2 << 20;

/// The system has refused memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("out of memory: {bytes} bytes were asked for")]
pub struct AllocError {
    /// The size that was asked for; `usize::MAX` where it does not fit into the address space.
    pub bytes: usize,
}

/// `count * size`, where that fits into the address space.
pub(crate) fn elements(count: usize, size: usize) -> Result<usize, AllocError> {
    count.checked_mul(size).ok_or(AllocError { bytes: usize::MAX })
}

/// A fixed number of elements on a 64-byte boundary, and on a boundary of huge pages if they fill one.
pub(crate) struct AlignedBuffer<T> {
    /// More than are used: the allocator aligns them to their own size only, and leaves pages of zeros to be given at
    /// first touch. If it aligned them to more it would write the zeros, on the thread that allocates.
    memory: Vec<T>,
    first: usize,
    len: usize,
}

impl<T: Zeroable + Copy> AlignedBuffer<T> {
    /// An empty buffer; allocates nothing.
    pub(crate) const fn empty() -> Self {
        Self {
            memory: Vec::new(),
            first: 0,
            len: 0,
        }
    }

    /// `len` zeros.
    pub(crate) fn zeroed(len: usize) -> Result<Self, AllocError> {
        let bytes = elements(len, size_of::<T>())?;
        if bytes == 0 {
            return Ok(Self { len, ..Self::empty() });
        }
        let alignment = if bytes < HUGE_PAGE { ALIGNMENT } else { HUGE_PAGE };
        let slack = alignment / align_of::<T>();
        let refused = |()| AllocError { bytes };
        let memory = try_zeroed_vec::<T>(len.saturating_add(slack)).map_err(refused)?;
        // Some interpreters know no addresses; then nothing is aligned.
        let first = memory.as_ptr().align_offset(alignment).min(slack);
        let mut buffer = Self { memory, first, len };
        if alignment == HUGE_PAGE {
            advise_huge_pages(&mut buffer);
        }
        Ok(buffer)
    }

    /// A copy.
    pub(crate) fn try_clone(&self) -> Result<Self, AllocError> {
        let mut copy = Self::zeroed(self.len)?;
        copy.copy_from_slice(self);
        Ok(copy)
    }
}

/// Asks for huge pages: weights are streamed, and with small pages the CPU looks up an address every 4 kB of them.
/// Pages are given at first touch, so this comes before it.
fn advise_huge_pages<T>(memory: &mut [T]) {
    #[cfg(all(target_os = "linux", not(saccade_portable)))]
    // SAFETY: the memory is borrowed for the call. Advice changes neither its contents nor whether it may be used, and
    // may be refused: then pages stay small.
    unsafe {
        libc::madvise(
            memory.as_mut_ptr().cast(),
            size_of_val(memory),
            libc::MADV_HUGEPAGE,
        );
    }
    #[cfg(not(all(target_os = "linux", not(saccade_portable))))]
    let _ = memory;
}

impl<T> Deref for AlignedBuffer<T> {
    type Target = [T];

    #[inline]
    fn deref(&self) -> &[T] {
        &self.memory[self.first..][..self.len]
    }
}

impl<T> DerefMut for AlignedBuffer<T> {
    #[inline]
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.memory[self.first..][..self.len]
    }
}

/// A vector of numbers that begins on a cache line: activations between layers.
///
/// Vectors of AVX-512 are whole cache lines. In a `Vec`, which begins anywhere, each of them lies across two: int8
/// `sample` of N1.5 took 1.02 to 1.08 times as long, bfloat16 1.01 to 1.04 times (a Xeon with AMX, 2 threads).
///
/// ```
/// let mut hidden = saccade_vla_kernels::AlignedVec::new();
/// hidden.reserve(5)?;
/// hidden.resize(3);
/// hidden.fill(1.0);
/// hidden.resize(5);
/// assert_eq!(hidden[..], [1.0, 1.0, 1.0, 0.0, 0.0]);
/// hidden.reserve(6)?;
/// assert!(hidden.is_empty());
/// # Ok::<(), saccade_vla_kernels::AllocError>(())
/// ```
pub struct AlignedVec {
    /// As many as there is capacity for; `len` of them are elements.
    memory: AlignedBuffer<f32>,
    len: usize,
}

impl AlignedVec {
    /// An empty vector; allocates nothing.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            memory: AlignedBuffer::empty(),
            len: 0,
        }
    }

    /// Ensures capacity for `len` elements in all. If that takes another allocation, the old one is freed first and its
    /// elements are lost, so that peak memory is the larger of the two.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory; no elements are left then either.
    pub fn reserve(&mut self, len: usize) -> Result<(), AllocError> {
        if len > self.memory.len {
            *self = Self::new();
            self.memory = AlignedBuffer::zeroed(len)?;
        }
        Ok(())
    }

    /// Sets the number of elements. The first ones keep their values, new ones are zero.
    ///
    /// # Panics
    /// If `len` is more than there is capacity for.
    pub fn resize(&mut self, len: usize) {
        let capacity = self.memory.len;
        assert!(len <= capacity, "{len} elements, capacity for {capacity}");
        if len > self.len {
            self.memory[self.len..len].fill(0.0);
        }
        self.len = len;
    }
}

impl Default for AlignedVec {
    fn default() -> Self {
        Self::new()
    }
}

impl Deref for AlignedVec {
    type Target = [f32];

    #[inline]
    fn deref(&self) -> &[f32] {
        &self.memory[..self.len]
    }
}

impl DerefMut for AlignedVec {
    #[inline]
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.memory[..self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg_attr(miri, ignore = "Miri stops where there is not enough memory")]
    fn memory_that_cannot_be_had_is_an_error() {
        let huge = AlignedBuffer::<f32>::zeroed(usize::MAX / 2);
        assert_eq!(huge.err(), Some(AllocError { bytes: usize::MAX }));
        let large = isize::MAX as usize / 4 - HUGE_PAGE;
        // 32 bits have room for one of them, and none for three.
        let buffers = [(); 3].map(|()| AlignedBuffer::<f32>::zeroed(large));
        let error = buffers.into_iter().find_map(Result::err).unwrap();
        assert_eq!(error.bytes, 4 * large);
        assert_eq!(
            error.to_string(),
            format!("out of memory: {} bytes were asked for", 4 * large)
        );
    }

    #[test]
    fn buffers_of_every_size_are_zero_at_first() {
        let lens = [0, 1, 17, 1 << 10, HUGE_PAGE / 4, HUGE_PAGE];
        // Reading a huge page takes Miri minutes.
        for &len in &lens[..if cfg!(miri) { 4 } else { 6 }] {
            let buffer = AlignedBuffer::<u32>::zeroed(len).unwrap();
            assert!(buffer.iter().all(|&element| element == 0) && buffer.len() == len);
            assert_eq!(buffer.as_ptr().addr() % if len > 0 { ALIGNMENT } else { 1 }, 0);
        }
    }
}
