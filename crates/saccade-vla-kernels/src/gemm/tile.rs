//! A block of rows through one panel, tile by tile: the loops that the products of vectors share.
//!
//! A panel is `k`-major: `[k / STEP][column]`, words of `STEP` consecutive `k`, so that one step over `k` reads a few whole vectors. A row is
//! read where it is, one broadcast word a step. A tile of rows by panel columns stays in registers while a part of the summed dimension is
//! walked from front to back; parts are cut at fixed places and added in order.

use std::hint::black_box;
use std::ops::Range;

use super::streams::{Lines, Parts};
use super::{Block, Shape};
use crate::simd::{LINE, Simd, Vector};

/// One running float32 sum over the 8192 inputs of a feed-forward loses five times as much as parts of 512 do (measured on the full head).
pub(super) const SUM_PART: usize = 512;

/// Steps over the summed dimension after which the next tile takes the same part of the panel, which is then still in the cache: whole
/// parts. Each begins the rows' streams again; with two parts of float32, together with huge pages for the weights, AVX2 went from 0.85
/// to 0.89 of the FMA peak at 49 x 1536 x 6144 on Zen 4, AVX-512 from 0.94 to 0.95 (with one step a turn).
const BLOCK_STEPS: usize = 1024;

/// One step over `k`: vectors of words of the panel, each of which holds [`Self::STEP`] consecutive `k` of its column, and as many `k` of
/// each row.
pub(super) trait Step<S: Simd> {
    /// Consecutive `k` in a word of the panel.
    const STEP: usize;
    /// Steps that are summed from zero, at multiples of which the summed dimension is cut; their sums are added to those of the parts before.
    const PART_STEPS: usize;
    /// Rows of the largest tile.
    const TILE_ROWS: usize;
    /// Steps of a turn of the innermost loop. What counts steps and finds rows takes ports from the products on Intel: with one step a turn,
    /// 0.87 of the rate of the whole head with AVX2 in float32 and bfloat16 (Intel with AMX, two threads). Eight gain no more. Not
    /// measured alone on AMD.
    const UNROLLED: usize = 4;
    /// A vector of sums.
    type Sum: Copy;

    /// # Safety
    /// Here and below: called within [`Simd::run`] of `S`.
    unsafe fn zero() -> Self::Sum;

    /// # Safety
    /// `from` points to a vector of words.
    unsafe fn load(from: *const u32) -> Self::Sum;

    /// # Safety
    /// `to` points to a vector of words.
    unsafe fn store(sum: Self::Sum, to: *mut u32);

    /// # Safety
    /// As [`Self::zero`].
    unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum;

    /// `sums += x W` over step number `step`, of which the first `count` of [`Self::STEP`] elements are there.
    ///
    /// # Safety
    /// `weights` points to `NV` vectors of words, each of `x` to a row in which the step's first `count` elements can be read.
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[Self::Sum; NV]; MR],
        x: &[*const u32; MR],
        weights: *const u32,
        step: usize,
        count: usize,
    );
}

/// What steps that sum in float32 have in common.
macro_rules! float_sums {
    ($vector:ty) => {
        type Sum = $vector;

        #[inline(always)]
        unsafe fn zero() -> $vector {
            // SAFETY: the caller's promise; so throughout.
            unsafe { <$vector>::splat(0.0) }
        }

        #[inline(always)]
        unsafe fn load(from: *const u32) -> $vector {
            // SAFETY: the caller gives a vector of words.
            unsafe { <$vector>::load(from.cast()) }
        }

        #[inline(always)]
        unsafe fn store(sum: $vector, to: *mut u32) {
            // SAFETY: the caller gives a vector of words.
            unsafe { sum.store(to.cast()) }
        }

        #[inline(always)]
        unsafe fn add(a: $vector, b: $vector) -> $vector {
            // SAFETY: the caller's promise.
            unsafe { a.add(b) }
        }
    };
}
pub(super) use float_sums;

/// The sizes of a product with these steps: a panel as wide as the largest tile, rows one by one.
pub(super) fn shape<S: Simd, P: Step<S>>() -> Shape {
    Shape {
        columns: S::Vector::TILE_VECTORS * S::Vector::LANES,
        tile_rows: P::TILE_ROWS,
        row_group: 1,
        rows_beyond: 0,
    }
}

/// What [`Gemm::multiply`](super::Gemm::multiply) does, as a part of a kernel.
///
/// # Safety
/// As there, with panels of `TILE_VECTORS` vectors of words of `P::STEP` elements; called within [`Simd::run`] of `S`.
#[inline(always)]
pub(super) unsafe fn multiply<S: Simd, P: Step<S>>(block: &Block<'_>) {
    const { assert!(S::Vector::TILE_VECTORS <= 3) }
    // 128 outputs are 8 vectors of AVX-512, not the 9 of three whole panels: a head of width 128 took 0.93 of the time on one thread of a Zen 4.
    let used = block.needed.div_ceil(S::Vector::LANES);
    // SAFETY: the caller's promise.
    unsafe {
        match (S::Vector::TILE_VECTORS, used) {
            (1, _) => panel_rows::<S, S::Vector, P, 1, 1>(block),
            (2, 1) => panel_rows::<S, S::Vector, P, 2, 1>(block),
            (2, _) => panel_rows::<S, S::Vector, P, 2, 2>(block),
            (3, 1) => panel_rows::<S, S::Vector, P, 3, 1>(block),
            (3, 2) => panel_rows::<S, S::Vector, P, 3, 2>(block),
            (3, _) => panel_rows::<S, S::Vector, P, 3, 3>(block),
            (vectors, _) => unreachable!("a tile of {vectors} vectors"),
        }
    }
    (block.finish)(block.rows());
}

/// The first `UV` vectors of a panel of `NV`.
///
/// # Safety
/// As [`multiply`].
#[inline(always)]
unsafe fn panel_rows<S: Simd<Vector = V>, V: Vector, P: Step<S>, const NV: usize, const UV: usize>(
    block: &Block<'_>,
) {
    const { assert!(1 <= UV && UV <= NV) }
    let tiles = &block.range;
    let first_row = block.rows().start;
    let steps = block.in_features.div_ceil(P::STEP);
    let step_words = NV * V::LANES;
    // Streams must not change where sums are cut; integers are not cut.
    const { assert!(P::PART_STEPS > BLOCK_STEPS || (BLOCK_STEPS / 2).is_multiple_of(P::PART_STEPS)) }
    // As streams, a part is asked for while the one before it is multiplied. One of 1024 steps after one of 512 would take twice the pace:
    // parts of 512 made 1536 steps 1.04 to 1.08 times as fast (AVX-512, float32, Intel with AMX), and no difference where 1024 divides them.
    // Families of AMD ask in order.
    let is_uneven = steps > BLOCK_STEPS && !steps.is_multiple_of(BLOCK_STEPS);
    let part_steps = if is_uneven && block.asks_as_streams(step_words) {
        BLOCK_STEPS / 2
    } else {
        BLOCK_STEPS
    };
    let parts = Parts::new(block, step_words, steps, part_steps);
    for part in parts.iter() {
        for number in tiles.clone() {
            let (first, end) = (block.tiles.first_row(number), block.tiles.first_row(number + 1));
            // SAFETY: the caller's promise; the tile is within the rows, and its sums within the block's.
            unsafe {
                let tile = RowTile {
                    row: first,
                    sums: block.sums.add((first - first_row) * NV * V::LANES),
                    ahead: parts.lines(&part, number - tiles.start),
                    is_one_of_few: tiles.len() < NV,
                };
                match end - first {
                    1 => tile_part::<S, V, P, NV, UV, 1>(block, &part, &tile),
                    2 if P::TILE_ROWS >= 2 => tile_part::<S, V, P, NV, UV, 2>(block, &part, &tile),
                    3 if P::TILE_ROWS >= 3 => tile_part::<S, V, P, NV, UV, 3>(block, &part, &tile),
                    4 if P::TILE_ROWS >= 4 => tile_part::<S, V, P, NV, UV, 4>(block, &part, &tile),
                    5 if P::TILE_ROWS >= 5 => tile_part::<S, V, P, NV, UV, 5>(block, &part, &tile),
                    6 if P::TILE_ROWS >= 6 => tile_part::<S, V, P, NV, UV, 6>(block, &part, &tile),
                    7 if P::TILE_ROWS >= 7 => tile_part::<S, V, P, NV, UV, 7>(block, &part, &tile),
                    8 if P::TILE_ROWS >= 8 => tile_part::<S, V, P, NV, UV, 8>(block, &part, &tile),
                    rows => unreachable!("a tile of {rows} rows"),
                }
            }
        }
    }
}

/// A tile: its first row, where its sums go, and what it asks memory for.
struct RowTile {
    row: usize,
    sums: *mut u32,
    ahead: Lines,
    /// Of fewer tiles than a step has cache lines: each asks for several.
    is_one_of_few: bool,
}

/// `MR` rows by `UV` vectors of `NV` over one part of `k`.
///
/// # Safety
/// As [`panel_rows`]; the block has rows `tile.row .. tile.row + MR`, and `tile.sums` room for them.
#[inline(always)]
unsafe fn tile_part<
    S: Simd<Vector = V>,
    V: Vector,
    P: Step<S>,
    const NV: usize,
    const UV: usize,
    const MR: usize,
>(
    block: &Block<'_>,
    part: &Range<usize>,
    tile: &RowTile,
) {
    // SAFETY: the caller's promise for all pointers below; prefetching is allowed at any address.
    unsafe {
        let row_elements = NV * V::LANES;
        let mut x = [block.x; MR];
        for (r, x) in x.iter_mut().enumerate() {
            // Hidden: compilers compute each row from the one before it again in every step. Not measured on AMD.
            *x = black_box(block.x.offset((tile.row + r) as isize * block.x_stride));
        }
        let weights = block.weights.as_ptr();
        if part.start == 0 {
            // The rows of `out` are written after the tiles: by then they are here.
            for r in 0..MR {
                let out = block
                    .out
                    .wrapping_offset((tile.row + r) as isize * block.out_stride);
                for v in 0..UV {
                    V::prefetch(out.wrapping_add(v * V::LANES).cast());
                }
            }
        }
        let mut first = part.start;
        loop {
            let end = part.end.min(first + P::PART_STEPS);
            let mut acc = [[P::zero(); UV]; MR];
            // Rows that are not converted may end within the last step.
            let whole = end.min(block.in_features / P::STEP);
            // Few rows leave little time: a step's share is then longer than a cache line. The loops are apart because one register more
            // for the general case makes the common one spill.
            let mut step = first;
            while step < whole {
                // Memory works while the sums are made. Measured at 49 x 1536 x 6144 on Zen 4, in order, share of the FMA peak without and
                // with it, with one step a turn: 0.89 and 0.95 (AVX-512), 0.69 and 0.85 (AVX2).
                let (mut next, steps) = tile.ahead.at(step - part.start);
                // Hidden: compilers find the smaller of the two again in each step.
                let round = step..black_box(whole.min(step + steps));
                step = round.end;
                if tile.is_one_of_few {
                    for step in round {
                        for line in 0..NV {
                            V::prefetch(next.wrapping_add(line * LINE).cast());
                        }
                        next = next.wrapping_add(tile.ahead.pitch);
                        P::multiply_add(&mut acc, &x, weights.add(step * row_elements), step, P::STEP);
                    }
                } else {
                    let Range { mut start, end } = round;
                    let mut words = weights.add(start * row_elements);
                    while start + P::UNROLLED <= end {
                        for index in 0..P::UNROLLED {
                            V::prefetch(next.cast());
                            next = next.wrapping_add(tile.ahead.pitch);
                            let words = words.add(index * row_elements);
                            P::multiply_add(&mut acc, &x, words, start + index, P::STEP);
                        }
                        words = words.add(P::UNROLLED * row_elements);
                        start += P::UNROLLED;
                    }
                    for step in start..end {
                        V::prefetch(next.cast());
                        next = next.wrapping_add(tile.ahead.pitch);
                        P::multiply_add(&mut acc, &x, weights.add(step * row_elements), step, P::STEP);
                    }
                }
            }
            if whole < end {
                let rest = block.in_features - whole * P::STEP;
                P::multiply_add(&mut acc, &x, weights.add(whole * row_elements), whole, rest);
            }
            if first != 0 {
                for (r, row) in acc.iter_mut().enumerate() {
                    for (v, sum) in row.iter_mut().enumerate() {
                        *sum = P::add(P::load(tile.sums.add((r * NV + v) * V::LANES)), *sum);
                    }
                }
            }
            for (r, row) in acc.iter().enumerate() {
                for (v, sum) in row.iter().enumerate() {
                    P::store(*sum, tile.sums.add((r * NV + v) * V::LANES));
                }
            }
            first = end;
            if first >= part.end {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{PanelMut, Product, Tiles};
    use super::*;
    use crate::isa::Isa;
    use crate::matrix::Matrix;
    use crate::weights::WeightRef;

    /// Otherwise a narrow panel would cost as much as a whole one, and results would not tell.
    #[test]
    fn only_vectors_with_needed_columns_are_computed() {
        const UNTOUCHED: u32 = 0x7fc0_0bad;
        let x = [1.0_f32, 2.0, 3.0, 4.0, 5.0];
        for isa in Isa::available() {
            if cfg!(target_arch = "aarch64") && isa != Isa::Portable {
                continue; // products of another file, which write all sums
            }
            let gemm = isa.gemm(Product::Float32);
            let (shape, lanes) = (gemm.shape(), isa.vectors().lanes);
            let mut words = vec![0; gemm.panel_words(x.len())];
            let weights = [1.0; 5];
            let panel = PanelMut {
                words: &mut words,
                scales: &mut [],
                sums: &mut [],
            };
            gemm.pack(WeightRef::F32(Matrix::new(&weights, x.len())), 0, panel);
            for needed in (lanes..=shape.columns).step_by(lanes) {
                let mut sums = vec![UNTOUCHED; shape.columns];
                let tiles = Tiles::new(1, shape);
                let block = Block {
                    x: x.as_ptr().cast(),
                    x_stride: 0,
                    in_features: x.len(),
                    tiles,
                    range: 0..1,
                    weights: &words,
                    needed,
                    ahead: 0,
                    streams: false,
                    sums: sums.as_mut_ptr(),
                    out: std::ptr::null(),
                    out_stride: 0,
                    finish: &|_| (),
                };
                // SAFETY: the product has packed the panel; the row and its sums are above.
                unsafe { gemm.multiply(&block) };
                assert_eq!(f32::from_bits(sums[0]), 15.0, "{isa}");
                let untouched = sums.iter().map(|&sum| sum == UNTOUCHED);
                assert!(
                    untouched.eq((0..shape.columns).map(|column| column >= needed)),
                    "{isa}, {needed}"
                );
            }
        }
    }
}
