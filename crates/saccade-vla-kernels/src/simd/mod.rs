//! Vectors of f32 and i32: the kernels are written once over them, for all instruction sets.
//!
//! A value of a [`Simd`] type is a token. It proves that this CPU has an instruction set, so the operations
//! on its vectors are safe methods of the token. [`Simd::run`] is the only place that turns target features
//! on; a [`Kernel`] is inlined into it whole, so that every operation becomes an instruction or a few.

#[cfg(all(target_arch = "aarch64", not(saccade_portable)))]
pub(crate) mod aarch64;
pub(crate) mod bits;
pub(crate) mod math;
pub(crate) mod portable;
pub(crate) mod slices;
#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
pub(crate) mod x86_64;

use bits::{Bits, cast, read, write};

/// Lanes of the widest vector.
pub(crate) const MAX_LANES: usize = 16;

/// Words of a cache line.
pub(crate) const LINE: usize = 16;

/// The high half of each byte of a word.
pub(crate) const HIGH_NIBBLES: i32 = 0xf0f0_f0f0_u32.cast_signed();

/// Rows of the largest tile of any instruction set.
pub(crate) const MAX_TILE_ROWS: usize = 8;

/// An instruction set, as a token: a value exists only on a CPU that has it.
///
/// Slices are loaded and stored from their first element on; they need not be aligned.
pub(crate) trait Simd: Copy + Send + Sync + 'static {
    /// The part of kernels' names that says which vectors they use.
    const NAME: &'static str;
    /// Elements of a vector, at most [`MAX_LANES`].
    const LANES: usize;
    /// Rows of the largest register tile (MR), at most [`MAX_TILE_ROWS`]. A tile is
    /// `TILE_ROWS x TILE_VECTORS` sums; as many vectors as it is wide and a broadcast element stay in
    /// registers with them. The tile is large enough to hide the latency of the multiply-adds.
    const TILE_ROWS: usize;
    /// Vectors of a row of that tile (NR): at most 3 where linear layers are made of these vectors, 4 where
    /// only attention is.
    const TILE_VECTORS: usize;
    /// Whether multiply-adds take a factor from a lane: then there are [`Self::fma_lane`] and
    /// [`Self::dot_bf16_lane`].
    const BY_LANE: bool = false;
    /// The largest unsigned byte that [`Self::dot_int8`] accepts.
    const MAX_BYTE: u8;
    /// Whether [`Self::dot_bf16`] is one instruction.
    const HAS_DOT_BF16: bool = false;
    /// The name that users know the dot products by; empty where there are no instructions for them.
    const DOT_NAME: &'static str = "";

    /// `LANES` f32.
    type F32: Bits;
    /// `LANES` i32, or as many words of narrow elements.
    type I32: Bits;

    /// The proof that this CPU has the instruction set.
    fn new() -> Option<Self>;

    /// Runs a kernel with the target features turned on.
    fn run<K: Kernel>(self, kernel: &mut K) -> K::Output;

    /// Every lane `x`.
    fn splat(self, x: f32) -> Self::F32;
    fn add(self, a: Self::F32, b: Self::F32) -> Self::F32;
    fn sub(self, a: Self::F32, b: Self::F32) -> Self::F32;
    fn mul(self, a: Self::F32, b: Self::F32) -> Self::F32;
    fn div(self, a: Self::F32, b: Self::F32) -> Self::F32;
    /// `a * b + addend`: rounded once where there is FMA, twice where there is none.
    fn fma(self, a: Self::F32, b: Self::F32, addend: Self::F32) -> Self::F32;
    /// `a < b ? a : b`: `b` where either is NaN.
    fn min(self, a: Self::F32, b: Self::F32) -> Self::F32;
    /// `a > b ? a : b`: `b` where either is NaN.
    fn max(self, a: Self::F32, b: Self::F32) -> Self::F32;
    /// The nearest whole number, ties to even, for `|x| < 2^22`.
    fn round(self, x: Self::F32) -> Self::F32;
    /// `x * 2^exponent` for whole exponents in `-252..=254`; NaN in `x` stays.
    fn scale_by_power_of_two(self, x: Self::F32, exponent: Self::F32) -> Self::F32;
    /// The f32 whose sign and exponent are the low nine bits of each lane.
    fn low_bits_as_exponent(self, x: Self::F32) -> Self::F32;
    /// `value` in those lanes where `probe == value`, `x` in the others.
    fn replace_where(self, x: Self::F32, probe: Self::F32, value: Self::F32) -> Self::F32;
    /// Sum of the lanes, in a fixed order.
    fn reduce_add(self, x: Self::F32) -> f32;
    /// Largest lane; unspecified if a lane is NaN.
    fn reduce_max(self, x: Self::F32) -> f32;

    /// Every lane `x`.
    fn splat_i32(self, x: i32) -> Self::I32;
    fn add_i32(self, a: Self::I32, b: Self::I32) -> Self::I32;
    fn sub_i32(self, a: Self::I32, b: Self::I32) -> Self::I32;
    /// The low halves of the products.
    fn mul_i32(self, a: Self::I32, b: Self::I32) -> Self::I32;
    /// The nearest f32, ties to even.
    fn to_f32(self, x: Self::I32) -> Self::F32;
    /// The same bits as f32.
    #[inline(always)]
    fn bits_to_f32(self, words: Self::I32) -> Self::F32 {
        cast(words)
    }

    /// The low half of each word as the upper half of an f32: bfloat16 widened.
    fn low_halves(self, pairs: Self::I32) -> Self::F32;
    /// The high half of each word, likewise.
    fn high_halves(self, pairs: Self::I32) -> Self::F32;
    /// The low half of each byte as a signed byte that is 16 times as large: int4 widened.
    fn low_nibbles(self, words: Self::I32) -> Self::I32;
    /// The high half, likewise.
    fn high_nibbles(self, words: Self::I32) -> Self::I32;
    /// Rounded to bfloat16, to nearest and ties to even; NaN stays.
    fn round_to_bf16(self, x: Self::F32) -> Self::F32;

    /// The elements of `first` and then those of `second`, two in a word, rounded as [`Self::round_to_bf16`]
    /// does; an instruction may take denormals for zero.
    fn to_bf16_pairs(self, first: Self::F32, second: Self::F32) -> Self::I32;

    /// `a.low * b.low + a.high * b.high + sum` of the two bfloat16 in each word: the element that comes first
    /// is the low half. Rounded once or twice; an instruction may take denormals for zero.
    #[inline(always)]
    fn dot_bf16(self, sum: Self::F32, a: Self::I32, b: Self::I32) -> Self::F32 {
        let low = self.fma(self.low_halves(a), self.low_halves(b), sum);
        self.fma(self.high_halves(a), self.high_halves(b), low)
    }

    /// Adds to each sum the four products of its unsigned bytes `x`, at most [`Self::MAX_BYTE`], and its
    /// signed bytes `w`, none of them -128.
    fn dot_int8(self, sum: Self::I32, x: Self::I32, w: Self::I32) -> Self::I32;

    /// `a * b[LANE] + addend`, rounded once, where there is [`Self::BY_LANE`].
    #[inline(always)]
    fn fma_lane<const LANE: i32>(self, _a: Self::F32, _b: Self::F32, _addend: Self::F32) -> Self::F32 {
        unreachable!("only where there is BY_LANE")
    }

    /// [`Self::dot_bf16`] of `a` and lane `LANE` of `b`, where there is [`Self::BY_LANE`].
    #[inline(always)]
    fn dot_bf16_lane<const LANE: i32>(self, _sum: Self::F32, _a: Self::I32, _b: Self::I32) -> Self::F32 {
        unreachable!("only where there is BY_LANE")
    }

    /// The first `LANES` elements of `from`.
    #[inline(always)]
    #[track_caller]
    fn load(self, from: &[f32]) -> Self::F32 {
        const { assert!(size_of::<Self::F32>() == size_of::<f32>() * Self::LANES) }
        read(from)
    }

    /// The first elements of `from`, at most `LANES`; zeros in the lanes beyond its end.
    #[inline(always)]
    fn load_partial(self, from: &[f32]) -> Self::F32 {
        if from.len() >= Self::LANES {
            self.load(from)
        } else {
            self.load_rest(from)
        }
    }

    /// The elements of `from`, fewer than `LANES`; zeros in the other lanes.
    fn load_rest(self, from: &[f32]) -> Self::F32;

    /// The first `LANES` elements of `from`.
    #[inline(always)]
    #[track_caller]
    fn load_i32(self, from: &[i32]) -> Self::I32 {
        const { assert!(size_of::<Self::I32>() == size_of::<i32>() * Self::LANES) }
        read(from)
    }

    /// The first `LANES` words of `from`.
    #[inline(always)]
    #[track_caller]
    fn load_words(self, from: &[u32]) -> Self::I32 {
        const { assert!(size_of::<Self::I32>() == size_of::<u32>() * Self::LANES) }
        read(from)
    }

    /// Writes the first `LANES` elements of `to`.
    #[inline(always)]
    #[track_caller]
    fn store(self, x: Self::F32, to: &mut [f32]) {
        const { assert!(size_of::<Self::F32>() == size_of::<f32>() * Self::LANES) }
        write(x, to);
    }

    /// Writes the first elements of `to`, at most `LANES`.
    #[inline(always)]
    fn store_partial(self, x: Self::F32, to: &mut [f32]) {
        if to.len() >= Self::LANES {
            self.store(x, to);
        } else {
            self.store_rest(x, to);
        }
    }

    /// Writes the elements of `to`, fewer than `LANES`.
    fn store_rest(self, x: Self::F32, to: &mut [f32]);

    /// Writes the first `LANES` bfloat16 of `to`, rounded as [`Self::round_to_bf16`] does.
    fn store_bf16(self, x: Self::F32, to: &mut [u16]);

    /// Writes the first `2 * LANES` bfloat16 of `to`, rounded as [`Self::to_bf16_pairs`] does.
    #[inline(always)]
    fn store_bf16_pair(self, first: Self::F32, second: Self::F32, to: &mut [u16]) {
        write(self.to_bf16_pairs(first, second), to);
    }

    /// Writes the first `LANES` bytes of `to`: each lane rounded to the nearest whole number, ties to even,
    /// plus `zero`, and `most` where that is more. Any byte for lanes with which this is not in `0..=256`.
    fn store_bytes(self, x: Self::F32, zero: Self::I32, most: Self::I32, to: &mut [u8]);

    /// # Safety
    /// `from` points to `LANES` words, wherever they begin.
    #[inline(always)]
    unsafe fn load_words_ptr(self, from: *const u32) -> Self::I32 {
        const { assert!(size_of::<Self::I32>() == size_of::<u32>() * Self::LANES) }
        // SAFETY: the caller gives a vector's size of words, and any bits are a vector.
        unsafe { from.cast::<Self::I32>().read_unaligned() }
    }

    /// # Safety
    /// `to` may be written for `LANES` words, wherever they begin.
    #[inline(always)]
    unsafe fn store_words_ptr(self, words: Self::I32, to: *mut u32) {
        const { assert!(size_of::<Self::I32>() == size_of::<u32>() * Self::LANES) }
        // SAFETY: the caller gives room for a vector.
        unsafe { to.cast::<Self::I32>().write_unaligned(words) }
    }

    /// The transpose of the first `LANES` rows and columns of `square`, as `LANES` rows of `LANES` words.
    #[inline(always)]
    fn transpose(self, square: &[[u32; MAX_LANES]; MAX_LANES], to: &mut [u32]) {
        for column in 0..Self::LANES {
            let to = &mut to[column * Self::LANES..][..Self::LANES];
            for (to, row) in to.iter_mut().zip(square) {
                *to = row[column];
            }
        }
    }

    /// Prefetches the cache line at `at`, which may be any address. A hint: it may do nothing.
    fn prefetch(self, at: *const u8);
}

/// Methods of a token that call functions with target features.
#[cfg(all(any(target_arch = "x86_64", target_arch = "aarch64"), not(saccade_portable)))]
macro_rules! forward {
    ($(fn $method:ident $(<const $n:ident: i32>)? ($($argument:ident: $type:ty),*) $(-> $result:ty)? = $function:ident;)*) => {$(
        #[inline(always)]
        fn $method $(<const $n: i32>)? (self, $($argument: $type),*) $(-> $result)? {
            // SAFETY: a token exists only where `new` found the target features, which are all that the
            // function needs.
            unsafe { $function $(::<$n>)? ($($argument),*) }
        }
    )*};
}

/// Functions with target features. Intrinsics are safe in them, unless they take pointers.
#[cfg(all(any(target_arch = "x86_64", target_arch = "aarch64"), not(saccade_portable)))]
macro_rules! functions {
    ($features:literal: $(
        $(#[$doc:meta])*
        fn $name:ident $(<const $n:ident: i32>)? ($($argument:ident: $type:ty),*) $(-> $result:ty)? $body:block
    )*) => {$(
        $(#[$doc])*
        #[inline]
        #[target_feature(enable = $features)]
        fn $name $(<const $n: i32>)? ($($argument: $type),*) $(-> $result)? $body
    )*};
}

/// A token: its features, found by `$detected`, and constants, types and operations of its own. All other
/// operations are functions of the module that uses this, by the names of the methods.
#[cfg(all(any(target_arch = "x86_64", target_arch = "aarch64"), not(saccade_portable)))]
macro_rules! token {
    (
        $(#[$doc:meta])*
        $name:ident: $detected:ident[$($feature:tt),+], { $($own:tt)* }
    ) => {
        $(#[$doc])*
        #[derive(Clone, Copy)]
        pub(crate) struct $name(());

        impl Simd for $name {
            $($own)*

            #[inline]
            fn new() -> Option<Self> {
                ($($detected!($feature))&&+).then_some(Self(()))
            }

            #[inline]
            fn run<K: Kernel>(self, kernel: &mut K) -> K::Output {
                $(#[target_feature(enable = $feature)])+
                fn run<K: Kernel>(token: $name, kernel: &mut K) -> K::Output {
                    kernel.run(token)
                }
                // SAFETY: the token exists, so the CPU has the features.
                unsafe { run(self, kernel) }
            }

            forward! {
                fn splat(x: f32) -> Self::F32 = splat;
                fn add(a: Self::F32, b: Self::F32) -> Self::F32 = add;
                fn sub(a: Self::F32, b: Self::F32) -> Self::F32 = sub;
                fn mul(a: Self::F32, b: Self::F32) -> Self::F32 = mul;
                fn div(a: Self::F32, b: Self::F32) -> Self::F32 = div;
                fn fma(a: Self::F32, b: Self::F32, addend: Self::F32) -> Self::F32 = fma;
                fn min(a: Self::F32, b: Self::F32) -> Self::F32 = min;
                fn max(a: Self::F32, b: Self::F32) -> Self::F32 = max;
                fn round(x: Self::F32) -> Self::F32 = round;
                fn scale_by_power_of_two(x: Self::F32, exponent: Self::F32) -> Self::F32 = scale_by_power_of_two;
                fn low_bits_as_exponent(x: Self::F32) -> Self::F32 = low_bits_as_exponent;
                fn replace_where(x: Self::F32, probe: Self::F32, value: Self::F32) -> Self::F32 = replace_where;
                fn reduce_add(x: Self::F32) -> f32 = reduce_add;
                fn reduce_max(x: Self::F32) -> f32 = reduce_max;
                fn splat_i32(x: i32) -> Self::I32 = splat_i32;
                fn add_i32(a: Self::I32, b: Self::I32) -> Self::I32 = add_i32;
                fn sub_i32(a: Self::I32, b: Self::I32) -> Self::I32 = sub_i32;
                fn mul_i32(a: Self::I32, b: Self::I32) -> Self::I32 = mul_i32;
                fn to_f32(x: Self::I32) -> Self::F32 = to_f32;
                fn low_halves(pairs: Self::I32) -> Self::F32 = low_halves;
                fn high_halves(pairs: Self::I32) -> Self::F32 = high_halves;
                fn low_nibbles(words: Self::I32) -> Self::I32 = low_nibbles;
                fn high_nibbles(words: Self::I32) -> Self::I32 = high_nibbles;
                fn round_to_bf16(x: Self::F32) -> Self::F32 = round_to_bf16;
                fn load_rest(from: &[f32]) -> Self::F32 = load_rest;
                fn store_rest(x: Self::F32, to: &mut [f32]) = store_rest;
                fn store_bf16(x: Self::F32, to: &mut [u16]) = store_bf16;
                fn store_bytes(x: Self::F32, zero: Self::I32, most: Self::I32, to: &mut [u8]) = store_bytes;
            }

            #[inline(always)]
            fn prefetch(self, at: *const u8) {
                prefetch(at);
            }
        }
    };
}

#[cfg(all(any(target_arch = "x86_64", target_arch = "aarch64"), not(saccade_portable)))]
use {forward, functions, token};

/// Work that is written once for all instruction sets. `run` must be `#[inline(always)]`.
///
/// By reference: by value it would be copied in vectors just after it was stored in words, and store
/// forwarding would fail. A float32 layer of 3 rows, 8 inputs and 32 outputs took 247 instead of 201 ns
/// (AVX-512, Emerald Rapids).
pub(crate) trait Kernel {
    type Output;

    /// Whether the kernel uses dot products of bfloat16, if there is an instruction for them.
    #[allow(dead_code, reason = "not every architecture has such an instruction")]
    const USES_DOT_BF16: bool = false;

    fn run<S: Simd>(&mut self, simd: S) -> Self::Output;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::isa::Isa;

    struct Transpose<'a>(&'a [[u32; MAX_LANES]; MAX_LANES]);

    impl Kernel for Transpose<'_> {
        type Output = Vec<Vec<u32>>;

        #[inline(always)]
        fn run<S: Simd>(&mut self, simd: S) -> Self::Output {
            let mut to = vec![0; S::LANES * S::LANES];
            simd.transpose(self.0, &mut to);
            to.chunks_exact(S::LANES).map(<[u32]>::to_vec).collect()
        }
    }

    #[test]
    fn squares_are_transposed() {
        let square = std::array::from_fn(|row| std::array::from_fn(|column| (100 * row + column) as u32));
        for isa in Isa::available() {
            let columns = isa.run(&mut Transpose(&square));
            for (column, rows) in columns.iter().enumerate() {
                for (row, &word) in rows.iter().enumerate() {
                    assert_eq!(word, square[row][column], "{isa}: row {row}, column {column}");
                }
            }
        }
    }

    struct Partial<'a>(&'a [f32], &'a mut [f32]);

    impl Kernel for Partial<'_> {
        type Output = Vec<f32>;

        #[inline(always)]
        fn run<S: Simd>(&mut self, simd: S) -> Vec<f32> {
            let loaded = simd.load_partial(self.0);
            simd.store_partial(simd.add(loaded, simd.splat(100.0)), self.1);
            let mut lanes = vec![0.0; S::LANES];
            simd.store(loaded, &mut lanes);
            lanes
        }
    }

    #[test]
    fn parts_of_vectors_are_loaded_and_stored_and_nothing_else_is() {
        let x: Vec<f32> = (1..=20).map(|i| i as f32).collect();
        for isa in Isa::available() {
            for len in 0..=x.len() {
                let mut to = [0.0; 20];
                let lanes = isa.run(&mut Partial(&x[..len], &mut to[..len]));
                let count = len.min(lanes.len());
                assert_eq!(lanes[..count], x[..count], "{isa}, {len}");
                assert!(lanes[count..].iter().all(|&lane| lane == 0.0), "{isa}, {len}");
                assert!(
                    (0..20).all(|i| to[i] == if i < count { x[i] + 100.0 } else { 0.0 }),
                    "{isa}, {len}"
                );
            }
        }
    }
}
