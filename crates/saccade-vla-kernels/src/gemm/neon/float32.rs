//! Products in float32, by lane, of rows with float32 weights or bfloat16 ones, which are widened once for all tiles of a block.

use std::arch::aarch64::*;
use std::ops::Range;

use super::by_lane::{self, ByLane, VECTORS};
use super::chains::{self, Chains};
use super::tile::{COLUMNS, SUM_PART, Step, multiply, panel_words, shape};
use crate::gemm::broadcast::Rounding;
use crate::gemm::{Block, Gemm, PanelMut, Shape, Source, odd_lines, panel};
use crate::simd::aarch64::neon::Neon;
use crate::simd::{Kernel, Simd};
use crate::weights::WeightRef;

/// float32 rows by float32 weights.
pub(crate) struct Float32(Neon);

/// float32 rows by bfloat16 weights.
pub(crate) struct WidenedBf16(Neon);

/// Rows rounded to bfloat16 by bfloat16 weights, for a CPU without an instruction for that: rows stay float32, which saves widening them.
pub(crate) struct RoundedBf16(WidenedBf16);

// SAFETY: the value holds the proof of its instruction set; `multiply` keeps to the block.
unsafe impl Gemm for Float32 {
    fn new() -> Option<Self> {
        Neon::new().map(Self)
    }

    fn shape(&self) -> Shape {
        shape::<Neon, FloatStep>()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        panel_words::<Neon, FloatStep>(in_features)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        panel::pack_f32(weight, first, COLUMNS, panel.words);
    }

    fn converted_stride(&self, _: usize) -> Option<usize> {
        None
    }

    unsafe fn convert(&self, _: &Source, _: Range<usize>) {
        unreachable!("rows are read where they are")
    }

    unsafe fn multiply(&self, block: &Block<'_>) {
        self.0.run(FloatRun(block));
    }

    fn chains(&self) -> usize {
        self.0.run(Chains::<Fmla>::new())
    }
}

// SAFETY: as above.
unsafe impl Gemm for WidenedBf16 {
    fn new() -> Option<Self> {
        Neon::new().map(Self)
    }

    fn shape(&self) -> Shape {
        shape::<Neon, WideningStep>()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        panel_words::<Neon, WideningStep>(in_features)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        panel::pack_bf16(weight, first, COLUMNS, panel.words);
    }

    fn converted_stride(&self, _: usize) -> Option<usize> {
        None
    }

    unsafe fn convert(&self, _: &Source, _: Range<usize>) {
        unreachable!("rows are read where they are")
    }

    unsafe fn multiply(&self, block: &Block<'_>) {
        self.0.run(WideningRun(block));
    }

    fn chains(&self) -> usize {
        // Once widened, a product is one of float32.
        self.0.run(Chains::<Fmla>::new())
    }
}

// SAFETY: as above; `convert` keeps to its rows.
unsafe impl Gemm for RoundedBf16 {
    fn new() -> Option<Self> {
        WidenedBf16::new().map(Self)
    }

    fn shape(&self) -> Shape {
        self.0.shape()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        self.0.panel_words(in_features)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        self.0.pack(weight, first, panel);
    }

    fn converted_stride(&self, in_features: usize) -> Option<usize> {
        Some(odd_lines(in_features, 1))
    }

    unsafe fn convert(&self, source: &Source, rows: Range<usize>) {
        let stride = odd_lines(source.in_features, 1);
        self.0.0.run(Rounding { source, rows, stride });
    }

    unsafe fn multiply(&self, block: &Block<'_>) {
        // SAFETY: the caller's promise.
        unsafe { self.0.multiply(block) }
    }

    fn chains(&self) -> usize {
        self.0.chains()
    }
}

/// The sums of a block.
struct FloatRun<'a>(&'a Block<'a>);

impl Kernel for FloatRun<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the contract of `Gemm::multiply`.
        unsafe { multiply::<S, FloatStep, VECTORS>(self.0) }
    }
}

/// The same of weights to widen.
struct WideningRun<'a>(&'a Block<'a>);

impl Kernel for WideningRun<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the contract of `Gemm::multiply`.
        unsafe { multiply::<S, WideningStep, VECTORS>(self.0) }
    }
}

/// `fmla` by lane.
struct Fmla;

impl ByLane for Fmla {
    type Sum = float32x4_t;

    #[inline(always)]
    unsafe fn multiply_add<const LANE: i32>(
        sum: float32x4_t,
        weights: uint32x4_t,
        x: uint32x4_t,
    ) -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { vfmaq_laneq_f32::<LANE>(sum, vreinterpretq_f32_u32(weights), vreinterpretq_f32_u32(x)) }
    }
}

impl chains::Link for Fmla {
    type Sum = float32x4_t;
    const MACS: usize = 4;

    #[inline(always)]
    unsafe fn start() -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { vdupq_n_f32(0.0) }
    }

    #[inline(always)]
    unsafe fn next(sum: float32x4_t, a: uint32x4_t, b: uint32x4_t) -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { <Self as ByLane>::multiply_add::<0>(sum, a, b) }
    }
}

/// What both steps have in common.
macro_rules! float_step {
    () => {
        const DEPTH: usize = 4;
        const ROW_GROUP: usize = 1;
        const GROUPS: usize = 7;
        const PART_STEPS: usize = SUM_PART / 4;
        const IN_PLACE: bool = true;
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
        unsafe fn load(from: *const u32, v: usize, _: usize) -> float32x4_t {
            // SAFETY: as above.
            unsafe { vld1q_f32(from.add(v * 4).cast()) }
        }

        #[inline(always)]
        unsafe fn store(sum: float32x4_t, to: *mut u32, v: usize, _: usize) {
            // SAFETY: as above.
            unsafe { vst1q_f32(to.add(v * 4).cast(), sum) }
        }

        #[inline(always)]
        unsafe fn multiply_add<const NV: usize, const MR: usize>(
            sums: &mut [[float32x4_t; NV]; MR],
            x: &[*const u32; MR],
            beyond: usize,
            weights: *const u32,
        ) {
            // SAFETY: the caller's promise.
            unsafe { by_lane::multiply_add::<Fmla, NV, MR>(sums, x, beyond, weights) }
        }
    };
}

struct FloatStep;

impl<S: Simd> Step<S> for FloatStep {
    const PANEL_WORDS: usize = 4 * COLUMNS;
    float_step!();
}

struct WideningStep;

impl<S: Simd> Step<S> for WideningStep {
    const PANEL_WORDS: usize = 2 * COLUMNS;
    const STEP_WORDS: usize = 4 * COLUMNS;
    float_step!();

    /// Widening in the tiles would take an eighth of the time that their multiply-adds take.
    #[inline(always)]
    unsafe fn widened(panel: *const u32, steps: usize, memory: *mut u32) -> *const u32 {
        // SAFETY: the caller's promise.
        unsafe {
            for pairs in 0..2 * steps {
                for v in 0..VECTORS {
                    let words = vld1q_u32(panel.add(pairs * COLUMNS + v * 4));
                    let to = memory.add(2 * pairs * COLUMNS + v * 4);
                    vst1q_u32(to, vshlq_n_u32::<16>(words));
                    vst1q_u32(to.add(COLUMNS), vandq_u32(words, vdupq_n_u32(0xffff_0000)));
                }
            }
        }
        memory
    }
}
