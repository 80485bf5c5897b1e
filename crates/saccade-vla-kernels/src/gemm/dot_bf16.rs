//! Products of bfloat16 in pairs, by an instruction that multiplies and sums both of a pair.

use std::ops::Range;

use super::chains::Bf16Chains;
use super::tile::{SUM_PART, Step, float_sums, multiply, shape};
use super::{Block, Gemm, PanelMut, Shape, Source, odd_lines, panel};
use crate::simd::{Dots, Kernel, Simd, Vector, load};
use crate::weights::WeightRef;

/// Rows and weights in pairs of bfloat16, sums in float32.
pub(crate) struct DotBf16<S>(S);

// SAFETY: the value holds the proof of its instruction set; `convert` and `multiply` keep to their rows and block.
unsafe impl<S: Simd> Gemm for DotBf16<S> {
    fn new() -> Option<Self> {
        S::new().map(Self)
    }

    fn shape(&self) -> Shape {
        shape::<S, PairStep>()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        self.shape().columns * in_features.div_ceil(2)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        panel::pack_bf16(weight, first, self.shape().columns, panel.words);
    }

    fn converted_stride(&self, in_features: usize) -> Option<usize> {
        Some(odd_lines(in_features, 2))
    }

    unsafe fn convert(&self, source: &Source, rows: Range<usize>) {
        let stride = odd_lines(source.in_features, 2);
        self.0.run(Narrowing { source, rows, stride });
    }

    unsafe fn multiply(&self, block: &Block<'_>) {
        self.0.run(PairRun(block));
    }

    fn chains(&self) -> usize {
        self.0.run(Bf16Chains)
    }
}

/// Rows rounded to bfloat16.
pub(super) struct Narrowing<'a> {
    pub source: &'a Source,
    pub rows: Range<usize>,
    /// Words from one converted row to the next.
    pub stride: usize,
}

impl Kernel for Narrowing<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (source, width) = (self.source, self.source.in_features);
        for row in self.rows {
            // SAFETY: the contract of `Gemm::convert`: rows are in the source, and have room in whole vectors.
            unsafe {
                let x = source.x.offset(row as isize * source.x_stride);
                let to = source.words.add(row * self.stride).cast::<u16>();
                for i in (0..width).step_by(S::Vector::LANES) {
                    let x = load::<S::Vector>(x.add(i), S::Vector::LANES.min(width - i));
                    x.store_bf16(to.add(i));
                }
            }
        }
    }
}

/// The sums of a block.
struct PairRun<'a>(&'a Block<'a>);

impl Kernel for PairRun<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the contract of `Gemm::multiply`.
        unsafe { multiply::<S, PairStep>(self.0) }
    }
}

struct PairStep;

impl<S: Simd<Vector = V>, V: Vector> Step<S> for PairStep {
    const STEP: usize = 2;
    const PART_STEPS: usize = SUM_PART / 2;
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
        // SAFETY: the caller's promise.
        unsafe {
            let mut w = [V::splat_int(0); NV];
            for (v, w) in w.iter_mut().enumerate() {
                *w = V::load_ints(weights.add(v * V::LANES).cast());
            }
            for r in 0..MR {
                let x = V::splat_int(*x[r].add(step).cast());
                for v in 0..NV {
                    sums[r][v] = S::Dots::bf16(sums[r][v], x, w[v]);
                }
            }
        }
    }
}
