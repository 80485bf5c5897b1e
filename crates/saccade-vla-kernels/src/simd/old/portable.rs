//! Plain loops over a few lanes, which any compiler vectorises for its baseline.

use half::bf16;

use super::Vector;

/// `N` lanes that the compiler spreads over whatever vectors the target has.
#[derive(Clone, Copy)]
pub(crate) struct Lanes<const N: usize>([f32; N]);

/// Adding it rounds to a whole number, which is then in the low bits: 1.5 * 2^23.
const ROUND: f32 = 12_582_912.0;

#[inline(always)]
fn zip<const N: usize>(a: Lanes<N>, b: Lanes<N>, f: impl Fn(f32, f32) -> f32) -> Lanes<N> {
    // Loops, not `array::map`: these are spread over vectors more reliably.
    let mut out = a.0;
    for (out, &b) in out.iter_mut().zip(&b.0) {
        *out = f(*out, b);
    }
    Lanes(out)
}

#[inline(always)]
fn zip_ints<const N: usize>(a: [i32; N], b: [i32; N], f: impl Fn(i32, i32) -> i32) -> [i32; N] {
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
unsafe impl<const N: usize> Vector for Lanes<N> {
    const LANES: usize = N;
    const TILE_ROWS: usize = 4;
    // Sixteen lanes are laid out as those of AVX-512 are.
    const TILE_VECTORS: usize = if N < 16 { 1 } else { 3 };
    type Ints = [i32; N];
    const MAX_BYTE: u8 = 255;

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        Self([x; N])
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller gives `N` elements.
        Self(unsafe { from.cast::<[f32; N]>().read_unaligned() })
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller gives `N` elements.
        unsafe { to.cast::<[f32; N]>().write_unaligned(self.0) }
    }

    #[inline(always)]
    unsafe fn load_partial(from: *const f32, n: usize) -> Self {
        let mut out = [0.0; N];
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
    unsafe fn low_bits_as_exponent(self) -> Self {
        Self(self.0.map(|x| f32::from_bits(x.to_bits() << 23)))
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
        let mut sums = self.0;
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
    unsafe fn reduce_max(self) -> f32 {
        self.0
            .into_iter()
            .fold(f32::NEG_INFINITY, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    unsafe fn low_halves(pairs: [i32; N]) -> Self {
        Self(pairs.map(|pair| f32::from_bits((pair as u32) << 16)))
    }

    #[inline(always)]
    unsafe fn high_halves(pairs: [i32; N]) -> Self {
        Self(pairs.map(|pair| f32::from_bits(pair as u32 & 0xffff_0000)))
    }

    #[inline(always)]
    unsafe fn round_to_bf16(self) -> Self {
        Self(self.0.map(|x| bf16::from_f32(x).to_f32()))
    }

    #[inline(always)]
    unsafe fn store_bf16(self, to: *mut u16) {
        // SAFETY: the caller gives room for `N` elements.
        unsafe {
            to.cast::<[u16; N]>()
                .write_unaligned(self.0.map(|x| bf16::from_f32(x).to_bits()))
        }
    }

    #[inline(always)]
    unsafe fn store_bytes(self, zero: [i32; N], most: [i32; N], to: *mut u8) {
        let whole = self.0.map(|x| ((x + ROUND) - ROUND) as i32);
        let bytes = zip_ints(zip_ints(whole, zero, i32::wrapping_add), most, i32::min);
        // SAFETY: the caller gives room for `N` elements.
        unsafe { to.cast::<[u8; N]>().write_unaligned(bytes.map(|byte| byte as u8)) }
    }

    #[inline(always)]
    unsafe fn splat_int(x: i32) -> [i32; N] {
        [x; N]
    }

    #[inline(always)]
    unsafe fn load_ints(from: *const i32) -> [i32; N] {
        // SAFETY: the caller gives `N` elements.
        unsafe { from.cast::<[i32; N]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn store_ints(integers: [i32; N], to: *mut i32) {
        // SAFETY: the caller gives `N` elements.
        unsafe { to.cast::<[i32; N]>().write_unaligned(integers) }
    }

    #[inline(always)]
    unsafe fn add_ints(a: [i32; N], b: [i32; N]) -> [i32; N] {
        zip_ints(a, b, i32::wrapping_add)
    }

    #[inline(always)]
    unsafe fn sub_ints(a: [i32; N], b: [i32; N]) -> [i32; N] {
        zip_ints(a, b, i32::wrapping_sub)
    }

    #[inline(always)]
    unsafe fn mul_ints(a: [i32; N], b: [i32; N]) -> [i32; N] {
        zip_ints(a, b, i32::wrapping_mul)
    }

    #[inline(always)]
    unsafe fn from_ints(integers: [i32; N]) -> Self {
        Self(integers.map(|integer| integer as f32))
    }

    #[inline(always)]
    unsafe fn dot_bytes(sum: [i32; N], x: [i32; N], w: [i32; N]) -> [i32; N] {
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
