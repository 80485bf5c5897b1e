//! Plain loops over a few lanes, which any compiler vectorises for its baseline.

use half::bf16;

use super::bits::cast;
use super::{HIGH_NIBBLES, Kernel, Simd};

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

/// Methods of the token, each inlined into the kernel.
macro_rules! operations {
    ($(fn $name:ident($($argument:ident: $type:ty),*) $(-> $result:ty)? = $value:expr;)*) => {$(
        #[inline(always)]
        fn $name(self, $($argument: $type),*) $(-> $result)? {
            $value
        }
    )*};
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

    operations! {
        fn splat(x: f32) -> Self::F32 = [x; N];
        fn add(a: Self::F32, b: Self::F32) -> Self::F32 = zip(a, b, |a, b| a + b);
        fn sub(a: Self::F32, b: Self::F32) -> Self::F32 = zip(a, b, |a, b| a - b);
        fn mul(a: Self::F32, b: Self::F32) -> Self::F32 = zip(a, b, |a, b| a * b);
        fn div(a: Self::F32, b: Self::F32) -> Self::F32 = zip(a, b, |a, b| a / b);
        fn fma(a: Self::F32, b: Self::F32, addend: Self::F32) -> Self::F32 = zip(zip(a, b, |a, b| a * b), addend, |a, b| a + b);
        fn min(a: Self::F32, b: Self::F32) -> Self::F32 = zip(a, b, |a, b| if a < b { a } else { b });
        fn max(a: Self::F32, b: Self::F32) -> Self::F32 = zip(a, b, |a, b| if a > b { a } else { b });
        fn round(x: Self::F32) -> Self::F32 = zip(x, x, |x, _| (x + ROUND) - ROUND);
        fn scale_by_power_of_two(x: Self::F32, exponent: Self::F32) -> Self::F32 = {
            // In two steps, so that neither factor leaves the range of normal numbers.
            zip(x, exponent, |x, exponent| {
                let half = (exponent * 0.5 + ROUND) - ROUND;
                x * power_of_two(half) * power_of_two(exponent - half)
            })
        };
        fn low_bits_as_exponent(x: Self::F32) -> Self::F32 = x.map(|x| f32::from_bits(x.to_bits() << 23));
        fn replace_where(x: Self::F32, probe: Self::F32, value: Self::F32) -> Self::F32 = {
            let mut out = x;
            for ((out, probe), value) in out.iter_mut().zip(probe).zip(value) {
                *out = if probe == value { value } else { *out };
            }
            out
        };
        fn reduce_add(x: Self::F32) -> f32 = {
            let mut sums = x;
            let mut half = N / 2;
            while half > 0 {
                for lane in 0..half {
                    sums[lane] += sums[lane + half];
                }
                half /= 2;
            }
            sums[0]
        };
        fn reduce_max(x: Self::F32) -> f32 = {
            x.into_iter()
                .fold(f32::NEG_INFINITY, |a, b| if a > b { a } else { b })
        };
        fn splat_i32(x: i32) -> Self::I32 = [x; N];
        fn add_i32(a: Self::I32, b: Self::I32) -> Self::I32 = zip(a, b, i32::wrapping_add);
        fn sub_i32(a: Self::I32, b: Self::I32) -> Self::I32 = zip(a, b, i32::wrapping_sub);
        fn mul_i32(a: Self::I32, b: Self::I32) -> Self::I32 = zip(a, b, i32::wrapping_mul);
        fn to_f32(x: Self::I32) -> Self::F32 = x.map(|x| x as f32);
        fn low_halves(pairs: Self::I32) -> Self::F32 = pairs.map(|pair| f32::from_bits((pair as u32) << 16));
        fn high_halves(pairs: Self::I32) -> Self::F32 = pairs.map(|pair| f32::from_bits(pair as u32 & 0xffff_0000));
        fn low_nibbles(words: Self::I32) -> Self::I32 = words.map(|word| word << 4 & HIGH_NIBBLES);
        fn high_nibbles(words: Self::I32) -> Self::I32 = words.map(|word| word & HIGH_NIBBLES);
        fn round_to_bf16(x: Self::F32) -> Self::F32 = x.map(|x| bf16::from_f32(x).to_f32());
        fn to_bf16_pairs(first: Self::F32, second: Self::F32) -> Self::I32 = {
            let bits = [first, second].map(|x| x.map(|x| bf16::from_f32(x).to_bits()));
            cast(bits)
        };
        fn dot_int8(sum: Self::I32, x: Self::I32, w: Self::I32) -> Self::I32 = {
            let mut sum = sum;
            for byte in [0, 8, 16, 24] {
                let products = zip(x, w, |x, w| ((x >> byte) & 255) * ((w << (24 - byte)) >> 24));
                sum = zip(sum, products, i32::wrapping_add);
            }
            sum
        };
        fn load_rest(from: &[f32]) -> Self::F32 = {
            let mut out = [0.0; N];
            for (lane, element) in out.iter_mut().zip(from) {
                *lane = *element;
            }
            out
        };
        fn store_rest(x: Self::F32, to: &mut [f32]) = {
            for (element, lane) in to.iter_mut().zip(x) {
                *element = lane;
            }
        };
        fn store_bf16(x: Self::F32, to: &mut [u16]) = to[..N].copy_from_slice(&x.map(|x| bf16::from_f32(x).to_bits()));
        fn store_bytes(x: Self::F32, zero: Self::I32, most: Self::I32, to: &mut [u8]) = {
            let whole = x.map(|x| ((x + ROUND) - ROUND) as i32);
            let bytes = zip(zip(whole, zero, i32::wrapping_add), most, i32::min);
            to[..N].copy_from_slice(&bytes.map(|byte| byte as u8));
        };
    }

    #[inline(always)]
    fn prefetch(self, _: *const u8) {}
}
