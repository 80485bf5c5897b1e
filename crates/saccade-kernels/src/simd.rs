//! One small vector of f32, for each instruction set: the kernels are written once over it.
//!
//! [`dispatch`] is the only place that enters `#[target_feature]`; a [`Kernel`] is inlined into it whole, so that every operation below
//! becomes one instruction.

use crate::isa::Isa;

/// A vector of f32 lanes.
///
/// # Safety
/// Every method needs a CPU that has the instruction set of the implementation. Those that take pointers need them valid for the lanes that
/// they name: all of them, or the first `n` in the `_partial` forms (`n <= LANES`). Nothing needs to be aligned.
pub(crate) unsafe trait Vector: Copy {
    /// Elements of a vector.
    const LANES: usize;
    /// Vectors that fit into the registers of the instruction set.
    const REGISTERS: usize;
    /// The instruction set that it belongs to.
    const ISA: Isa;
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
    /// `value` in those lanes where `probe == value`, `self` in the others.
    unsafe fn replace_where(self, probe: Self, value: Self) -> Self;
    /// Sum of the lanes, in an order that is fixed.
    unsafe fn reduce_add(self) -> f32;
    /// Largest lane; unspecified if a lane is NaN.
    unsafe fn reduce_max(self) -> f32;
    /// The low halves of `LANES` words, each the upper half of an f32: bfloat16 widened.
    unsafe fn load_low_halves(from: *const u32) -> Self;
    /// The high halves, likewise.
    unsafe fn load_high_halves(from: *const u32) -> Self;
    /// Asks for the cache line at `at`, which may be any address. A hint: it may do nothing.
    unsafe fn prefetch(at: *const u8);
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

/// Work written once for all vectors. `run` must be `#[inline(always)]`.
pub(crate) trait Kernel {
    type Output;

    /// # Safety
    /// The CPU has the instruction set of `V`.
    unsafe fn run<V: Vector>(self) -> Self::Output;
}

/// Runs a kernel with the vectors of `isa`.
///
/// # Panics
/// If this CPU lacks `isa`: looking is a few loads, and makes every kernel sound.
#[inline]
pub(crate) fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Output {
    assert!(isa.is_available(), "this CPU lacks {isa}");
    match isa {
        // SAFETY: plain arithmetic, on any CPU.
        Isa::Portable => unsafe { kernel.run::<Portable>() },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: this CPU has it, as was just checked.
        Isa::Avx2 => unsafe { x86::run_avx2(kernel) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: this CPU has it, as was just checked.
        Isa::Avx512 => unsafe { x86::run_avx512(kernel) },
        #[cfg(not(target_arch = "x86_64"))]
        _ => unreachable!("{isa} is never available on this architecture"),
    }
}

/// Number of f32 lanes of an instruction set.
pub(crate) fn lanes(isa: Isa) -> usize {
    match isa {
        Isa::Portable | Isa::Avx2 => 8,
        Isa::Avx512 => 16,
    }
}

pub(crate) use portable::Portable;

mod portable {
    use super::{Isa, Vector};

    /// Eight lanes that the compiler spreads over whatever vectors the target has.
    #[derive(Clone, Copy)]
    pub(crate) struct Portable([f32; 8]);

    /// Adding it rounds to a whole number, which then lies in the low bits: 1.5 * 2^23.
    const ROUND: f32 = 12_582_912.0;

    #[inline(always)]
    fn zip(a: Portable, b: Portable, f: impl Fn(f32, f32) -> f32) -> Portable {
        // Loops, not `array::map`: these are spread over vectors more reliably.
        let mut out = a.0;
        for (out, &b) in out.iter_mut().zip(&b.0) {
            *out = f(*out, b);
        }
        Portable(out)
    }

    /// `2^exponent` for whole exponents in -126..=127.
    #[inline(always)]
    fn power_of_two(exponent: f32) -> f32 {
        let biased = (exponent + ROUND)
            .to_bits()
            .wrapping_sub(ROUND.to_bits())
            .wrapping_add(127);
        f32::from_bits(biased << 23)
    }

    // SAFETY: plain arithmetic; pointers are read and written for the lanes named only.
    unsafe impl Vector for Portable {
        const LANES: usize = 8;
        const REGISTERS: usize = 8;
        const ISA: Isa = Isa::Portable;

        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            Self([x; 8])
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            // SAFETY: the caller gives eight elements.
            Self(unsafe { from.cast::<[f32; 8]>().read_unaligned() })
        }

        #[inline(always)]
        unsafe fn store(self, to: *mut f32) {
            // SAFETY: the caller gives eight elements.
            unsafe { to.cast::<[f32; 8]>().write_unaligned(self.0) }
        }

        #[inline(always)]
        unsafe fn load_partial(from: *const f32, n: usize) -> Self {
            let mut out = [0.0; 8];
            for (lane, element) in out.iter_mut().enumerate().take(n) {
                // SAFETY: the caller gives n elements.
                *element = unsafe { *from.add(lane) };
            }
            Self(out)
        }

        #[inline(always)]
        unsafe fn store_partial(self, to: *mut f32, n: usize) {
            for (lane, element) in self.0.iter().enumerate().take(n) {
                // SAFETY: the caller gives n elements.
                unsafe { *to.add(lane) = *element };
            }
        }

        #[inline(always)]
        unsafe fn add(self, other: Self) -> Self {
            zip(self, other, |a, b| a + b)
        }

        #[inline(always)]
        unsafe fn sub(self, other: Self) -> Self {
            zip(self, other, |a, b| a - b)
        }

        #[inline(always)]
        unsafe fn mul(self, other: Self) -> Self {
            zip(self, other, |a, b| a * b)
        }

        #[inline(always)]
        unsafe fn div(self, other: Self) -> Self {
            zip(self, other, |a, b| a / b)
        }

        #[inline(always)]
        unsafe fn fma(self, factor: Self, addend: Self) -> Self {
            zip(zip(self, factor, |a, b| a * b), addend, |a, b| a + b)
        }

        #[inline(always)]
        unsafe fn min(self, other: Self) -> Self {
            zip(self, other, |a, b| if a < b { a } else { b })
        }

        #[inline(always)]
        unsafe fn max(self, other: Self) -> Self {
            zip(self, other, |a, b| if a > b { a } else { b })
        }

        #[inline(always)]
        unsafe fn round(self) -> Self {
            zip(self, self, |a, _| (a + ROUND) - ROUND)
        }

        #[inline(always)]
        unsafe fn scale_by_power_of_two(self, exponent: Self) -> Self {
            // In two steps, so that neither factor leaves the range of normal numbers.
            zip(self, exponent, |a, exponent| {
                let half = (exponent * 0.5 + ROUND) - ROUND;
                a * power_of_two(half) * power_of_two(exponent - half)
            })
        }

        #[inline(always)]
        unsafe fn replace_where(self, probe: Self, value: Self) -> Self {
            let mut out = self.0;
            for ((out, probe), value) in out.iter_mut().zip(probe.0).zip(value.0) {
                *out = if probe == value { value } else { *out };
            }
            Self(out)
        }

        #[inline(always)]
        unsafe fn reduce_add(self) -> f32 {
            let [a, b, c, d, e, f, g, h] = self.0;
            ((a + e) + (c + g)) + ((b + f) + (d + h))
        }

        #[inline(always)]
        unsafe fn reduce_max(self) -> f32 {
            self.0
                .into_iter()
                .fold(f32::NEG_INFINITY, |a, b| if a > b { a } else { b })
        }

        #[inline(always)]
        unsafe fn load_low_halves(from: *const u32) -> Self {
            // SAFETY: the caller gives eight words.
            let words = unsafe { from.cast::<[u32; 8]>().read_unaligned() };
            Self(words.map(|word| f32::from_bits(word << 16)))
        }

        #[inline(always)]
        unsafe fn load_high_halves(from: *const u32) -> Self {
            // SAFETY: the caller gives eight words.
            let words = unsafe { from.cast::<[u32; 8]>().read_unaligned() };
            Self(words.map(|word| f32::from_bits(word & 0xffff_0000)))
        }

        #[inline(always)]
        unsafe fn prefetch(_: *const u8) {}
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Isa, Kernel, Vector};

    /// # Safety
    /// The CPU has AVX2 and FMA.
    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
        // SAFETY: the caller's promise.
        unsafe { kernel.run::<__m256>() }
    }

    /// # Safety
    /// The CPU has AVX-512 F, VL, BW and DQ, AVX2 and FMA.
    #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
    pub(super) unsafe fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
        // SAFETY: the caller's promise.
        unsafe { kernel.run::<__m512>() }
    }

    const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

    /// Eight lanes from element `8 - n` on have the top bit set in the first `n`.
    static FIRST_LANES: [i32; 16] = [-1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0];

    #[inline(always)]
    unsafe fn first_lanes(n: usize) -> __m256i {
        debug_assert!(n <= 8);
        // SAFETY: n <= 8, so that eight elements are left; the trait's caller has AVX2.
        unsafe { _mm256_loadu_si256(FIRST_LANES.as_ptr().add(8 - n).cast()) }
    }

    // SAFETY: pointers are read and written for the lanes named only; masked lanes are not accessed.
    unsafe impl Vector for __m256 {
        const LANES: usize = 8;
        const REGISTERS: usize = 16;
        const ISA: Isa = Isa::Avx2;

        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            // SAFETY: the trait's caller has AVX2 and FMA; so throughout.
            unsafe { _mm256_set1_ps(x) }
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            // SAFETY: the caller gives eight elements.
            unsafe { _mm256_loadu_ps(from) }
        }

        #[inline(always)]
        unsafe fn store(self, to: *mut f32) {
            // SAFETY: the caller gives eight elements.
            unsafe { _mm256_storeu_ps(to, self) }
        }

        #[inline(always)]
        unsafe fn load_partial(from: *const f32, n: usize) -> Self {
            // SAFETY: the caller gives n elements; lanes beyond them are masked.
            unsafe { _mm256_maskload_ps(from, first_lanes(n)) }
        }

        #[inline(always)]
        unsafe fn store_partial(self, to: *mut f32, n: usize) {
            // SAFETY: the caller gives n elements; lanes beyond them are masked.
            unsafe { _mm256_maskstore_ps(to, first_lanes(n), self) }
        }

        #[inline(always)]
        unsafe fn add(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_add_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn sub(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_sub_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn mul(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_mul_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn div(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_div_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn fma(self, factor: Self, addend: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_fmadd_ps(self, factor, addend) }
        }

        #[inline(always)]
        unsafe fn min(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_min_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn max(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_max_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn round(self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_round_ps::<NEAREST>(self) }
        }

        #[inline(always)]
        unsafe fn scale_by_power_of_two(self, exponent: Self) -> Self {
            // SAFETY: as in splat. In two steps, so that neither factor leaves the range of normal numbers.
            unsafe {
                let exponent = _mm256_cvtps_epi32(exponent);
                let half = _mm256_srai_epi32::<1>(exponent);
                let rest = _mm256_sub_epi32(exponent, half);
                let bias = _mm256_set1_epi32(127);
                let first = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(half, bias)));
                let second = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(rest, bias)));
                _mm256_mul_ps(_mm256_mul_ps(self, first), second)
            }
        }

        #[inline(always)]
        unsafe fn replace_where(self, probe: Self, value: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_blendv_ps(self, value, _mm256_cmp_ps::<_CMP_EQ_OQ>(probe, value)) }
        }

        #[inline(always)]
        unsafe fn reduce_add(self) -> f32 {
            // SAFETY: as in splat.
            unsafe {
                let x = _mm_add_ps(_mm256_castps256_ps128(self), _mm256_extractf128_ps::<1>(self));
                let x = _mm_add_ps(x, _mm_movehl_ps(x, x));
                _mm_cvtss_f32(_mm_add_ss(x, _mm_shuffle_ps::<1>(x, x)))
            }
        }

        #[inline(always)]
        unsafe fn reduce_max(self) -> f32 {
            // SAFETY: as in splat.
            unsafe {
                let x = _mm_max_ps(_mm256_castps256_ps128(self), _mm256_extractf128_ps::<1>(self));
                let x = _mm_max_ps(x, _mm_movehl_ps(x, x));
                _mm_cvtss_f32(_mm_max_ss(x, _mm_shuffle_ps::<1>(x, x)))
            }
        }

        #[inline(always)]
        unsafe fn load_low_halves(from: *const u32) -> Self {
            // SAFETY: the caller gives eight words.
            unsafe { _mm256_castsi256_ps(_mm256_slli_epi32::<16>(_mm256_loadu_si256(from.cast()))) }
        }

        #[inline(always)]
        unsafe fn load_high_halves(from: *const u32) -> Self {
            // SAFETY: the caller gives eight words.
            unsafe {
                _mm256_castsi256_ps(_mm256_and_si256(
                    _mm256_loadu_si256(from.cast()),
                    _mm256_set1_epi32(0xffff_0000_u32 as i32),
                ))
            }
        }

        #[inline(always)]
        unsafe fn prefetch(at: *const u8) {
            // SAFETY: prefetching never faults, whatever the address.
            unsafe { _mm_prefetch::<_MM_HINT_T1>(at.cast()) }
        }
    }

    #[inline(always)]
    fn first_lanes_mask(n: usize) -> __mmask16 {
        debug_assert!(n <= 16);
        ((1_u32 << n) - 1) as __mmask16
    }

    // SAFETY: pointers are read and written for the lanes named only; masked lanes are not accessed.
    unsafe impl Vector for __m512 {
        const LANES: usize = 16;
        const REGISTERS: usize = 32;
        const ISA: Isa = Isa::Avx512;

        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            // SAFETY: the trait's caller has AVX-512; so throughout.
            unsafe { _mm512_set1_ps(x) }
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            // SAFETY: the caller gives sixteen elements.
            unsafe { _mm512_loadu_ps(from) }
        }

        #[inline(always)]
        unsafe fn store(self, to: *mut f32) {
            // SAFETY: the caller gives sixteen elements.
            unsafe { _mm512_storeu_ps(to, self) }
        }

        #[inline(always)]
        unsafe fn load_partial(from: *const f32, n: usize) -> Self {
            // SAFETY: the caller gives n elements; lanes beyond them are masked.
            unsafe { _mm512_maskz_loadu_ps(first_lanes_mask(n), from) }
        }

        #[inline(always)]
        unsafe fn store_partial(self, to: *mut f32, n: usize) {
            // SAFETY: the caller gives n elements; lanes beyond them are masked.
            unsafe { _mm512_mask_storeu_ps(to, first_lanes_mask(n), self) }
        }

        #[inline(always)]
        unsafe fn add(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_add_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn sub(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_sub_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn mul(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_mul_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn div(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_div_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn fma(self, factor: Self, addend: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_fmadd_ps(self, factor, addend) }
        }

        #[inline(always)]
        unsafe fn min(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_min_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn max(self, other: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_max_ps(self, other) }
        }

        #[inline(always)]
        unsafe fn round(self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_roundscale_ps::<NEAREST>(self) }
        }

        #[inline(always)]
        unsafe fn scale_by_power_of_two(self, exponent: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_scalef_ps(self, exponent) }
        }

        #[inline(always)]
        unsafe fn replace_where(self, probe: Self, value: Self) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_mask_mov_ps(self, _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(probe, value), value) }
        }

        #[inline(always)]
        unsafe fn reduce_add(self) -> f32 {
            // SAFETY: as in splat.
            unsafe {
                let low = _mm512_castps512_ps256(self);
                let high = _mm512_extractf32x8_ps::<1>(self);
                _mm256_add_ps(low, high).reduce_add()
            }
        }

        #[inline(always)]
        unsafe fn reduce_max(self) -> f32 {
            // SAFETY: as in splat.
            unsafe {
                let low = _mm512_castps512_ps256(self);
                let high = _mm512_extractf32x8_ps::<1>(self);
                _mm256_max_ps(low, high).reduce_max()
            }
        }

        #[inline(always)]
        unsafe fn load_low_halves(from: *const u32) -> Self {
            // SAFETY: the caller gives sixteen words.
            unsafe { _mm512_castsi512_ps(_mm512_slli_epi32::<16>(_mm512_loadu_si512(from.cast()))) }
        }

        #[inline(always)]
        unsafe fn load_high_halves(from: *const u32) -> Self {
            // SAFETY: the caller gives sixteen words.
            unsafe {
                _mm512_castsi512_ps(_mm512_and_si512(
                    _mm512_loadu_si512(from.cast()),
                    _mm512_set1_epi32(0xffff_0000_u32 as i32),
                ))
            }
        }

        #[inline(always)]
        unsafe fn prefetch(at: *const u8) {
            // SAFETY: prefetching never faults, whatever the address.
            unsafe { _mm_prefetch::<_MM_HINT_T1>(at.cast()) }
        }
    }
}
