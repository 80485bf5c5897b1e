//! Products in float32: one broadcast element of a row by vectors of the panel, which are float32, or bfloat16 widened in registers.

use std::ops::Range;

use super::chains::FloatChains;
use super::tile::{SUM_PART, Step, float_sums, multiply, shape};
use super::{Block, Gemm, PanelMut, Shape, Source, odd_lines, panel};
use crate::simd::{Kernel, Simd, Vector, load};
use crate::weights::WeightRef;

/// float32 rows by float32 weights.
pub(crate) struct Plain<S>(S);

/// float32 rows by bfloat16 weights.
pub(crate) struct Widened<S>(S);

/// Rows rounded to bfloat16 by bfloat16 weights, for a CPU without an instruction for that: rows stay float32, which saves widening them.
pub(crate) struct RoundedRows<S>(S);

// SAFETY: the value holds the proof of its instruction set; `multiply` keeps to the block.
unsafe impl<S: Simd> Gemm for Plain<S> {
    fn new() -> Option<Self> {
        S::new().map(Self)
    }

    fn shape(&self) -> Shape {
        shape::<S, FloatStep>()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        self.shape().columns * in_features
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        panel::pack_f32(weight, first, self.shape().columns, panel.words);
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
        self.0.run(FloatChains)
    }
}

// SAFETY: as above.
unsafe impl<S: Simd> Gemm for Widened<S> {
    fn new() -> Option<Self> {
        S::new().map(Self)
    }

    fn shape(&self) -> Shape {
        shape::<S, WideningStep>()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        self.shape().columns * in_features.div_ceil(2)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        panel::pack_bf16(weight, first, self.shape().columns, panel.words);
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
        self.0.run(FloatChains)
    }
}

// SAFETY: as above; `convert` keeps to its rows.
unsafe impl<S: Simd> Gemm for RoundedRows<S> {
    fn new() -> Option<Self> {
        S::new().map(Self)
    }

    fn shape(&self) -> Shape {
        Widened(self.0).shape()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        Widened(self.0).panel_words(in_features)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        Widened(self.0).pack(weight, first, panel);
    }

    fn converted_stride(&self, in_features: usize) -> Option<usize> {
        Some(odd_lines(in_features, 1))
    }

    unsafe fn convert(&self, source: &Source, rows: Range<usize>) {
        let stride = odd_lines(source.in_features, 1);
        self.0.run(Rounding { source, rows, stride });
    }

    unsafe fn multiply(&self, block: &Block<'_>) {
        // SAFETY: the caller's promise.
        unsafe { Widened(self.0).multiply(block) }
    }

    fn chains(&self) -> usize {
        Widened(self.0).chains()
    }
}

/// Rows rounded to what bfloat16 can hold, as float32.
pub(super) struct Rounding<'a> {
    pub source: &'a Source,
    pub rows: Range<usize>,
    pub stride: usize,
}

impl Kernel for Rounding<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (source, width) = (self.source, self.source.in_features);
        for row in self.rows {
            // SAFETY: the contract of `Gemm::convert`: rows are in the source, and have room in whole vectors.
            unsafe {
                let x = source.x.offset(row as isize * source.x_stride);
                let to = source.words.add(row * self.stride).cast::<f32>();
                for i in (0..width).step_by(S::Vector::LANES) {
                    let x = load::<S::Vector>(x.add(i), S::Vector::LANES.min(width - i));
                    x.round_to_bf16().store(to.add(i));
                }
            }
        }
    }
}

/// The sums of a block.
struct FloatRun<'a>(&'a Block<'a>);

impl Kernel for FloatRun<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the contract of `Gemm::multiply`.
        unsafe { multiply::<S, FloatStep>(self.0) }
    }
}

struct FloatStep;

impl<S: Simd<Vector = V>, V: Vector> Step<S> for FloatStep {
    const STEP: usize = 1;
    const PART_STEPS: usize = SUM_PART;
    const TILE_ROWS: usize = V::TILE_ROWS;
    float_sums!(V);

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[V; NV]; MR],
        x: &[*const u32; MR],
        weights: *const u32,
        step: usize,
        _: usize,
    ) {
        // SAFETY: the caller's promise. Loops, not closures: a closure is a function without `V`'s features until it is inlined.
        unsafe {
            let mut w = [V::splat(0.0); NV];
            for (v, w) in w.iter_mut().enumerate() {
                *w = V::load(weights.add(v * V::LANES).cast());
            }
            for r in 0..MR {
                let x = V::splat(*x[r].add(step).cast());
                for v in 0..NV {
                    sums[r][v] = x.fma(w[v], sums[r][v]);
                }
            }
        }
    }
}

/// The sums of a block.
struct WideningRun<'a>(&'a Block<'a>);

impl Kernel for WideningRun<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the contract of `Gemm::multiply`.
        unsafe { multiply::<S, WideningStep>(self.0) }
    }
}

struct WideningStep;

impl<S: Simd<Vector = V>, V: Vector> Step<S> for WideningStep {
    const STEP: usize = 2;
    const PART_STEPS: usize = SUM_PART / 2;
    // Widening takes registers: one row less does not spill. Shares of the FMA peak at 296 x 2048 x 1536 on Zen 4: 8 and 7 rows of AVX-512
    // 0.77 and 0.97, 6 and 5 rows of AVX2 0.70 and 0.88.
    const TILE_ROWS: usize = V::TILE_ROWS - 1;
    float_sums!(V);

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[V; NV]; MR],
        x: &[*const u32; MR],
        weights: *const u32,
        step: usize,
        count: usize,
    ) {
        for part in 0..count {
            // SAFETY: the caller's promise.
            unsafe {
                let mut w = [V::splat(0.0); NV];
                for (v, w) in w.iter_mut().enumerate() {
                    let pairs = V::load_ints(weights.add(v * V::LANES).cast());
                    *w = if part == 0 {
                        V::low_halves(pairs)
                    } else {
                        V::high_halves(pairs)
                    };
                }
                for r in 0..MR {
                    let x = V::splat(*x[r].add(2 * step + part).cast());
                    for v in 0..NV {
                        sums[r][v] = x.fma(w[v], sums[r][v]);
                    }
                }
            }
        }
    }
}
