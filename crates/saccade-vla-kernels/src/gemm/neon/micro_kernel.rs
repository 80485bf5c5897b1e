//! A block of rows through one panel of [`COLUMNS`] columns: the loops that all products on NEON share.
//!
//! A step takes a vector of every group of rows, and all that the panel has for it. A group is one row, of
//! which an instruction takes an element by lane, or two that an instruction multiplies by two columns. Seven
//! rows by three vectors, or four pairs of rows by six pairs of columns, are the largest tiles whose sums,
//! rows and weights 32 registers hold.

#[cfg(feature = "peak")]
use std::hint::black_box;
use std::mem::MaybeUninit;
use std::ops::Range;

#[cfg(feature = "peak")]
use crate::gemm::elements::F32;
use crate::gemm::elements::{Elements, RowElements, SumVector, Sums};
use crate::gemm::nibbles::Unpack;
use crate::gemm::step::{MicroKernel, Step};
use crate::gemm::{Block, SUM_PART, Shape};
use crate::simd::bits::cast;
use crate::simd::{LINE, Simd};

/// The micro-kernel.
pub(crate) struct Lanes;

/// Columns of a panel.
pub(super) const COLUMNS: usize = 12;

/// Groups of rows of the largest tile.
const MAX_GROUPS: usize = 7;

/// Words of a panel after which the next tile takes the same part of it, which is then still in the cache.
const BLOCK_WORDS: usize = 12 << 10;

/// Words of a vector.
pub(super) const VECTOR: usize = 4;

/// Words of weights that are widened at a time: the sums of a part. As many of int8 are unpacked from nibbles, an even
/// number of steps.
const MAX_WIDENED: usize = SUM_PART * COLUMNS;

/// Words of a panel for a step; of nibbles half as many.
const fn panel_step<E: Step<Lanes>>() -> usize {
    COLUMNS * E::DEPTH / E::PER_WORD
}

/// Words that a step multiplies: more than that where weights are widened.
const fn step_words<E: Step<Lanes>>() -> usize {
    if E::IS_WIDENED {
        COLUMNS * E::DEPTH
    } else {
        panel_step::<E>()
    }
}

/// Groups of rows of the largest tile of these elements.
const fn groups<E: Step<Lanes>>() -> usize {
    MAX_GROUPS - E::FEWER_GROUPS
}

// SAFETY: all rows of the block and all columns are written.
unsafe impl MicroKernel for Lanes {
    fn shape<S: Simd, E: Step<Self>>() -> Shape {
        Shape {
            nr: COLUMNS,
            mr: groups::<E>() * E::GROUP,
            row_group: E::GROUP,
        }
    }

    #[inline(always)]
    unsafe fn multiply<S: Simd, E: Step<Self>>(
        simd: S,
        block: &Block<'_>,
        has_nibbles: bool,
        sums: &mut [MaybeUninit<u32>],
    ) {
        let sums = sums.as_mut_ptr().cast();
        // SAFETY: the contract of this function, and `sums` has room for the rows of the block. Vectors of
        // sums are of four columns of a row, or of two columns of two.
        unsafe {
            match E::GROUP {
                1 => panel_rows::<S, E, 3>(simd, block, has_nibbles, sums),
                _ => panel_rows::<S, E, 6>(simd, block, has_nibbles, sums),
            }
        }
    }

    #[cfg(feature = "peak")]
    #[inline(always)]
    unsafe fn multiply_for_peak<S: Simd, E: Step<Self>>(simd: S) -> usize {
        // SAFETY: the contract of this function.
        unsafe {
            match (E::GROUP, E::FEWER_GROUPS) {
                // Once widened, a product is one of float32.
                _ if E::IS_WIDENED => peak::<S, F32, 3, 7>(simd),
                (1, 0) => peak::<S, E, 3, 7>(simd),
                (1, 1) => peak::<S, E, 3, 6>(simd),
                (1, _) => peak::<S, E, 3, 5>(simd),
                _ => peak::<S, E, 6, 4>(simd),
            }
        }
    }
}

/// A step of the largest tile, again and again. Rows and weights are in the nearest cache.
///
/// # Safety
/// As [`MicroKernel::multiply_for_peak`].
#[cfg(feature = "peak")]
#[inline(always)]
unsafe fn peak<S: Simd, E: Step<Lanes>, const NV: usize, const MR: usize>(simd: S) -> usize {
    const STEPS: usize = 1 << 17;
    // Between 0.5 and 1 in float32 and bfloat16, positive in int8.
    let (x, weights) = (
        [0x3f3f_3f3f_u32; MAX_GROUPS * VECTOR],
        [0x3f3f_3f3f_u32; VECTOR * COLUMNS],
    );
    let mut sums = [[E::Sums::zero(simd); NV]; MR];
    for _ in 0..STEPS {
        // Hidden, because products that do not change would be computed once.
        let (x, weights) = (black_box(x.as_ptr()), black_box(weights.as_ptr()));
        let rows = std::array::from_fn(|group| x.wrapping_add(group * VECTOR));
        // SAFETY: there is a vector for each group, and as many words of weights as any step has.
        unsafe { E::multiply_add::<S, NV, MR>(simd, &mut sums, &rows, 0, weights, E::DEPTH) };
    }
    // A copy, as `peak` of `broadcast.rs` makes.
    let made = sums;
    black_box(&made);
    STEPS * MR * E::GROUP * COLUMNS * E::DEPTH
}

/// # Safety
/// As [`MicroKernel::multiply`]; `sums` has room for the rows of the block.
#[inline(always)]
unsafe fn panel_rows<S: Simd, E: Step<Lanes>, const NV: usize>(
    simd: S,
    block: &Block<'_>,
    has_nibbles: bool,
    sums: *mut u32,
) {
    const { assert!(groups::<E>() >= 4 && S::LANES == VECTOR && step_words::<E>() <= VECTOR * COLUMNS) }
    let has_nibbles = E::ARE_BYTES && has_nibbles;
    let mut widened = [const { MaybeUninit::<u32>::uninit() }; MAX_WIDENED];
    let first_row = block.rows().start;
    let steps = block.in_features.div_ceil(E::DEPTH);
    let block_steps = if E::IS_WIDENED || has_nibbles {
        MAX_WIDENED / step_words::<E>()
    } else {
        BLOCK_WORDS / step_words::<E>()
    };
    for part in 0..steps.div_ceil(block_steps).max(1) {
        let part = part * block_steps..steps.min((part + 1) * block_steps);
        let words = part.start * panel_step::<E>()..part.end * panel_step::<E>();
        let weights = if has_nibbles {
            // Two rows of words are one; of the last, the second is perhaps empty.
            let row = COLUMNS * E::GROUP;
            let panel = &block.weights[words.start / 2..words.end.div_ceil(2 * row) * row];
            let to = &mut widened;
            simd.run(&mut Unpack { panel, row, to });
            widened.as_ptr().cast()
        } else if E::IS_WIDENED {
            widen(simd, &block.weights[words], &mut widened)
        } else {
            block.weights[words].as_ptr()
        };
        for call in block.calls.clone() {
            let rows = block.split.rows(&(call..call + 1));
            let tile = Tile {
                weights,
                panel_step: panel_step::<E>() / if has_nibbles { 2 } else { 1 },
                sums: sums.wrapping_add((rows.start - first_row) * COLUMNS),
                call: call - block.calls.start,
                rows,
            };
            // SAFETY: the rows are in the block, their sums within the block's, and the part within the
            // panel, or, of nibbles, within what was unpacked of it, all of which was written.
            unsafe {
                match tile.rows.len().div_ceil(E::GROUP) {
                    1 => tile_part::<S, E, NV, 1>(simd, block, &part, &tile),
                    2 => tile_part::<S, E, NV, 2>(simd, block, &part, &tile),
                    3 => tile_part::<S, E, NV, 3>(simd, block, &part, &tile),
                    4 => tile_part::<S, E, NV, 4>(simd, block, &part, &tile),
                    5 if const { groups::<E>() >= 5 } => tile_part::<S, E, NV, 5>(simd, block, &part, &tile),
                    6 if const { groups::<E>() >= 6 } => tile_part::<S, E, NV, 6>(simd, block, &part, &tile),
                    7 if const { groups::<E>() >= 7 } => tile_part::<S, E, NV, 7>(simd, block, &part, &tile),
                    groups => unreachable!("a tile of {groups} groups of rows"),
                }
            }
        }
    }
}

/// The weights of a part in float32. Widening in the tiles would take an eighth of the time of their
/// multiply-adds.
#[inline(always)]
fn widen<S: Simd>(simd: S, panel: &[u32], to: &mut [MaybeUninit<u32>]) -> *const u32 {
    let parts = to.as_chunks_mut::<{ 2 * COLUMNS }>().0;
    for (pairs, to) in panel.as_chunks::<COLUMNS>().0.iter().zip(parts) {
        let (low, high) = to.split_at_mut(COLUMNS);
        let (low, high) = (low.as_chunks_mut::<VECTOR>().0, high.as_chunks_mut::<VECTOR>().0);
        let vectors = low.iter_mut().zip(high);
        for (words, (low, high)) in pairs.as_chunks::<VECTOR>().0.iter().zip(vectors) {
            let words = simd.load_words(words);
            // SAFETY: both have room for a vector.
            unsafe {
                simd.store_words_ptr(cast(simd.low_halves(words)), low.as_mut_ptr().cast());
                simd.store_words_ptr(cast(simd.high_halves(words)), high.as_mut_ptr().cast());
            }
        }
    }
    to.as_ptr().cast()
}

/// A tile of sums: its rows, the weights of the part, how many words of the panel a step of them was, where its sums
/// go, and its number among those of the block.
struct Tile {
    rows: Range<usize>,
    weights: *const u32,
    panel_step: usize,
    sums: *mut u32,
    call: usize,
}

/// `MR` groups of rows by `NV` vectors over the steps in `part`.
///
/// # Safety
/// As [`panel_rows`]; the block has the tile's rows, `tile.sums` room for them, and `tile.weights` the
/// part's.
#[inline(always)]
unsafe fn tile_part<S: Simd, E: Step<Lanes>, const NV: usize, const MR: usize>(
    simd: S,
    block: &Block<'_>,
    part: &Range<usize>,
    tile: &Tile,
) {
    let mut x = [block.x.as_ptr(); MR];
    for (group, x) in x.iter_mut().enumerate() {
        *x = x.wrapping_add((tile.rows.start + group * E::GROUP) * block.x.row_stride());
    }
    // Each tile prefetches its share of a later panel.
    let (size, calls) = (block.weights.len(), block.calls.len());
    let mut next = block
        .weights
        .as_ptr()
        .wrapping_add(block.ahead * size + size * tile.call / calls + part.start * tile.panel_step / calls);
    let pitch = tile.panel_step.div_ceil(calls);
    if part.start == 0 {
        for row in tile.rows.clone() {
            simd.prefetch(block.result(row, 0));
        }
    }
    let mut weights = tile.weights;
    let mut first = part.start;
    loop {
        let end = part.end.min(first + E::Sums::PART / E::DEPTH);
        // Rows of float32 may end within the last step.
        let whole = if matches!(E::ROWS, RowElements::F32 | RowElements::RoundedF32) {
            end.min(block.in_features / E::DEPTH)
        } else {
            end
        };
        let mut sums = [[E::Sums::zero(simd); NV]; MR];
        // SAFETY: rows and weights have the steps before `end`; of the last one, rows have the rest of their
        // elements.
        unsafe {
            // Few rows leave little time: a step's share of the later panel is then longer than a cache line.
            // The loops are apart so that each is one block without a branch.
            if pitch > LINE {
                for step in first..whole {
                    for line in 0..panel_step::<E>().div_ceil(LINE) {
                        simd.prefetch(next.wrapping_add(line * LINE).cast());
                    }
                    next = next.wrapping_add(pitch);
                    E::multiply_add(simd, &mut sums, &x, step, weights, E::DEPTH);
                    weights = weights.add(step_words::<E>());
                }
            } else {
                for step in first..whole {
                    simd.prefetch(next.cast());
                    next = next.wrapping_add(pitch);
                    E::multiply_add(simd, &mut sums, &x, step, weights, E::DEPTH);
                    weights = weights.add(step_words::<E>());
                }
            }
            if whole < end {
                let rest = block.in_features - whole * E::DEPTH;
                let mut last = [[0; VECTOR]; MR];
                for (last, x) in last.iter_mut().zip(x) {
                    x.add(whole * VECTOR)
                        .copy_to_nonoverlapping(last.as_mut_ptr(), rest);
                }
                let mut last_x = [last[0].as_ptr(); MR];
                for (pointer, last) in last_x.iter_mut().zip(&last) {
                    *pointer = last.as_ptr();
                }
                E::multiply_add(simd, &mut sums, &last_x, 0, weights, E::DEPTH);
            }
            // Groups by name: if a loop found them by number, the sums would be in memory, and stored there
            // again in every step.
            macro_rules! keep {
                ($($group:literal)*) => {$(
                    if $group < MR {
                        let rows = E::GROUP.min(tile.rows.len() - $group * E::GROUP);
                        let to = tile.sums.add($group * E::GROUP * COLUMNS);
                        keep::<S, E, NV>(simd, sums[$group], to, rows, first != 0);
                    }
                )*};
            }
            const { assert!(MR <= 7, "each group is named") }
            keep!(0 1 2 3 4 5 6);
        }
        first = end;
        if first >= part.end {
            return;
        }
    }
}

/// Stores the sums of a group of `rows` rows, or adds them to what is there.
///
/// # Safety
/// `to` has room for the rows, which hold sums if it `adds`.
#[inline(always)]
unsafe fn keep<S: Simd, E: Elements, const NV: usize>(
    simd: S,
    sums: [SumVector<S, E>; NV],
    to: *mut u32,
    rows: usize,
    adds: bool,
) {
    for (v, mut sum) in sums.into_iter().enumerate() {
        // SAFETY: the contract of this function.
        unsafe {
            if E::GROUP == 1 {
                let to = to.add(v * VECTOR);
                if adds {
                    sum = E::Sums::add(simd, cast(simd.load_words_ptr(to)), sum);
                }
                simd.store_words_ptr(cast(sum), to);
            } else {
                // A pair of columns of one row or of two.
                let to = to.add(v * 2).cast::<[u32; 2]>();
                let second = to.cast::<u32>().add(COLUMNS).cast::<[u32; 2]>();
                if adds {
                    let second = if rows > 1 { second.read() } else { [0; 2] };
                    sum = E::Sums::add(simd, cast([to.read(), second]), sum);
                }
                let [low, high]: [[u32; 2]; 2] = cast(sum);
                to.write(low);
                if rows > 1 {
                    second.write(high);
                }
            }
        }
    }
}
