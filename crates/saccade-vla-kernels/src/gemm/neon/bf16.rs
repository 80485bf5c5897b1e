//! Products of bfloat16 by `bfmmla`, which multiplies two rows by two columns over four `k`.

use std::arch::aarch64::*;
use std::ops::Range;

use super::chains::{Chains, Link};
use super::pairs::{self, Pairwise, VECTORS, place};
use super::tile::{COLUMNS, SUM_PART, Step, multiply, panel_words, shape};
use crate::gemm::{Block, Gemm, PanelMut, Shape, Source, odd_lines, panel};
use crate::simd::aarch64::instructions::{bfcvtn, bfmmla};
use crate::simd::aarch64::neon::NeonBf16;
use crate::simd::{Kernel, Simd, load};
use crate::weights::WeightRef;

/// Rows and weights in fours of bfloat16, sums in float32.
pub(crate) struct Bfmmla(NeonBf16);

// SAFETY: the value holds the proof of its instruction set; `convert` and `multiply` keep to their rows and block.
unsafe impl Gemm for Bfmmla {
    fn new() -> Option<Self> {
        NeonBf16::new().map(Self)
    }

    fn shape(&self) -> Shape {
        shape::<NeonBf16, BfmmlaStep>()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        panel_words::<NeonBf16, BfmmlaStep>(in_features)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        panel::pack_bf16_in_fours(weight, first, COLUMNS, panel.words);
    }

    fn converted_stride(&self, in_features: usize) -> Option<usize> {
        Some(odd_lines(in_features, 2))
    }

    unsafe fn convert(&self, source: &Source, rows: Range<usize>) {
        self.0.run(Narrowing { source, rows });
    }

    unsafe fn multiply(&self, block: &Block<'_>) {
        self.0.run(BfmmlaRun(block));
    }

    fn chains(&self) -> usize {
        self.0.run(Chains::<BfmmlaStep>::new())
    }
}

/// Rows rounded to bfloat16, two of which alternate by four elements.
struct Narrowing<'a> {
    source: &'a Source,
    rows: Range<usize>,
}

impl Kernel for Narrowing<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (source, width) = (self.source, self.source.in_features);
        let stride = odd_lines(width, 2);
        for row in self.rows {
            // SAFETY: the contract of `Gemm::convert`: rows are in the source, and have room in whole pairs and lines; kernels are called
            // within `Simd::run`, here of an instruction set with the conversion.
            unsafe {
                let x = source.x.offset(row as isize * source.x_stride);
                let pair = source.words.add((row & !1) * stride).cast();
                for i in (0..width).step_by(4) {
                    let x = load::<float32x4_t>(x.add(i), 4.min(width - i));
                    vst1_u16(place(pair, row, 2 * i).cast(), bfcvtn(x));
                }
            }
        }
    }
}

/// The sums of a block.
struct BfmmlaRun<'a>(&'a Block<'a>);

impl Kernel for BfmmlaRun<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the contract of `Gemm::multiply`.
        unsafe { multiply::<S, BfmmlaStep, VECTORS>(self.0) }
    }
}

struct BfmmlaStep;

impl Pairwise for BfmmlaStep {
    type Sum = float32x4_t;

    #[inline(always)]
    unsafe fn multiply_add(sum: float32x4_t, rows: uint32x4_t, columns: uint32x4_t) -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { bfmmla(sum, vreinterpretq_u16_u32(rows), vreinterpretq_u16_u32(columns)) }
    }
}

impl Link for BfmmlaStep {
    type Sum = float32x4_t;
    const MACS: usize = 16;

    #[inline(always)]
    unsafe fn start() -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { vdupq_n_f32(0.0) }
    }

    #[inline(always)]
    unsafe fn next(sum: float32x4_t, a: uint32x4_t, b: uint32x4_t) -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { <Self as Pairwise>::multiply_add(sum, a, b) }
    }
}

impl<S: Simd> Step<S> for BfmmlaStep {
    const DEPTH: usize = 4;
    const ROW_GROUP: usize = 2;
    const GROUPS: usize = 4;
    const PANEL_WORDS: usize = 2 * COLUMNS;
    const PART_STEPS: usize = SUM_PART / 4;
    type Sum = float32x4_t;

    #[inline(always)]
    unsafe fn zero() -> float32x4_t {
        // SAFETY: the caller's promise; so throughout.
        unsafe { vdupq_n_f32(0.0) }
    }

    #[inline(always)]
    unsafe fn add(a: float32x4_t, b: float32x4_t) -> float32x4_t {
        // SAFETY: as above.
        unsafe { vaddq_f32(a, b) }
    }

    #[inline(always)]
    unsafe fn load(from: *const u32, v: usize, rows: usize) -> float32x4_t {
        // SAFETY: as above.
        unsafe { vreinterpretq_f32_u32(pairs::load(from, v, rows)) }
    }

    #[inline(always)]
    unsafe fn store(sum: float32x4_t, to: *mut u32, v: usize, rows: usize) {
        // SAFETY: as above.
        unsafe { pairs::store(vreinterpretq_u32_f32(sum), to, v, rows) }
    }

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[float32x4_t; NV]; MR],
        x: &[*const u32; MR],
        beyond: usize,
        weights: *const u32,
    ) {
        // SAFETY: the caller's promise.
        unsafe { pairs::multiply_add::<Self, NV, MR>(sums, x, beyond, weights) }
    }
}
