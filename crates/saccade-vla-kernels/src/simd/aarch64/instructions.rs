//! Instructions that stable Rust has no intrinsics for. Each is inlined into a function that turns its
//! feature on.

use std::arch::aarch64::{float32x4_t, int8x16_t, int32x4_t, uint8x16_t, uint16x4_t, uint16x8_t};
use std::arch::asm;

/// Defines functions of one instruction each, `sum` in and out.
macro_rules! sums {
    ($($(#[$doc:meta])* $name:ident($sum:ty, $a:ty, $b:ty) = $template:literal;)+) => {$(
        $(#[$doc])*
        ///
        /// # Safety
        /// The CPU has the instruction.
        #[inline(always)]
        pub(crate) unsafe fn $name(mut sum: $sum, a: $a, b: $b) -> $sum {
            // SAFETY: the caller's CPU has the instruction, which reads and writes registers alone.
            unsafe {
                asm!(
                    $template,
                    inout(vreg) sum,
                    in(vreg) a,
                    in(vreg) b,
                    options(pure, nomem, nostack, preserves_flags)
                );
            }
            sum
        }
    )+};
}

sums! {
    /// `i8mm`: adds the products of the two rows of eight unsigned bytes in `a` and the two of eight signed
    /// bytes in `b`: `sum[2 i + j] += a[i] . b[j]`.
    usmmla(int32x4_t, uint8x16_t, int8x16_t) = "usmmla {0:v}.4s, {1:v}.16b, {2:v}.16b";
    /// `bf16`: adds the products of the two rows of four bfloat16 in `a` and the two in `b`:
    /// `sum[2 i + j] += a[i] . b[j]`. Sums of two products are added one after the other, rounded to odd,
    /// denormals taken for zero.
    bfmmla(float32x4_t, uint16x8_t, uint16x8_t) = "bfmmla {0:v}.4s, {1:v}.8h, {2:v}.8h";
    /// `bf16`: adds to each lane the products of the two bfloat16 in it, rounded likewise.
    bfdot(float32x4_t, uint16x8_t, uint16x8_t) = "bfdot {0:v}.4s, {1:v}.8h, {2:v}.8h";
}

/// The same of instructions that take four bytes of `b` from lane `LANE`.
macro_rules! sums_by_lane {
    ($($(#[$doc:meta])* $name:ident($sum:ty, $a:ty, $b:ty) = $template:literal;)+) => {$(
        $(#[$doc])*
        ///
        /// # Safety
        /// The CPU has the instruction.
        #[inline(always)]
        pub(crate) unsafe fn $name<const LANE: i32>(mut sum: $sum, a: $a, b: $b) -> $sum {
            // SAFETY: the caller's CPU has the instruction, which reads and writes registers alone.
            unsafe {
                asm!(
                    $template,
                    inout(vreg) sum,
                    in(vreg) a,
                    in(vreg) b,
                    const LANE,
                    options(pure, nomem, nostack, preserves_flags)
                );
            }
            sum
        }
    )+};
}

sums_by_lane! {
    /// `dotprod`: adds to each lane the four products of its signed bytes in `a` and those in lane `LANE` of
    /// `b`.
    sdot_lane(int32x4_t, int8x16_t, int8x16_t) = "sdot {0:v}.4s, {1:v}.16b, {2:v}.4b[{3}]";
    /// `bf16`: adds to each lane the products of its two bfloat16 in `a` and those in lane `LANE` of `b`,
    /// rounded as by [`bfdot`].
    bfdot_lane(float32x4_t, uint16x8_t, uint16x8_t) = "bfdot {0:v}.4s, {1:v}.8h, {2:v}.2h[{3}]";
}

/// `bf16`: rounded to bfloat16, to nearest and ties to even; NaN becomes quiet.
///
/// # Safety
/// The CPU has the instruction.
#[inline(always)]
pub(crate) unsafe fn bfcvtn(x: float32x4_t) -> uint16x4_t {
    let out;
    // SAFETY: the caller's CPU has the instruction, which reads and writes registers alone.
    unsafe {
        asm!(
            "bfcvtn {0:v}.4h, {1:v}.4s",
            lateout(vreg) out,
            in(vreg) x,
            options(pure, nomem, nostack, preserves_flags)
        );
    }
    out
}

/// Asks for the cache line at `at` in the second-level cache. A hint: any address is allowed.
#[inline(always)]
pub(crate) fn prefetch(at: *const u8) {
    // SAFETY: prefetching never faults, whatever the address. It is a number here: nothing is read or written
    // through it.
    unsafe { asm!("prfm pldl2keep, [{0}]", in(reg) at.addr(), options(nomem, nostack, preserves_flags)) }
}
