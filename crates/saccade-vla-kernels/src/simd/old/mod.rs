//! The vectors without a token, for kernels that are not rewritten yet. To be deleted with the last of them.
#![allow(dead_code, reason = "deleted soon")]

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
pub(crate) mod math;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
pub(crate) mod portable;

use super::MAX_LANES;

/// A vector of f32 lanes.
///
/// # Safety
/// Every method needs a CPU that has the instruction set of the implementation. Those that take pointers need them valid for the lanes that
/// they name: all of them, or the first `n` in the `_partial` forms (`n <= LANES`). Nothing needs to be aligned.
pub(crate) unsafe trait Vector: Copy {
    /// Elements of a vector.
    const LANES: usize;
    /// Rows of the largest tile of sums that products keep in registers, at most [`MAX_TILE_ROWS`]. A tile is `TILE_ROWS x TILE_VECTORS` sums;
    /// `TILE_VECTORS` factors and one broadcast factor stay in registers with them. The tile is large enough to hide the latency of the
    /// multiply-adds.
    const TILE_ROWS: usize;
    /// Vectors of a row of that tile: at most 3 where linear layers are made of these vectors, 4 where only attention is.
    const TILE_VECTORS: usize;
    /// As many lanes of i32.
    type Ints: Copy;
    /// Up to where [`Self::dot_bytes`] takes unsigned bytes.
    const MAX_BYTE: u8;
    /// Every lane `x`.
    unsafe fn splat(x: f32) -> Self;
    /// `LANES` elements.
    unsafe fn load(from: *const f32) -> Self;
    /// `LANES` elements.
    unsafe fn store(self, to: *mut f32);
    /// The first `n` lanes; zero in the rest.
    unsafe fn load_partial(from: *const f32, n: usize) -> Self;
    /// The first `n` lanes; the rest of the memory is not touched.
    unsafe fn store_partial(self, to: *mut f32, n: usize);
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn sub(self, other: Self) -> Self;
    unsafe fn mul(self, other: Self) -> Self;
    unsafe fn div(self, other: Self) -> Self;
    /// `self * factor + addend`: rounded once where there is FMA, twice where there is none.
    unsafe fn fma(self, factor: Self, addend: Self) -> Self;
    /// `self < other ? self : other`: `other` where either is NaN.
    unsafe fn min(self, other: Self) -> Self;
    /// `self > other ? self : other`: `other` where either is NaN.
    unsafe fn max(self, other: Self) -> Self;
    /// To the nearest whole number, ties to even, for `|self| < 2^22`.
    unsafe fn round(self) -> Self;
    /// `self * 2^exponent` for whole exponents in `-252..=254`; NaN in `self` stays.
    unsafe fn scale_by_power_of_two(self, exponent: Self) -> Self;
    /// The f32 whose sign and exponent are the low nine bits of each lane.
    unsafe fn low_bits_as_exponent(self) -> Self;
    /// `value` in those lanes where `probe == value`, `self` in the others.
    unsafe fn replace_where(self, probe: Self, value: Self) -> Self;
    /// Sum of the lanes, in an order that is fixed.
    unsafe fn reduce_add(self) -> f32;
    /// Largest lane; unspecified if a lane is NaN.
    unsafe fn reduce_max(self) -> f32;
    /// The low half of each lane as the upper half of an f32: bfloat16 widened.
    unsafe fn low_halves(pairs: Self::Ints) -> Self;
    /// The high halves, likewise.
    unsafe fn high_halves(pairs: Self::Ints) -> Self;
    /// Rounded to bfloat16, to nearest and ties to even; NaN stays.
    unsafe fn round_to_bf16(self) -> Self;
    /// `LANES` bfloat16, rounded so.
    unsafe fn store_bf16(self, to: *mut u16);
    /// `LANES` bytes: each lane rounded to the nearest whole number, ties to even, plus `zero`, and `most` where that is more. Any byte for
    /// lanes with which this is not in `0..=256`.
    unsafe fn store_bytes(self, zero: Self::Ints, most: Self::Ints, to: *mut u8);
    /// Every lane `x`.
    unsafe fn splat_int(x: i32) -> Self::Ints;
    /// `LANES` integers.
    unsafe fn load_ints(from: *const i32) -> Self::Ints;
    /// `LANES` integers.
    unsafe fn store_ints(integers: Self::Ints, to: *mut i32);
    unsafe fn add_ints(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    unsafe fn sub_ints(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    /// The low halves of the products.
    unsafe fn mul_ints(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    /// The nearest f32, ties to even.
    unsafe fn from_ints(integers: Self::Ints) -> Self;
    /// Adds the four products of each lane's unsigned bytes `x` and signed bytes `w`. Exact where `x` is at most
    /// [`Self::MAX_BYTE`] and no `w` is -128.
    unsafe fn dot_bytes(sum: Self::Ints, x: Self::Ints, w: Self::Ints) -> Self::Ints;
    /// Asks for the cache line at `at`, which may be any address. A hint: it may do nothing.
    unsafe fn prefetch(at: *const u8);
    /// The transpose of the first `LANES` rows and columns of `square`, to `LANES` rows of `LANES` words.
    #[inline(always)]
    unsafe fn transpose(square: &[[u32; MAX_LANES]; MAX_LANES], to: &mut [u32]) {
        assert_eq!(to.len(), Self::LANES * Self::LANES);
        for (column, to) in to.chunks_exact_mut(Self::LANES).enumerate() {
            for (to, row) in to.iter_mut().zip(square) {
                *to = row[column];
            }
        }
    }
    /// Whether multiply-adds take a factor from a lane of four: [`Self::fma_lane`] and [`Dots::bf16_lane`].
    const BY_LANE: bool = false;
    /// `self * factors[LANE] + addend`, rounded once.
    #[inline(always)]
    unsafe fn fma_lane<const LANE: i32>(self, _factors: Self, _addend: Self) -> Self {
        unreachable!("only where there is BY_LANE")
    }
}

/// The first `lanes` elements, by the plain load where that is all of them.
///
/// # Safety
/// As [`Vector::load_partial`].
#[inline(always)]
pub(crate) unsafe fn load<V: Vector>(from: *const f32, lanes: usize) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        if lanes == V::LANES {
            V::load(from)
        } else {
            V::load_partial(from, lanes)
        }
    }
}

/// The first `lanes` elements, by the plain store where that is all of them.
///
/// # Safety
/// As [`Vector::store_partial`].
#[inline(always)]
pub(crate) unsafe fn store<V: Vector>(vector: V, to: *mut f32, lanes: usize) {
    // SAFETY: the caller's promise.
    unsafe {
        if lanes == V::LANES {
            vector.store(to)
        } else {
            vector.store_partial(to, lanes)
        }
    }
}

/// Sums of products of narrow elements, several of which share a lane.
///
/// # Safety
/// Every method needs a CPU that has the instruction set of `V` and the dot products of the implementation.
pub(crate) unsafe trait Dots<V: Vector> {
    /// What users call the instructions; empty where there are none.
    const NAME: &'static str = "";
    /// Up to where [`Self::int8`] takes unsigned bytes.
    const MAX_BYTE: u8 = V::MAX_BYTE;
    /// Whether [`Self::bf16`] is one instruction.
    const HAS_BF16: bool = false;

    /// `sum + a.low * b.low + a.high * b.high` of each lane's two bfloat16, given as bits: the element that comes first is the low half.
    /// Rounded once or twice; a native product may take denormals for zero.
    #[inline(always)]
    unsafe fn bf16(sum: V, a: V::Ints, b: V::Ints) -> V {
        // SAFETY: the caller's promise.
        unsafe {
            let low = V::low_halves(a).fma(V::low_halves(b), sum);
            V::high_halves(a).fma(V::high_halves(b), low)
        }
    }

    /// The same of `a` and lane `LANE` of `b`, where there is [`Vector::BY_LANE`].
    #[inline(always)]
    unsafe fn bf16_lane<const LANE: i32>(_sum: V, _a: V::Ints, _b: V::Ints) -> V {
        unreachable!("only where there is BY_LANE")
    }

    /// `first` and then `second`, `2 * LANES` elements, rounded to bfloat16 as [`Vector::round_to_bf16`] does; a native conversion may take
    /// denormals for zero.
    #[inline(always)]
    unsafe fn store_bf16(first: V, second: V, to: *mut u16) {
        // SAFETY: the caller's promise.
        unsafe {
            first.store_bf16(to);
            second.store_bf16(to.add(V::LANES));
        }
    }

    /// `sum` and the four products of each lane's unsigned bytes `x`, at most [`Self::MAX_BYTE`], and signed bytes `w`, none of them -128.
    #[inline(always)]
    unsafe fn int8(sum: V::Ints, x: V::Ints, w: V::Ints) -> V::Ints {
        // SAFETY: the caller's promise.
        unsafe { V::dot_bytes(sum, x, w) }
    }
}

/// Made of what every CPU with the vector has.
pub(crate) struct NoDots;

// SAFETY: nothing is needed beyond the vector's own instruction set.
unsafe impl<V: Vector> Dots<V> for NoDots {}
