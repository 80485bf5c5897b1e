//! Vectors and slices as bits: reading, writing and reinterpreting them.

use std::mem::MaybeUninit;

/// Types without padding of which every bit pattern is a value.
///
/// # Safety
/// Implement it for such types only.
pub(crate) unsafe trait Bits: Copy {}

/// Implements [`Bits`] for numbers and for vectors of them.
macro_rules! are_bits {
    ($($type:ty),+) => {$(
        // SAFETY: numbers and vectors of them have no padding, and every bit pattern is one.
        unsafe impl Bits for $type {}
    )+};
}
are_bits!(u8, u16, u32, i32, i64, f32);
#[cfg(all(any(target_arch = "x86_64", target_arch = "aarch64"), not(saccade_portable)))]
pub(super) use are_bits;

// SAFETY: arrays have no padding between their elements.
unsafe impl<T: Bits, const N: usize> Bits for [T; N] {}

/// The bits of `from` as another type of the same size.
#[inline(always)]
pub(crate) fn cast<From: Bits, To: Bits>(from: From) -> To {
    const { assert!(size_of::<From>() == size_of::<To>()) }
    // SAFETY: the sizes are equal, and any bits are a `To`.
    unsafe { std::mem::transmute_copy(&from) }
}

/// How many `T` a vector has.
const fn elements_of<V, T>() -> usize {
    assert!(size_of::<V>().is_multiple_of(size_of::<T>()));
    size_of::<V>() / size_of::<T>()
}

/// A vector of the first elements of `from`.
///
/// # Panics
/// If there are fewer than fit into the vector.
#[inline(always)]
#[track_caller]
pub(crate) fn read<T: Bits, V: Bits>(from: &[T]) -> V {
    let from = &from[..const { elements_of::<V, T>() }];
    // SAFETY: the slice has the size of the vector, and any bits are one. It may begin anywhere.
    unsafe { from.as_ptr().cast::<V>().read_unaligned() }
}

/// Writes a vector to the first elements of memory that need not be initialised.
///
/// # Panics
/// If there are fewer than the vector has.
#[inline(always)]
#[track_caller]
pub(crate) fn write_uninit<T: Bits, V: Bits>(vector: V, to: &mut [MaybeUninit<T>]) {
    let to = &mut to[..const { elements_of::<V, T>() }];
    // SAFETY: the slice has the size of the vector, and any bits are elements of it. It may begin anywhere.
    unsafe { to.as_mut_ptr().cast::<V>().write_unaligned(vector) }
}

/// Writes a vector to the first elements of `to`.
///
/// # Panics
/// If there are fewer than the vector has.
#[inline(always)]
#[track_caller]
pub(crate) fn write<T: Bits, V: Bits>(vector: V, to: &mut [T]) {
    let to = &mut to[..const { elements_of::<V, T>() }];
    // SAFETY: the slice has the size of the vector, and any bits are elements of it. It may begin anywhere.
    unsafe { to.as_mut_ptr().cast::<V>().write_unaligned(vector) }
}

/// The same memory as elements of another type, of which a whole number fits into each.
#[inline(always)]
pub(crate) fn cast_slice_mut<From: Bits, To: Bits>(from: &mut [From]) -> &mut [To] {
    const { assert!(size_of::<From>().is_multiple_of(size_of::<To>()) && align_of::<To>() <= align_of::<From>()) }
    let len = from.len() * (size_of::<From>() / size_of::<To>());
    // SAFETY: the memory has this size and alignment, and any bits are a `To` and a `From`.
    unsafe { std::slice::from_raw_parts_mut(from.as_mut_ptr().cast(), len) }
}
