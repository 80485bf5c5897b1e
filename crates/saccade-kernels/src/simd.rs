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
        Isa::Avx2 | Isa::Avx2Vnni => unsafe { x86::run_avx2(kernel) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: this CPU has it, as was just checked.
        Isa::Avx512f | Isa::Avx512 => unsafe { x86::run_avx512(kernel) },
        #[cfg(not(target_arch = "x86_64"))]
        _ => unreachable!("{isa} is never available on this architecture"),
    }
}

/// Sums of products of narrow elements, several of which lie in a lane.
///
/// # Safety
/// Every method needs a CPU that has the instruction set of `V` and the dot products of the implementation.
pub(crate) unsafe trait Dots<V: Vector> {
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

/// Which dot product a kernel uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Dot {
    Bf16,
    Int8,
}

/// Work over vectors and dot products. `run` must be `#[inline(always)]`.
pub(crate) trait DotKernel {
    type Output;

    /// The one whose instructions are turned on.
    const DOT: Dot;

    /// # Safety
    /// The CPU has the instruction set of `V` and the dot product [`Self::DOT`] of `D`.
    unsafe fn run<V: Vector, D: Dots<V>>(self) -> Self::Output;
}

/// Runs a kernel with the vectors of `isa`, and with its dot product where it has the one that the kernel uses.
///
/// # Panics
/// If this CPU lacks `isa`.
#[inline]
pub(crate) fn dispatch_dots<K: DotKernel>(isa: Isa, kernel: K) -> K::Output {
    assert!(isa.is_available(), "this CPU lacks {isa}");
    match isa {
        // SAFETY: plain arithmetic, on any CPU.
        Isa::Portable => unsafe { kernel.run::<Portable, NoDots>() },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: this CPU has the instruction set, and the dot products that are asked about.
        _ => unsafe { x86::run_dots(isa, kernel) },
        #[cfg(not(target_arch = "x86_64"))]
        _ => unreachable!("{isa} is never available on this architecture"),
    }
}

/// Number of f32 lanes of an instruction set.
pub(crate) fn lanes(isa: Isa) -> usize {
    match isa {
        Isa::Portable | Isa::Avx2 | Isa::Avx2Vnni => 8,
        Isa::Avx512f | Isa::Avx512 => 16,
    }
}

pub(crate) use portable::Portable;

mod portable {
    use half::bf16;

    use super::Vector;

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

    #[inline(always)]
    fn zip_ints(a: [i32; 8], b: [i32; 8], f: impl Fn(i32, i32) -> i32) -> [i32; 8] {
        let mut out = a;
        for (out, &b) in out.iter_mut().zip(&b) {
            *out = f(*out, b);
        }
        out
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
        type Ints = [i32; 8];
        const MAX_BYTE: u8 = 255;

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
        unsafe fn low_halves(pairs: [i32; 8]) -> Self {
            Self(pairs.map(|pair| f32::from_bits((pair as u32) << 16)))
        }

        #[inline(always)]
        unsafe fn high_halves(pairs: [i32; 8]) -> Self {
            Self(pairs.map(|pair| f32::from_bits(pair as u32 & 0xffff_0000)))
        }

        #[inline(always)]
        unsafe fn round_to_bf16(self) -> Self {
            Self(self.0.map(|x| bf16::from_f32(x).to_f32()))
        }

        #[inline(always)]
        unsafe fn store_bf16(self, to: *mut u16) {
            // SAFETY: the caller gives room for eight elements.
            unsafe {
                to.cast::<[u16; 8]>()
                    .write_unaligned(self.0.map(|x| bf16::from_f32(x).to_bits()))
            }
        }

        #[inline(always)]
        unsafe fn store_bytes(self, zero: [i32; 8], most: [i32; 8], to: *mut u8) {
            let whole = self.0.map(|x| ((x + ROUND) - ROUND) as i32);
            let bytes = zip_ints(zip_ints(whole, zero, i32::wrapping_add), most, i32::min);
            // SAFETY: the caller gives room for eight elements.
            unsafe { to.cast::<[u8; 8]>().write_unaligned(bytes.map(|byte| byte as u8)) }
        }

        #[inline(always)]
        unsafe fn splat_int(x: i32) -> [i32; 8] {
            [x; 8]
        }

        #[inline(always)]
        unsafe fn load_ints(from: *const i32) -> [i32; 8] {
            // SAFETY: the caller gives eight elements.
            unsafe { from.cast::<[i32; 8]>().read_unaligned() }
        }

        #[inline(always)]
        unsafe fn store_ints(integers: [i32; 8], to: *mut i32) {
            // SAFETY: the caller gives eight elements.
            unsafe { to.cast::<[i32; 8]>().write_unaligned(integers) }
        }

        #[inline(always)]
        unsafe fn add_ints(a: [i32; 8], b: [i32; 8]) -> [i32; 8] {
            zip_ints(a, b, i32::wrapping_add)
        }

        #[inline(always)]
        unsafe fn sub_ints(a: [i32; 8], b: [i32; 8]) -> [i32; 8] {
            zip_ints(a, b, i32::wrapping_sub)
        }

        #[inline(always)]
        unsafe fn mul_ints(a: [i32; 8], b: [i32; 8]) -> [i32; 8] {
            zip_ints(a, b, i32::wrapping_mul)
        }

        #[inline(always)]
        unsafe fn from_ints(integers: [i32; 8]) -> Self {
            Self(integers.map(|integer| integer as f32))
        }

        #[inline(always)]
        unsafe fn dot_bytes(sum: [i32; 8], x: [i32; 8], w: [i32; 8]) -> [i32; 8] {
            let mut sum = sum;
            for byte in [0, 8, 16, 24] {
                let products = zip_ints(x, w, |x, w| ((x >> byte) & 255) * ((w << (24 - byte)) >> 24));
                sum = zip_ints(sum, products, i32::wrapping_add);
            }
            sum
        }

        #[inline(always)]
        unsafe fn prefetch(_: *const u8) {}
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;
    use std::mem::transmute;

    use super::{Dot, DotKernel, Dots, Kernel, NoDots, Vector};
    use crate::isa::Isa;

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

    /// Runs a kernel with those instructions that `isa` has for the kernel's dot product.
    ///
    /// # Safety
    /// The CPU has `isa`, which is not the portable one.
    #[inline]
    pub(super) unsafe fn run_dots<K: DotKernel>(isa: Isa, kernel: K) -> K::Output {
        // SAFETY: the caller's promise, and each feature is asked for before it is used.
        unsafe {
            match (isa, K::DOT) {
                (Isa::Avx2Vnni, Dot::Int8) if is_x86_feature_detected!("avxvnni") => run_avxvnni(kernel),
                (Isa::Avx2Vnni, Dot::Int8) => run_avx512vnni_256(kernel),
                (Isa::Avx512, Dot::Int8) if isa.has_vnni() => run_avx512vnni(kernel),
                (Isa::Avx512, Dot::Bf16) if isa.has_bf16_dot() => run_avx512bf16(kernel),
                (Isa::Avx512f | Isa::Avx512, _) => run_avx512(WithoutDots(kernel)),
                _ => run_avx2(WithoutDots(kernel)),
            }
        }
    }

    /// A kernel for dot products on a CPU without them.
    struct WithoutDots<K>(K);

    impl<K: DotKernel> Kernel for WithoutDots<K> {
        type Output = K::Output;

        #[inline(always)]
        unsafe fn run<V: Vector>(self) -> K::Output {
            // SAFETY: the caller's promise.
            unsafe { self.0.run::<V, NoDots>() }
        }
    }

    /// # Safety
    /// The CPU has AVX2, FMA and AVX-VNNI.
    #[target_feature(enable = "avx2,fma,avxvnni")]
    unsafe fn run_avxvnni<K: DotKernel>(kernel: K) -> K::Output {
        // SAFETY: the caller's promise.
        unsafe { kernel.run::<__m256, AvxVnni>() }
    }

    /// # Safety
    /// The CPU has AVX2, FMA and AVX-512 F, VL and VNNI.
    #[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512vnni")]
    unsafe fn run_avx512vnni_256<K: DotKernel>(kernel: K) -> K::Output {
        // SAFETY: the caller's promise.
        unsafe { kernel.run::<__m256, Avx512Vnni>() }
    }

    /// # Safety
    /// The CPU has AVX-512 F, VL, BW, DQ and VNNI, AVX2 and FMA.
    #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma,avx512vnni")]
    unsafe fn run_avx512vnni<K: DotKernel>(kernel: K) -> K::Output {
        // SAFETY: the caller's promise.
        unsafe { kernel.run::<__m512, Avx512Vnni>() }
    }

    /// # Safety
    /// The CPU has AVX-512 F, VL, BW, DQ and BF16, AVX2 and FMA.
    #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma,avx512bf16")]
    unsafe fn run_avx512bf16<K: DotKernel>(kernel: K) -> K::Output {
        // SAFETY: the caller's promise.
        unsafe { kernel.run::<__m512, Avx512Bf16>() }
    }

    /// AVX-VNNI: the shorter encoding, of CPUs that may lack AVX-512.
    struct AvxVnni;

    // SAFETY: the caller has AVX-VNNI.
    unsafe impl Dots<__m256> for AvxVnni {
        const MAX_BYTE: u8 = 255;

        #[inline(always)]
        unsafe fn int8(sum: __m256i, x: __m256i, w: __m256i) -> __m256i {
            // SAFETY: the caller's promise.
            unsafe { _mm256_dpbusd_avx_epi32(sum, x, w) }
        }
    }

    /// AVX512-VNNI, with VL where the vector is of 256 bits.
    struct Avx512Vnni;

    // SAFETY: the caller has AVX512-VNNI and VL.
    unsafe impl Dots<__m256> for Avx512Vnni {
        const MAX_BYTE: u8 = 255;

        #[inline(always)]
        unsafe fn int8(sum: __m256i, x: __m256i, w: __m256i) -> __m256i {
            // SAFETY: the caller's promise.
            unsafe { _mm256_dpbusd_epi32(sum, x, w) }
        }
    }

    // SAFETY: the caller has AVX512-VNNI.
    unsafe impl Dots<__m512> for Avx512Vnni {
        const MAX_BYTE: u8 = 255;

        #[inline(always)]
        unsafe fn int8(sum: __m512i, x: __m512i, w: __m512i) -> __m512i {
            // SAFETY: the caller's promise.
            unsafe { _mm512_dpbusd_epi32(sum, x, w) }
        }
    }

    /// AVX512-BF16.
    struct Avx512Bf16;

    // SAFETY: the caller has AVX512-BF16.
    unsafe impl Dots<__m512> for Avx512Bf16 {
        const HAS_BF16: bool = true;

        #[inline(always)]
        unsafe fn bf16(sum: __m512, a: __m512i, b: __m512i) -> __m512 {
            // SAFETY: the caller's promise; both types are 512 bits of which all values are valid.
            unsafe {
                _mm512_dpbf16_ps(
                    sum,
                    transmute::<__m512i, __m512bh>(a),
                    transmute::<__m512i, __m512bh>(b),
                )
            }
        }

        #[inline(always)]
        unsafe fn store_bf16(first: __m512, second: __m512, to: *mut u16) {
            // SAFETY: as above.
            unsafe {
                let pairs = transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(second, first));
                _mm512_storeu_si512(to.cast(), pairs);
            }
        }
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
        type Ints = __m256i;
        // Two products of at most 129 * 127 are less than 2^15, where `maddubs` saturates. The other ways out cost more: 7 bits in the weights
        // lose as much (0.018 instead of 0.011 of the result, beside 0.017), 16-bit products take the time of float32.
        const MAX_BYTE: u8 = 129;

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
        unsafe fn low_halves(pairs: __m256i) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_castsi256_ps(_mm256_slli_epi32::<16>(pairs)) }
        }

        #[inline(always)]
        unsafe fn high_halves(pairs: __m256i) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_castsi256_ps(_mm256_and_si256(pairs, _mm256_set1_epi32(0xffff_0000_u32 as i32))) }
        }

        #[inline(always)]
        unsafe fn round_to_bf16(self) -> Self {
            // SAFETY: as in splat. Half a unit of the last place is added, less one where that place is even; a NaN's payload could
            // overflow, so it becomes the quiet one.
            unsafe {
                let bits = _mm256_castps_si256(self);
                let even = _mm256_and_si256(_mm256_srli_epi32::<16>(bits), _mm256_set1_epi32(1));
                let rounded = _mm256_add_epi32(_mm256_add_epi32(bits, _mm256_set1_epi32(0x7fff)), even);
                let rounded = _mm256_and_si256(rounded, _mm256_set1_epi32(0xffff_0000_u32 as i32));
                let nan = _mm256_cmp_ps::<_CMP_UNORD_Q>(self, self);
                _mm256_blendv_ps(_mm256_castsi256_ps(rounded), _mm256_set1_ps(f32::NAN), nan)
            }
        }

        #[inline(always)]
        unsafe fn store_bf16(self, to: *mut u16) {
            // SAFETY: the caller gives room for eight elements. Packing works within halves of the vector, which are then put in order.
            unsafe {
                let high = _mm256_srli_epi32::<16>(_mm256_castps_si256(self.round_to_bf16()));
                let packed = _mm256_permute4x64_epi64::<0b1000>(_mm256_packus_epi32(high, high));
                _mm_storeu_si128(to.cast(), _mm256_castsi256_si128(packed));
            }
        }

        #[inline(always)]
        unsafe fn store_bytes(self, zero: __m256i, most: __m256i, to: *mut u8) {
            // SAFETY: the caller gives room for eight elements.
            unsafe {
                let integers = _mm256_add_epi32(_mm256_cvtps_epi32(self), zero);
                let integers = _mm256_min_epi32(integers, most);
                let low = _mm256_castsi256_si128(integers);
                let halves = _mm_packus_epi32(low, _mm256_extracti128_si256::<1>(integers));
                _mm_storel_epi64(to.cast(), _mm_packus_epi16(halves, halves));
            }
        }

        #[inline(always)]
        unsafe fn splat_int(x: i32) -> __m256i {
            // SAFETY: as in splat.
            unsafe { _mm256_set1_epi32(x) }
        }

        #[inline(always)]
        unsafe fn load_ints(from: *const i32) -> __m256i {
            // SAFETY: the caller gives eight elements.
            unsafe { _mm256_loadu_si256(from.cast()) }
        }

        #[inline(always)]
        unsafe fn store_ints(integers: __m256i, to: *mut i32) {
            // SAFETY: the caller gives eight elements.
            unsafe { _mm256_storeu_si256(to.cast(), integers) }
        }

        #[inline(always)]
        unsafe fn add_ints(a: __m256i, b: __m256i) -> __m256i {
            // SAFETY: as in splat.
            unsafe { _mm256_add_epi32(a, b) }
        }

        #[inline(always)]
        unsafe fn sub_ints(a: __m256i, b: __m256i) -> __m256i {
            // SAFETY: as in splat.
            unsafe { _mm256_sub_epi32(a, b) }
        }

        #[inline(always)]
        unsafe fn mul_ints(a: __m256i, b: __m256i) -> __m256i {
            // SAFETY: as in splat.
            unsafe { _mm256_mullo_epi32(a, b) }
        }

        #[inline(always)]
        unsafe fn from_ints(integers: __m256i) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm256_cvtepi32_ps(integers) }
        }

        #[inline(always)]
        unsafe fn dot_bytes(sum: __m256i, x: __m256i, w: __m256i) -> __m256i {
            // SAFETY: as in splat.
            unsafe {
                let pairs = _mm256_maddubs_epi16(x, w);
                _mm256_add_epi32(sum, _mm256_madd_epi16(pairs, _mm256_set1_epi16(1)))
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
        type Ints = __m512i;
        // As with AVX2.
        const MAX_BYTE: u8 = 129;

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
        unsafe fn low_halves(pairs: __m512i) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_castsi512_ps(_mm512_slli_epi32::<16>(pairs)) }
        }

        #[inline(always)]
        unsafe fn high_halves(pairs: __m512i) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_castsi512_ps(_mm512_and_si512(pairs, _mm512_set1_epi32(0xffff_0000_u32 as i32))) }
        }

        #[inline(always)]
        unsafe fn round_to_bf16(self) -> Self {
            // SAFETY: as in splat. As with AVX2.
            unsafe {
                let bits = _mm512_castps_si512(self);
                let even = _mm512_and_si512(_mm512_srli_epi32::<16>(bits), _mm512_set1_epi32(1));
                let rounded = _mm512_add_epi32(_mm512_add_epi32(bits, _mm512_set1_epi32(0x7fff)), even);
                let rounded = _mm512_and_si512(rounded, _mm512_set1_epi32(0xffff_0000_u32 as i32));
                let nan = _mm512_cmp_ps_mask::<_CMP_UNORD_Q>(self, self);
                _mm512_mask_mov_ps(_mm512_castsi512_ps(rounded), nan, _mm512_set1_ps(f32::NAN))
            }
        }

        #[inline(always)]
        unsafe fn store_bf16(self, to: *mut u16) {
            // SAFETY: the caller gives room for sixteen elements.
            unsafe {
                let high = _mm512_srli_epi32::<16>(_mm512_castps_si512(self.round_to_bf16()));
                _mm256_storeu_si256(to.cast(), _mm512_cvtepi32_epi16(high));
            }
        }

        #[inline(always)]
        unsafe fn store_bytes(self, zero: __m512i, most: __m512i, to: *mut u8) {
            // SAFETY: the caller gives room for sixteen elements.
            unsafe {
                let integers = _mm512_add_epi32(_mm512_cvtps_epi32(self), zero);
                let integers = _mm512_min_epi32(integers, most);
                _mm_storeu_si128(to.cast(), _mm512_cvtepi32_epi8(integers));
            }
        }

        #[inline(always)]
        unsafe fn splat_int(x: i32) -> __m512i {
            // SAFETY: as in splat.
            unsafe { _mm512_set1_epi32(x) }
        }

        #[inline(always)]
        unsafe fn load_ints(from: *const i32) -> __m512i {
            // SAFETY: the caller gives sixteen elements.
            unsafe { _mm512_loadu_si512(from.cast()) }
        }

        #[inline(always)]
        unsafe fn store_ints(integers: __m512i, to: *mut i32) {
            // SAFETY: the caller gives sixteen elements.
            unsafe { _mm512_storeu_si512(to.cast(), integers) }
        }

        #[inline(always)]
        unsafe fn add_ints(a: __m512i, b: __m512i) -> __m512i {
            // SAFETY: as in splat.
            unsafe { _mm512_add_epi32(a, b) }
        }

        #[inline(always)]
        unsafe fn sub_ints(a: __m512i, b: __m512i) -> __m512i {
            // SAFETY: as in splat.
            unsafe { _mm512_sub_epi32(a, b) }
        }

        #[inline(always)]
        unsafe fn mul_ints(a: __m512i, b: __m512i) -> __m512i {
            // SAFETY: as in splat.
            unsafe { _mm512_mullo_epi32(a, b) }
        }

        #[inline(always)]
        unsafe fn from_ints(integers: __m512i) -> Self {
            // SAFETY: as in splat.
            unsafe { _mm512_cvtepi32_ps(integers) }
        }

        #[inline(always)]
        unsafe fn dot_bytes(sum: __m512i, x: __m512i, w: __m512i) -> __m512i {
            // SAFETY: as in splat.
            unsafe {
                let pairs = _mm512_maddubs_epi16(x, w);
                _mm512_add_epi32(sum, _mm512_madd_epi16(pairs, _mm512_set1_epi16(1)))
            }
        }

        #[inline(always)]
        unsafe fn prefetch(at: *const u8) {
            // SAFETY: prefetching never faults, whatever the address.
            unsafe { _mm_prefetch::<_MM_HINT_T1>(at.cast()) }
        }
    }
}
