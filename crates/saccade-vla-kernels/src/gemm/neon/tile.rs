//! A block of rows through one panel of [`COLUMNS`] columns, tile by tile: the loops that all products on NEON share.
//!
//! A step takes a vector of every group of rows, and all that the panel has for it. A group is one row, of which an instruction takes an
//! element by lane, or two that an instruction multiplies by two columns. Seven rows by three vectors, or four pairs of rows by six pairs of
//! columns, are the largest tiles whose sums, rows and weights 32 registers hold. Sums are cut and added as in [`super::super::tile`].

use std::mem::MaybeUninit;
use std::ops::Range;

use crate::gemm::{Block, Shape};
use crate::simd::aarch64::instructions::prefetch;
use crate::simd::{LINE, Simd};

/// Columns of a panel.
pub(super) const COLUMNS: usize = 12;

/// As [`super::super::tile::SUM_PART`].
pub(super) const SUM_PART: usize = 512;

/// Words of a panel after which the next tile takes the same part of it, which is then still in the cache.
const BLOCK_WORDS: usize = 12 << 10;

/// Words of a vector.
const VECTOR: usize = 4;

/// Words that a step of any product multiplies.
const MAX_STEP_WORDS: usize = VECTOR * COLUMNS;

/// Words of weights that are widened at a time: the sums of a part.
pub(super) const MAX_WIDENED: usize = SUM_PART * COLUMNS;

/// One step over `k`.
pub(super) trait Step<S: Simd> {
    /// Consecutive `k` of a step: those of a vector of a group of rows.
    const DEPTH: usize;
    /// Rows of a group.
    const ROW_GROUP: usize;
    /// Groups of the largest tile, at most 7.
    const GROUPS: usize;
    /// Words of a panel for a step.
    const PANEL_WORDS: usize;
    /// Words that a step multiplies: more than [`Self::PANEL_WORDS`] where weights are widened.
    const STEP_WORDS: usize = Self::PANEL_WORDS;
    /// Steps that are summed from zero, at multiples of which the summed dimension is cut.
    const PART_STEPS: usize;
    /// Whether rows are float32 where they are, and may end within the last step.
    const IN_PLACE: bool = false;
    /// A vector of sums.
    type Sum: Copy;

    /// # Safety
    /// Here and below: called within [`Simd::run`] of `S`.
    unsafe fn zero() -> Self::Sum;

    /// # Safety
    /// As [`Self::zero`].
    unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum;

    /// Vector number `v` of the sums of a group of `rows` rows.
    ///
    /// # Safety
    /// `from` points to [`COLUMNS`] words for each of them.
    unsafe fn load(from: *const u32, v: usize, rows: usize) -> Self::Sum;

    /// Stores it there.
    ///
    /// # Safety
    /// As [`Self::load`].
    unsafe fn store(sum: Self::Sum, to: *mut u32, v: usize, rows: usize);

    /// The words of some steps of a panel as they are multiplied, if need be in `memory`.
    ///
    /// # Safety
    /// The steps are in the panel, and at most [`MAX_WIDENED`] words; `memory` has room for these.
    #[inline(always)]
    unsafe fn widened(panel: *const u32, _steps: usize, _memory: *mut u32) -> *const u32 {
        panel
    }

    /// `sums += x W` over a step.
    ///
    /// # Safety
    /// `weights` points to [`Self::STEP_WORDS`], and so many words beyond each of `x` is a vector of a group of rows.
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[Self::Sum; NV]; MR],
        x: &[*const u32; MR],
        beyond: usize,
        weights: *const u32,
    );
}

/// The sizes of a product with these steps.
pub(super) fn shape<S: Simd, P: Step<S>>() -> Shape {
    Shape {
        columns: COLUMNS,
        tile_rows: P::GROUPS * P::ROW_GROUP,
        row_group: P::ROW_GROUP,
        rows_beyond: 0,
    }
}

/// Words of a panel.
pub(super) fn panel_words<S: Simd, P: Step<S>>(in_features: usize) -> usize {
    P::PANEL_WORDS * in_features.div_ceil(P::DEPTH)
}

/// What [`Gemm::multiply`](crate::gemm::Gemm::multiply) does, as a part of a kernel, with `NV` vectors of sums for each group of rows.
///
/// # Safety
/// As there; called within [`Simd::run`] of `S`. A group of `P::ROW_GROUP` rows has that many vectors, and converted rows are whole steps.
#[inline(always)]
pub(super) unsafe fn multiply<S: Simd, P: Step<S>, const NV: usize>(block: &Block<'_>) {
    const {
        assert!(NV * VECTOR == COLUMNS * P::ROW_GROUP && P::GROUPS <= 7 && P::STEP_WORDS <= MAX_STEP_WORDS);
    }
    let mut widened = [const { MaybeUninit::<u32>::uninit() }; MAX_WIDENED];
    let widened = widened.as_mut_ptr().cast();
    let tiles = &block.range;
    let first_row = block.rows().start;
    let steps = block.in_features.div_ceil(P::DEPTH);
    let block_steps = if P::STEP_WORDS > P::PANEL_WORDS {
        P::PART_STEPS
    } else {
        BLOCK_WORDS / P::STEP_WORDS
    };
    for part in 0..steps.div_ceil(block_steps).max(1) {
        let part = part * block_steps..steps.min((part + 1) * block_steps);
        // SAFETY: the caller's promise; these steps are in the panel.
        let weights = unsafe {
            let panel = block.weights.as_ptr().add(part.start * P::PANEL_WORDS);
            P::widened(panel, part.len(), widened)
        };
        for number in tiles.clone() {
            let (first, end) = (block.tiles.first_row(number), block.tiles.first_row(number + 1));
            // SAFETY: the caller's promise; the tile is within the rows, and its sums within the block's.
            unsafe {
                let tile = RowTile {
                    row: first,
                    rows: end - first,
                    weights,
                    sums: block.sums.add((first - first_row) * COLUMNS),
                    tile: number - tiles.start,
                    tiles: tiles.len(),
                };
                match (end - first).div_ceil(P::ROW_GROUP) {
                    1 => tile_part::<S, P, NV, 1>(block, &part, &tile),
                    2 => tile_part::<S, P, NV, 2>(block, &part, &tile),
                    3 => tile_part::<S, P, NV, 3>(block, &part, &tile),
                    4 => tile_part::<S, P, NV, 4>(block, &part, &tile),
                    5 if P::GROUPS >= 5 => tile_part::<S, P, NV, 5>(block, &part, &tile),
                    6 if P::GROUPS >= 6 => tile_part::<S, P, NV, 6>(block, &part, &tile),
                    7 if P::GROUPS >= 7 => tile_part::<S, P, NV, 7>(block, &part, &tile),
                    groups => unreachable!("a tile of {groups} groups of rows"),
                }
            }
        }
    }
    (block.finish)(block.rows());
}

/// A tile: its first row and its rows, the weights of the part, where its sums go, and its number among those of the block.
struct RowTile {
    row: usize,
    rows: usize,
    weights: *const u32,
    sums: *mut u32,
    tile: usize,
    tiles: usize,
}

/// `MR` groups of rows by `NV` vectors over the steps in `part`.
///
/// # Safety
/// As [`multiply`]; the block has the tile's rows, `tile.sums` room for them, and `tile.weights` the part's.
#[inline(always)]
unsafe fn tile_part<S: Simd, P: Step<S>, const NV: usize, const MR: usize>(
    block: &Block<'_>,
    part: &Range<usize>,
    tile: &RowTile,
) {
    // SAFETY: the caller's promise for all pointers below; prefetching is allowed at any address.
    unsafe {
        let mut x = [block.x; MR];
        for (group, x) in x.iter_mut().enumerate() {
            *x = block
                .x
                .offset((tile.row + group * P::ROW_GROUP) as isize * block.x_stride);
        }
        // As in `super::super::tile`: each tile asks for its share of a later panel.
        let size = block.weights.len();
        let mut next = block.weights.as_ptr().wrapping_add(
            block.ahead * size + size * tile.tile / tile.tiles + part.start * P::PANEL_WORDS / tile.tiles,
        );
        let stride = P::PANEL_WORDS.div_ceil(tile.tiles);
        if part.start == 0 {
            for row in tile.row..tile.row + tile.rows {
                prefetch(block.out.wrapping_offset(row as isize * block.out_stride).cast());
            }
        }
        let mut weights = tile.weights;
        let mut first = part.start;
        loop {
            let end = part.end.min(first + P::PART_STEPS);
            let whole = if P::IN_PLACE {
                end.min(block.in_features / P::DEPTH)
            } else {
                end
            };
            let mut sums = [[P::zero(); NV]; MR];
            // Few rows leave little time: a step's share of the later panel is then longer than a cache line. The loops are apart so that
            // each is one block without a branch.
            if stride > LINE {
                for step in first..whole {
                    for line in 0..P::PANEL_WORDS.div_ceil(LINE) {
                        prefetch(next.wrapping_add(line * LINE).cast());
                    }
                    next = next.wrapping_add(stride);
                    P::multiply_add(&mut sums, &x, step * VECTOR, weights);
                    weights = weights.add(P::STEP_WORDS);
                }
            } else {
                for step in first..whole {
                    prefetch(next.cast());
                    next = next.wrapping_add(stride);
                    P::multiply_add(&mut sums, &x, step * VECTOR, weights);
                    weights = weights.add(P::STEP_WORDS);
                }
            }
            if whole < end {
                let rest = block.in_features - whole * P::DEPTH;
                let mut last = [[0; VECTOR]; MR];
                for (last, x) in last.iter_mut().zip(x) {
                    x.add(whole * VECTOR)
                        .copy_to_nonoverlapping(last.as_mut_ptr(), rest);
                }
                let mut last_x = [last[0].as_ptr(); MR];
                for (pointer, last) in last_x.iter_mut().zip(&last) {
                    *pointer = last.as_ptr();
                }
                P::multiply_add(&mut sums, &last_x, 0, weights);
            }
            // Groups by name: if a loop found them by number, the sums would be in memory, and stored there again in every step.
            macro_rules! keep {
                ($($group:literal)*) => {$(
                    if $group < MR {
                        let rows = P::ROW_GROUP.min(tile.rows - $group * P::ROW_GROUP);
                        let to = tile.sums.add($group * P::ROW_GROUP * COLUMNS);
                        keep_sums::<S, P, NV>(sums[$group], to, rows, first != 0);
                    }
                )*};
            }
            const { assert!(MR <= 7, "each group is named") }
            keep!(0 1 2 3 4 5 6);
            first = end;
            if first >= part.end {
                return;
            }
        }
    }
}

/// Stores the sums of a group of `rows` rows, or adds them to what is there.
///
/// # Safety
/// As [`Step::load`].
#[inline(always)]
unsafe fn keep_sums<S: Simd, P: Step<S>, const NV: usize>(
    sums: [P::Sum; NV],
    to: *mut u32,
    rows: usize,
    adds: bool,
) {
    // SAFETY: the caller's promise.
    unsafe {
        for (v, mut sum) in sums.into_iter().enumerate() {
            if adds {
                sum = P::add(P::load(to, v, rows), sum);
            }
            P::store(sum, to, v, rows);
        }
    }
}
