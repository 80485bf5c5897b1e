//! Plain loops over a few lanes, which any compiler vectorises for its baseline.

use half::bf16;

use super::bits::cast;
use super::{Kernel, Simd};

/// Plain loops; every CPU runs them.
pub(crate) type Portable = Loops<8>;

/// Plain loops over `N` lanes, a power of two. The compiler spreads them over whatever vectors the target
/// has.
#[derive(Clone, Copy)]
pub(crate) struct Loops<const N: usize>;

/// Adding it rounds to a whole number, which is then in the low bits: 1.5 * 2^23.
const ROUND: f32 = 12_582_912.0;

#[inline(always)]
fn zip<T: Copy, const N: usize>(a: [T; N], b: [T; N], f: impl Fn(T, T) -> T) -> [T; N] {
    // Loops, not `array::map`: these are spread over vectors more reliably.
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

impl<const N: usize> Simd for Loops<N> {
    const NAME: &'static str = "portable";
    const LANES: usize = N;
    const TILE_ROWS: usize = 4;
    // Sixteen lanes are laid out as those of AVX-512 are.
    const TILE_VECTORS: usize = if N < 16 { 1 } else { 3 };
    const MAX_BYTE: u8 = 255;
    type F32 = [f32; N];
    type I32 = [i32; N];

    fn new() -> Option<Self> {
        Some(Self)
    }

    // Not inlined: other instruction sets would pay for the stack that its kernels need.
    #[inline(never)]
    fn run<K: Kernel>(self, kernel: &mut K) -> K::Output {
        kernel.run(self)
    }

    #[inline(always)]
    fn splat(self, x: f32) -> [f32; N] {
        [x; N]
    }

    #[inline(always)]
    fn add(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        zip(a, b, |a, b| a + b)
    }

    #[inline(always)]
    fn sub(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        zip(a, b, |a, b| a - b)
    }

    #[inline(always)]
    fn mul(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        zip(a, b, |a, b| a * b)
    }

    #[inline(always)]
    fn div(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        zip(a, b, |a, b| a / b)
    }

    #[inline(always)]
    fn fma(self, a: [f32; N], b: [f32; N], addend: [f32; N]) -> [f32; N] {
        self.add(self.mul(a, b), addend)
    }

    #[inline(always)]
    fn min(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        zip(a, b, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        zip(a, b, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn round(self, x: [f32; N]) -> [f32; N] {
        zip(x, x, |x, _| (x + ROUND) - ROUND)
    }

    #[inline(always)]
    fn scale_by_power_of_two(self, x: [f32; N], exponent: [f32; N]) -> [f32; N] {
        // In two steps, so that neither factor leaves the range of normal numbers.
        zip(x, exponent, |x, exponent| {
            let half = (exponent * 0.5 + ROUND) - ROUND;
            x * power_of_two(half) * power_of_two(exponent - half)
        })
    }

    #[inline(always)]
    fn low_bits_as_exponent(self, x: [f32; N]) -> [f32; N] {
        x.map(|x| f32::from_bits(x.to_bits() << 23))
    }

    #[inline(always)]
    fn replace_where(self, x: [f32; N], probe: [f32; N], value: [f32; N]) -> [f32; N] {
        let mut out = x;
        for ((out, probe), value) in out.iter_mut().zip(probe).zip(value) {
            *out = if probe == value { value } else { *out };
        }
        out
    }

    #[inline(always)]
    fn reduce_add(self, x: [f32; N]) -> f32 {
        let mut sums = x;
        let mut half = N / 2;
        while half > 0 {
            for lane in 0..half {
                sums[lane] += sums[lane + half];
            }
            half /= 2;
        }
        sums[0]
    }

    #[inline(always)]
    fn reduce_max(self, x: [f32; N]) -> f32 {
        x.into_iter()
            .fold(f32::NEG_INFINITY, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn splat_i32(self, x: i32) -> [i32; N] {
        [x; N]
    }

    #[inline(always)]
    fn add_i32(self, a: [i32; N], b: [i32; N]) -> [i32; N] {
        zip(a, b, i32::wrapping_add)
    }

    #[inline(always)]
    fn sub_i32(self, a: [i32; N], b: [i32; N]) -> [i32; N] {
        zip(a, b, i32::wrapping_sub)
    }

    #[inline(always)]
    fn mul_i32(self, a: [i32; N], b: [i32; N]) -> [i32; N] {
        zip(a, b, i32::wrapping_mul)
    }

    #[inline(always)]
    fn to_f32(self, x: [i32; N]) -> [f32; N] {
        x.map(|x| x as f32)
    }

    #[inline(always)]
    fn low_halves(self, pairs: [i32; N]) -> [f32; N] {
        pairs.map(|pair| f32::from_bits((pair as u32) << 16))
    }

    #[inline(always)]
    fn high_halves(self, pairs: [i32; N]) -> [f32; N] {
        pairs.map(|pair| f32::from_bits(pair as u32 & 0xffff_0000))
    }

    #[inline(always)]
    fn round_to_bf16(self, x: [f32; N]) -> [f32; N] {
        x.map(|x| bf16::from_f32(x).to_f32())
    }

    #[inline(always)]
    fn to_bf16_pairs(self, first: [f32; N], second: [f32; N]) -> [i32; N] {
        let bits = [first, second].map(|x| x.map(|x| bf16::from_f32(x).to_bits()));
        cast(bits)
    }

    #[inline(always)]
    fn dot_int8(self, sum: [i32; N], x: [i32; N], w: [i32; N]) -> [i32; N] {
        let mut sum = sum;
        for byte in [0, 8, 16, 24] {
            let products = zip(x, w, |x, w| ((x >> byte) & 255) * ((w << (24 - byte)) >> 24));
            sum = zip(sum, products, i32::wrapping_add);
        }
        sum
    }

    #[inline(always)]
    fn load_rest(self, from: &[f32]) -> [f32; N] {
        let mut out = [0.0; N];
        for (lane, element) in out.iter_mut().zip(from) {
            *lane = *element;
        }
        out
    }

    #[inline(always)]
    fn store_rest(self, x: [f32; N], to: &mut [f32]) {
        for (element, lane) in to.iter_mut().zip(x) {
            *element = lane;
        }
    }

    #[inline(always)]
    fn store_bf16(self, x: [f32; N], to: &mut [u16]) {
        to[..N].copy_from_slice(&x.map(|x| bf16::from_f32(x).to_bits()));
    }

    #[inline(always)]
    fn store_bytes(self, x: [f32; N], zero: [i32; N], most: [i32; N], to: &mut [u8]) {
        let whole = x.map(|x| ((x + ROUND) - ROUND) as i32);
        let bytes = zip(zip(whole, zero, i32::wrapping_add), most, i32::min);
        to[..N].copy_from_slice(&bytes.map(|byte| byte as u8));
    }

    #[inline(always)]
    fn prefetch(self, _: *const u8) {}
}
