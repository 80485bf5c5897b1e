//! The micro-kernel that broadcasts: a word of each row meets vectors of the panel. For all instruction sets
//! but ARM's.
//!
//! A panel is `k`-major: `[k / DEPTH][column]`, words of `DEPTH` consecutive `k`, so that one step over `k`
//! reads a few whole vectors. A row is read where it is, one broadcast word a step. The sums of a tile of
//! rows by panel columns stay in registers while a part of the summed dimension is walked from front to back;
//! parts are cut at fixed places and added in order.

use std::hint::black_box;
use std::mem::MaybeUninit;
use std::ops::Range;

#[cfg(feature = "peak")]
use super::elements::F32;
use super::elements::{SumVector, Sums};
use super::nibbles::Unpack;
use super::prefetch::{Lines, Parts};
use super::step::{MicroKernel, RunsOn, Step};
use super::{Block, MAX_NR, Shape};
#[cfg(feature = "peak")]
use crate::simd::MAX_LANES;
use crate::simd::bits::cast;
use crate::simd::{LINE, Simd};

/// The micro-kernel.
pub(crate) struct Broadcast;

// SAFETY: steps of this micro-kernel use operations of the token alone.
unsafe impl<S: Simd, E: Step<Broadcast>> RunsOn<S, Broadcast> for E {}

/// Steps over the summed dimension after which the next tile takes the same part of the panel, which is then
/// still in the cache: whole parts. Each begins the rows' streams again; with two parts of float32, together
/// with huge pages for the weights, AVX2 went from 0.85 to 0.89 of the FMA peak at 49 x 1536 x 6144 on Zen 4,
/// AVX-512 from 0.94 to 0.95 (with one step a turn).
const BLOCK_STEPS: usize = 1024;

/// Steps whose weights are unpacked together, an even number that parts are multiples of: 24 kB of bytes in the widest
/// vectors, which the nearest cache holds until all tiles of the block have taken them.
const UNPACKED_STEPS: usize = 128;

const _: () = assert!(UNPACKED_STEPS.is_multiple_of(2) && (BLOCK_STEPS / 2).is_multiple_of(UNPACKED_STEPS));

/// Where they are unpacked.
#[repr(align(64))]
struct Unpacked([MaybeUninit<u32>; UNPACKED_STEPS * MAX_NR]);

// SAFETY: all rows of the block and all vectors of needed columns are written.
unsafe impl MicroKernel for Broadcast {
    /// A panel as wide as the largest tile, rows one by one.
    fn shape<S: Simd, E: Step<Self>>() -> Shape {
        Shape {
            nr: S::TILE_VECTORS * S::LANES,
            mr: mr::<S, E>(),
            row_group: 1,
        }
    }

    #[inline(always)]
    unsafe fn multiply<S: Simd, E: Step<Self>>(
        simd: S,
        block: &Block<'_>,
        has_nibbles: bool,
        sums: &mut [MaybeUninit<u32>],
    ) {
        const { assert!(S::TILE_VECTORS <= 3) }
        // 128 outputs are 8 vectors of AVX-512, not the 9 of three whole panels: a head of width 128 took
        // 0.93 of the time on one thread of a Zen 4.
        let used = block.needed.div_ceil(S::LANES);
        let sums = sums.as_mut_ptr().cast();
        // SAFETY: the contract of this function, and `sums` has room for the rows of the block.
        unsafe {
            match (S::TILE_VECTORS, used) {
                (1, _) => panel_rows::<S, E, 1, 1>(simd, block, has_nibbles, sums),
                (2, 1) => panel_rows::<S, E, 2, 1>(simd, block, has_nibbles, sums),
                (2, _) => panel_rows::<S, E, 2, 2>(simd, block, has_nibbles, sums),
                (3, 1) => panel_rows::<S, E, 3, 1>(simd, block, has_nibbles, sums),
                (3, 2) => panel_rows::<S, E, 3, 2>(simd, block, has_nibbles, sums),
                (3, _) => panel_rows::<S, E, 3, 3>(simd, block, has_nibbles, sums),
                (vectors, _) => unreachable!("a tile of {vectors} vectors"),
            }
        }
    }

    #[cfg(feature = "peak")]
    #[inline(always)]
    unsafe fn multiply_for_peak<S: Simd, E: Step<Self>>(simd: S) -> usize {
        // SAFETY: the contract of this function.
        unsafe {
            match (S::TILE_VECTORS, E::IS_WIDENED) {
                // Once widened, a product is one of float32.
                (1, true) => peak::<S, F32, 1, 4>(simd),
                (1, false) => peak::<S, E, 1, 4>(simd),
                (2, true) => peak::<S, F32, 2, 6>(simd),
                (2, false) => peak::<S, E, 2, 6>(simd),
                (_, true) => peak::<S, F32, 3, 4>(simd),
                (_, false) => peak::<S, E, 3, 4>(simd),
            }
        }
    }
}

/// A step of `MR` rows by `NV` vectors, again and again. Their sums, twelve where registers have room for
/// them, hide the latency of the multiply-adds; rows and weights are in the nearest cache.
///
/// # Safety
/// As [`MicroKernel::multiply_for_peak`].
#[cfg(feature = "peak")]
#[inline(always)]
unsafe fn peak<S: Simd, E: Step<Broadcast>, const NV: usize, const MR: usize>(simd: S) -> usize {
    const STEPS: usize = 1 << 20;
    // Between 0.5 and 1 in float32 and bfloat16, positive in int8.
    let (x, weights) = ([0x3f3f_3f3f_u32; 6], [0x3f3f_3f3f_u32; 3 * MAX_LANES]);
    let mut sums = [[E::Sums::zero(simd); NV]; MR];
    for _ in 0..STEPS {
        // Hidden, because products that do not change would be computed once.
        let (x, weights) = (black_box(x.as_ptr()), black_box(weights.as_ptr()));
        let rows = std::array::from_fn(|row| x.wrapping_add(row));
        // SAFETY: there is a word for each of up to six rows, and a vector of weights for each of up to three
        // sums.
        unsafe { E::multiply_add::<S, NV, MR>(simd, &mut sums, &rows, 0, weights, 1) };
    }
    // A copy's address is taken: what `black_box` may see is kept in memory, and every step would store the sums
    // (23 instead of 59 GMAC/s in float32, one thread of a Zen 4).
    let made = sums;
    black_box(&made);
    STEPS * MR * NV * S::LANES * E::DEPTH
}

/// The first `UV` vectors of a panel of `NV`.
///
/// # Safety
/// As [`MicroKernel::multiply`]; `sums` has room for the rows of the block.
#[inline(always)]
unsafe fn panel_rows<S: Simd, E: Step<Broadcast>, const NV: usize, const UV: usize>(
    simd: S,
    block: &Block<'_>,
    has_nibbles: bool,
    sums: *mut u32,
) {
    const { assert!(1 <= UV && UV <= NV) }
    let first_row = block.rows().start;
    let steps = block.in_features.div_ceil(E::DEPTH);
    let has_nibbles = E::ARE_BYTES && has_nibbles;
    // Words that a step multiplies, and those of the panel that they are unpacked from.
    let step_words = NV * S::LANES;
    let halves = if has_nibbles { 2 } else { 1 };
    let panel_step = step_words / halves;
    // Streams must not change where sums are cut; integers are not cut.
    const {
        let part = E::Sums::PART / E::DEPTH;
        assert!(part > BLOCK_STEPS || (BLOCK_STEPS / 2).is_multiple_of(part));
    }
    // As streams, a part is prefetched while the one before it is multiplied. One of 1024 steps after one of
    // 512 would take twice the pace: parts of 512 made 1536 steps 1.04 to 1.08 times as fast (AVX-512,
    // float32, Intel with AMX), and no difference where 1024 divides them. Families of AMD prefetch in order.
    let block_steps = BLOCK_STEPS * halves;
    let is_uneven = steps > block_steps && !steps.is_multiple_of(block_steps);
    let part_steps = if is_uneven && block.prefetches_streams(panel_step) {
        block_steps / 2
    } else {
        block_steps
    };
    let parts = Parts::new(block, panel_step, steps, part_steps);
    let mut unpacked = Unpacked([const { MaybeUninit::uninit() }; UNPACKED_STEPS * MAX_NR]);
    let together = if has_nibbles { UNPACKED_STEPS } else { part_steps };
    // One that is empty as well: its sums are zero.
    for index in 0..steps.div_ceil(together).max(1) {
        let range = index * together..steps.min((index + 1) * together);
        let part = parts.part_of(range.start);
        let weights = if has_nibbles {
            // Two steps are one of the panel, the last one perhaps with the second empty.
            let panel = &block.weights[range.start / 2 * step_words..range.end.div_ceil(2) * step_words];
            simd.run(&mut Unpack {
                panel,
                row: step_words,
                to: &mut unpacked.0,
            });
            unpacked.0.as_ptr().cast()
        } else {
            block.weights[range.start * step_words..range.end * step_words].as_ptr()
        };
        for call in block.calls.clone() {
            let Range { start: row, end } = block.split.rows(&(call..call + 1));
            // SAFETY: the rows are in the block, their sums within the block's, and the weights are those of
            // the range.
            unsafe {
                let tile = Tile {
                    row,
                    weights,
                    sums: sums.add((row - first_row) * NV * S::LANES),
                    ahead: parts.lines(&part, call - block.calls.start),
                    ahead_from: part.start,
                    is_one_of_few: block.calls.len() < NV,
                };
                match end - row {
                    1 => tile_part::<S, E, NV, UV, 1>(simd, block, &range, &tile),
                    2 if const { mr::<S, E>() >= 2 } => {
                        tile_part::<S, E, NV, UV, 2>(simd, block, &range, &tile)
                    }
                    3 if const { mr::<S, E>() >= 3 } => {
                        tile_part::<S, E, NV, UV, 3>(simd, block, &range, &tile)
                    }
                    4 if const { mr::<S, E>() >= 4 } => {
                        tile_part::<S, E, NV, UV, 4>(simd, block, &range, &tile)
                    }
                    5 if const { mr::<S, E>() >= 5 } => {
                        tile_part::<S, E, NV, UV, 5>(simd, block, &range, &tile)
                    }
                    6 if const { mr::<S, E>() >= 6 } => {
                        tile_part::<S, E, NV, UV, 6>(simd, block, &range, &tile)
                    }
                    7 if const { mr::<S, E>() >= 7 } => {
                        tile_part::<S, E, NV, UV, 7>(simd, block, &range, &tile)
                    }
                    8 if const { mr::<S, E>() >= 8 } => {
                        tile_part::<S, E, NV, UV, 8>(simd, block, &range, &tile)
                    }
                    rows => unreachable!("a tile of {rows} rows"),
                }
            }
        }
    }
}

/// Rows of the largest tile.
const fn mr<S: Simd, E: Step<Broadcast>>() -> usize {
    S::TILE_ROWS - E::FEWER_GROUPS
}

/// A tile of sums: its first row, the weights that it meets, where its sums go, and what it prefetches from step
/// `ahead_from` on.
struct Tile {
    row: usize,
    weights: *const u32,
    sums: *mut u32,
    ahead: Lines,
    ahead_from: usize,
    /// Of fewer tiles than a step has cache lines: each prefetches several.
    is_one_of_few: bool,
}

/// `MR` rows by `UV` vectors of `NV` over one part of `k`.
///
/// # Safety
/// As [`panel_rows`]; the block has rows `tile.row .. tile.row + MR`, `tile.weights` the steps in `part`, and
/// `tile.sums` room for the rows.
#[inline(always)]
unsafe fn tile_part<S: Simd, E: Step<Broadcast>, const NV: usize, const UV: usize, const MR: usize>(
    simd: S,
    block: &Block<'_>,
    part: &Range<usize>,
    tile: &Tile,
) {
    const UNROLLED: usize = 4;
    let row_elements = NV * S::LANES;
    // Loop and address arithmetic competes with the multiply-adds for execution ports on Intel: with one step
    // a turn 0.87 of the rate of the whole head with AVX2 in float32 and bfloat16 (Intel with AMX, two
    // threads). Eight gain no more. But without VNNI a product of int8 is three instructions, and four steps
    // a turn made the head 0.86 times as fast.
    let unrolled = if E::PER_WORD < 4 || S::MAX_BYTE == u8::MAX {
        UNROLLED
    } else {
        1
    };
    let mut x = [block.x.as_ptr(); MR];
    for (r, x) in x.iter_mut().enumerate() {
        // Hidden: compilers compute each row from the one before it again in every step. Not measured on AMD.
        *x = black_box(
            block
                .x
                .as_ptr()
                .wrapping_add((tile.row + r) * block.x.row_stride()),
        );
    }
    if part.start == 0 {
        // The rows of `out` are written after the tiles: by then they are here.
        for r in 0..MR {
            for v in 0..UV {
                simd.prefetch(block.result(tile.row + r, v * S::LANES));
            }
        }
    }
    let weights = tile.weights;
    let mut first = part.start;
    loop {
        let end = part.end.min(first + E::Sums::PART / E::DEPTH);
        let mut sums = [[E::Sums::zero(simd); UV]; MR];
        // SAFETY: rows and weights have the steps before `end`; of the last one, rows have the rest of their
        // elements. There is room for the sums.
        unsafe {
            // Rows that are not converted may end within the last step.
            let whole = end.min(block.in_features / E::DEPTH);
            // Few rows leave little time: a step's share is then longer than a cache line. The loops are
            // apart because one register more for the general case makes the common one spill.
            let mut step = first;
            while step < whole {
                // Memory works while the sums are made. Measured at 49 x 1536 x 6144 on Zen 4, in order,
                // share of the FMA peak without and with it, with one step a turn: 0.89 and 0.95 (AVX-512),
                // 0.69 and 0.85 (AVX2).
                let (mut next, steps) = tile.ahead.at(step - tile.ahead_from);
                // Hidden: compilers find the smaller of the two again in each step.
                let round = step..black_box(whole.min(step + steps));
                step = round.end;
                if tile.is_one_of_few {
                    for step in round {
                        for line in 0..NV {
                            simd.prefetch(next.wrapping_add(line * LINE).cast());
                        }
                        next = next.wrapping_add(tile.ahead.pitch);
                        let words = weights.add((step - part.start) * row_elements);
                        E::multiply_add(simd, &mut sums, &x, step, words, E::DEPTH);
                    }
                } else {
                    let Range { mut start, end } = round;
                    let mut words = weights.add((start - part.start) * row_elements);
                    while start + unrolled <= end {
                        for index in 0..unrolled {
                            simd.prefetch(next.cast());
                            next = next.wrapping_add(tile.ahead.pitch);
                            let words = words.add(index * row_elements);
                            E::multiply_add(simd, &mut sums, &x, start + index, words, E::DEPTH);
                        }
                        words = words.add(unrolled * row_elements);
                        start += unrolled;
                    }
                    for step in start..end {
                        simd.prefetch(next.cast());
                        next = next.wrapping_add(tile.ahead.pitch);
                        let words = weights.add((step - part.start) * row_elements);
                        E::multiply_add(simd, &mut sums, &x, step, words, E::DEPTH);
                    }
                }
            }
            if whole < end {
                let rest = block.in_features - whole * E::DEPTH;
                let words = weights.add((whole - part.start) * row_elements);
                E::multiply_add(simd, &mut sums, &x, whole, words, rest);
            }
            // Parts after the first read what the one before has written.
            keep::<S, E, NV, UV, MR>(simd, sums, tile.sums, first != 0);
        }
        first = end;
        if first >= part.end {
            return;
        }
    }
}

/// Stores sums, or adds them to what is there.
///
/// # Safety
/// `to` has room for `MR` rows of `NV` vectors, which hold sums if it `adds`.
#[inline(always)]
unsafe fn keep<S: Simd, E: Step<Broadcast>, const NV: usize, const UV: usize, const MR: usize>(
    simd: S,
    mut sums: [[SumVector<S, E>; UV]; MR],
    to: *mut u32,
    adds: bool,
) {
    // SAFETY: the contract of this function. Loops of their own: with a branch inside, they would not be
    // unrolled, and the sums would be in memory.
    unsafe {
        if adds {
            for (r, row) in sums.iter_mut().enumerate() {
                for (v, sum) in row.iter_mut().enumerate() {
                    let before = simd.load_words_ptr(to.add((r * NV + v) * S::LANES));
                    *sum = E::Sums::add(simd, cast(before), *sum);
                }
            }
        }
        for (r, row) in sums.iter().enumerate() {
            for (v, sum) in row.iter().enumerate() {
                simd.store_words_ptr(cast(*sum), to.add((r * NV + v) * S::LANES));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{PanelMut, RowSplit};
    use super::*;
    use crate::isa::Isa;
    use crate::matrix::Matrix;
    use crate::rows::Rows;
    use crate::weights::{Arithmetic, Element, WeightRef};

    /// Otherwise a narrow panel would cost as much as a whole one, and results would not tell.
    #[test]
    fn only_vectors_with_needed_columns_are_computed() {
        const UNTOUCHED: u32 = 0x7fc0_0bad;
        let x = [1.0_f32, 2.0, 3.0, 4.0, 5.0].map(f32::to_bits);
        for isa in Isa::available() {
            if cfg!(target_arch = "aarch64") && isa != Isa::Portable {
                continue; // another micro-kernel, which writes all sums
            }
            let gemm = isa.gemm(Arithmetic::Float32, Element::F32);
            let (shape, lanes) = (gemm.shape(), isa.vectors().lanes);
            let mut words = vec![0; gemm.panel_words(x.len())];
            let weights = [1.0; 5];
            let panel = PanelMut {
                words: &mut words,
                scales: &mut [],
                sums: &mut [],
            };
            gemm.pack(WeightRef::F32(Matrix::new(&weights, x.len())), 0, panel);
            for needed in (lanes..=shape.nr).step_by(lanes) {
                let mut sums = vec![MaybeUninit::new(UNTOUCHED); shape.nr];
                let block = Block {
                    x: Rows::new(&x, x.len()),
                    in_features: x.len(),
                    split: RowSplit::new(1, shape),
                    calls: 0..1,
                    weights: &words,
                    needed,
                    ahead: 0,
                    streams: false,
                    out: std::ptr::null(),
                    out_stride: 0,
                };
                gemm.multiply(&block, &mut sums);
                // SAFETY: all of them were written above.
                let sums: Vec<u32> = sums.iter().map(|sum| unsafe { sum.assume_init() }).collect();
                assert_eq!(f32::from_bits(sums[0]), 15.0, "{isa}");
                let untouched = sums.iter().map(|&sum| sum == UNTOUCHED);
                assert!(
                    untouched.eq((0..shape.nr).map(|column| column >= needed)),
                    "{isa}, {needed}"
                );
            }
        }
    }
}
