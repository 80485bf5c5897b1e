//! A few queries of one head: scores, softmax and the value product, block of keys by block of keys, on the stack and in registers.

use std::mem::MaybeUninit;
use std::ops::Range;

use super::arithmetic::{Float32, HeldBf16, HeldF32, Pairs, TileArithmetic};
use super::keys_values::PackedKeyValues;
use super::mask::Mask;
use super::product::{InVectors, Multiply, Removed, TileProduct};
use super::softmax::{Row, Running};
use crate::simd::{Dot, Dots, Kernel, LINE, MAX_TILE_ROWS, Simd, Vector, load, store};
use crate::tiles::{MAX_ROWS, Session, TileKernel, TileUnit};

/// Keys between two updates of a query's running maximum, at most: whole pairs of vectors of every instruction set.
const KEY_BLOCK: usize = 320;

/// Width of the values that one pass accumulates on the stack. Wider heads take more passes, each with its own scores.
const MAX_VALUES: usize = 256;

/// Elements of the queries that are on the stack at a time: an even number of whole vectors. Wider heads take more passes.
const MAX_DEPTH: usize = 256;

pub(super) struct Call<'a> {
    pub kv: &'a PackedKeyValues,
    /// Consecutive heads of queries that share a head of keys and values.
    pub heads_per_kv_head: usize,
    pub queries: *const f32,
    pub queries_stride: isize,
    pub rows: usize,
    pub scale: f32,
    pub mask: Mask<'a>,
    pub weights: Option<*mut f32>,
    pub out: *mut f32,
    pub out_stride: isize,
}

// SAFETY: tasks read the queries and write different (head, query) parts of `out` and `weights`; all views are borrowed for the whole call.
unsafe impl Sync for Call<'_> {}

/// A few queries of one head.
pub(super) struct QueryTile<'a> {
    pub call: &'a Call<'a>,
    pub head: usize,
    pub first: usize,
    pub rows: usize,
}

/// A tile of float32 keys and values.
pub(super) struct FloatTile<'a>(pub &'a QueryTile<'a>);

/// A tile of bfloat16 keys and values.
pub(super) struct Bf16Tile<'a>(pub &'a QueryTile<'a>);

/// A tile of bfloat16 keys and values, for a unit that multiplies tiles.
pub(super) struct UnitTile<'a>(pub &'a QueryTile<'a>);

impl Kernel for FloatTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // SAFETY: called within `Simd::run`; keys and values are float32.
        unsafe {
            self.0
                .run_as::<S, Float32<HeldF32>, _, MAX_TILE_ROWS>(simd, &mut InVectors)
        }
    }
}

impl Kernel for Bf16Tile<'_> {
    type Output = ();
    const DOTS: Option<Dot> = Some(Dot::Bf16);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // SAFETY: called within `Simd::run`; keys and values are pairs of bfloat16.
        unsafe {
            if S::Dots::HAS_BF16 {
                self.0.run_as::<S, Pairs, _, MAX_TILE_ROWS>(simd, &mut InVectors);
            } else {
                self.0
                    .run_as::<S, Float32<HeldBf16>, _, MAX_TILE_ROWS>(simd, &mut InVectors);
            }
        }
    }
}

impl TileKernel for UnitTile<'_> {
    type Output = ();

    fn run<U: TileUnit>(self, unit: U) {
        unit.simd().run(BesideUnit { tile: self.0, unit });
    }
}

/// The tile on the vectors beside its unit.
struct BesideUnit<'a, U> {
    tile: &'a QueryTile<'a>,
    unit: U,
}

impl<U: TileUnit> Kernel for BesideUnit<'_, U> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // SAFETY: no other session is open; called within `Simd::run`; keys and values are pairs of bfloat16 in whole steps.
        unsafe {
            let mut session = Session::new(self.unit);
            self.tile.run_as::<S, Pairs, _, MAX_ROWS>(simd, &mut session);
        }
    }
}

impl QueryTile<'_> {
    /// With at most `ROWS` rows.
    ///
    /// # Safety
    /// Called within [`Simd::run`] of `S`; keys and values are held as `A` and `M` read them.
    #[inline(always)]
    unsafe fn run_as<S: Simd, A: TileArithmetic<S>, M: Multiply<S, A>, const ROWS: usize>(
        &self,
        simd: S,
        multiplier: &mut M,
    ) {
        let dims = self.call.kv.head_dim();
        for first in (0..dims).step_by(MAX_VALUES) {
            let columns = Columns {
                first,
                count: MAX_VALUES.min(dims - first),
            };
            // SAFETY: the rows and columns are in the call's views; the rest is the caller's promise.
            unsafe { attend::<S, S::Vector, A, M, ROWS>(simd, multiplier, self, &columns) }
        }
    }
}

/// Columns of a head's values.
struct Columns {
    first: usize,
    count: usize,
}

#[repr(align(64))]
struct Scratch<const ROWS: usize, const N: usize>([[MaybeUninit<f32>; N]; ROWS]);

impl<const ROWS: usize, const N: usize> Scratch<ROWS, N> {
    #[inline(always)]
    fn new() -> Self {
        Self([const { [const { MaybeUninit::uninit() }; N] }; ROWS])
    }

    #[inline(always)]
    fn pointer(&mut self) -> *mut f32 {
        self.0.as_mut_ptr().cast()
    }
}

/// Attention of a tile's queries.
///
/// # Safety
/// The tile's rows, at most `ROWS`, and the columns are in the call's views; called within [`Simd::run`] of `S`; keys and values are held as
/// `A` and `M` read them.
#[inline(always)]
unsafe fn attend<
    S: Simd<Vector = V>,
    V: Vector,
    A: TileArithmetic<S>,
    M: Multiply<S, A>,
    const ROWS: usize,
>(
    simd: S,
    multiplier: &mut M,
    tile: &QueryTile<'_>,
    columns: &Columns,
) {
    let (call, kv) = (tile.call, tile.call.kv);
    let (len, padded) = (kv.len(), columns.count.next_multiple_of(V::LANES));
    let value_width = kv.value_width();
    let mut factors = Scratch::<ROWS, MAX_DEPTH>::new();
    let factors = factors.pointer();
    let mut probabilities = Scratch::<ROWS, KEY_BLOCK>::new();
    let probabilities = probabilities.pointer();
    let mut sums = Scratch::<ROWS, MAX_VALUES>::new();
    let sums = sums.pointer();
    let mut running = [Running {
        max: f32::NEG_INFINITY,
        sum: 0.0,
    }; ROWS];
    let running = &mut running[..tile.rows];
    let mut maxima = [f32::NEG_INFINITY; ROWS];
    let block = keys_of_block(&call.mask, len, M::KEYS);
    // Keys beyond are seen by none of these queries.
    let visible = call.mask.visible(tile.first + tile.rows - 1, len);
    let kv_head = tile.head / call.heads_per_kv_head;
    // Whether zeros may be multiplied by the values of removed keys.
    let can_multiply = kv.is_finite() || matches!(call.mask, Mask::None);
    // SAFETY: the scratch holds as many rows as a tile may have, of MAX_DEPTH factors, KEY_BLOCK probabilities and `padded` sums; blocks end
    // at the last key or before it, and its vector is padded in the keys; everything else is the caller's promise.
    unsafe {
        if visible == 0 || !can_multiply {
            for i in (0..tile.rows * padded).step_by(V::LANES) {
                V::splat(0.0).store(sums.add(i));
            }
        }
        let keys = kv.head_keys(kv_head).as_ptr();
        let values = kv.head_values(kv_head).as_ptr();
        for first in (0..visible).step_by(block) {
            let count = block.min(visible - first);
            tile.scores::<S, V, A, M>(
                simd,
                multiplier,
                keys,
                first..first + count,
                factors,
                probabilities,
            );
            let row = |r: usize| Row {
                mask: &call.mask,
                head: tile.head,
                query: tile.first + r,
                len,
                first,
                count,
            };
            // All maxima before all exponentials: rows are then independent, and the CPU works on several of them at once.
            for (r, (max, running)) in maxima.iter_mut().zip(running.iter()).enumerate() {
                *max = row(r).logits::<V>(probabilities.add(r * KEY_BLOCK), running.max);
            }
            let block_values = values.add(first / A::STEP * value_width + columns.first);
            for (r, (running, &max)) in running.iter_mut().zip(&maxima).enumerate() {
                let row = row(r);
                // The first of a head's tiles asks for the values while it computes: from memory they came at its bandwidth while nothing else
                // was done (Intel with AMX; not measured on AMD).
                if tile.first == 0 {
                    // A pass of a wide head takes some columns of each step. Where it takes all of them, they are one stretch of memory: a
                    // loop over steps there costs 2 % (Intel with AMX, bfloat16).
                    let steps = count.div_ceil(A::STEP);
                    let (stretches, words) = match padded == value_width {
                        true => (1, steps * value_width),
                        false => (steps, padded),
                    };
                    let lines = words.div_ceil(LINE);
                    for stretch in 0..stretches {
                        let from = block_values.wrapping_add(stretch * value_width);
                        for line in lines * r / tile.rows..lines * (r + 1) / tile.rows {
                            V::prefetch(from.wrapping_add(line * LINE).cast());
                        }
                    }
                }
                let probabilities = probabilities.add(r * KEY_BLOCK);
                let rescale = row.softmax::<S, V, A>(probabilities, max, running);
                if columns.first == 0
                    && let Some(weights) = call.weights(tile.head, tile.first + r)
                {
                    row.keep_weights::<S, A>(probabilities, rescale, weights);
                }
                if first > 0 {
                    for i in (0..padded).step_by(V::LANES) {
                        let at = sums.add(r * padded + i);
                        V::load(at).mul(V::splat(rescale)).store(at);
                    }
                }
            }
            let product = TileProduct {
                rows: tile.rows,
                factors: probabilities,
                factors_stride: KEY_BLOCK,
                b: block_values,
                b_step: value_width,
                b_vector: V::LANES,
                depth: count,
                out: sums,
                out_stride: padded,
                vectors: padded / V::LANES,
                add: first > 0,
            };
            if can_multiply {
                multiplier.multiply(simd, &product);
            } else {
                let removed = Removed {
                    mask: &call.mask,
                    head: tile.head,
                    first_query: tile.first,
                    first_key: first,
                    len,
                };
                product.without_removed::<S, V, A>(&removed);
            }
        }
        tile.results::<V>(columns, running, sums, padded);
    }
}

/// Keys between two updates of the running maximum.
fn keys_of_block(mask: &Mask<'_>, len: usize, multiple: usize) -> usize {
    match (mask, len.div_ceil(KEY_BLOCK)) {
        // Where a block ends must not depend on how many keys follow.
        (Mask::Causal { .. }, _) | (_, 0) => KEY_BLOCK,
        // Blocks of equal size, so that the last one is not a small rest.
        (_, blocks) => len.div_ceil(blocks).next_multiple_of(multiple),
    }
}

impl QueryTile<'_> {
    /// The scores of the keys in `block`, in rows of [`KEY_BLOCK`]; `factors` is memory for the queries.
    ///
    /// # Safety
    /// As [`attend`]. `keys` points to those of the head; `factors` and `scores` have room for the tile.
    #[inline(always)]
    unsafe fn scores<S: Simd<Vector = V>, V: Vector, A: TileArithmetic<S>, M: Multiply<S, A>>(
        &self,
        simd: S,
        multiplier: &mut M,
        keys: *const u32,
        block: Range<usize>,
        factors: *mut f32,
        scores: *mut f32,
    ) {
        let head_dim = self.call.kv.head_dim();
        for from in (0..head_dim).step_by(MAX_DEPTH) {
            let depth = MAX_DEPTH.min(head_dim - from);
            // SAFETY: the caller's promise.
            unsafe {
                // The queries stay for all blocks, unless they are too wide.
                if block.start == 0 || head_dim > MAX_DEPTH {
                    self.queries::<S, V, A>(from, depth, factors);
                }
                let steps = self.call.kv.key_steps();
                let product = TileProduct {
                    rows: self.rows,
                    factors,
                    factors_stride: MAX_DEPTH,
                    b: keys.add(block.start * steps + from / A::STEP * V::LANES),
                    b_step: V::LANES,
                    b_vector: V::LANES * steps,
                    depth,
                    out: scores,
                    out_stride: KEY_BLOCK,
                    vectors: block.len().div_ceil(V::LANES),
                    add: from > 0,
                };
                multiplier.multiply(simd, &product);
            }
        }
    }

    /// Divides the sums, in rows of `padded` elements, by those of the probabilities, and the probabilities as well if they are wanted.
    ///
    /// # Safety
    /// As [`attend`]. `sums` holds the tile.
    #[inline(always)]
    unsafe fn results<V: Vector>(
        &self,
        columns: &Columns,
        running: &[Running],
        sums: *const f32,
        padded: usize,
    ) {
        let (call, len) = (self.call, self.call.kv.len());
        let visible = call.mask.visible(self.first + self.rows - 1, len);
        for (r, running) in running.iter().enumerate() {
            // Nothing was added where no key is left: zeros divided by one.
            let divisor = if running.sum == 0.0 { 1.0 } else { running.sum };
            // SAFETY: the caller's promise; a row of the weights has an element for every key.
            unsafe {
                let out = call.out.offset((self.first + r) as isize * call.out_stride);
                let out = out.add(self.head * call.kv.head_dim() + columns.first);
                for i in (0..columns.count).step_by(V::LANES) {
                    let value = V::load(sums.add(r * padded + i)).div(V::splat(divisor));
                    store(value, out.add(i), V::LANES.min(columns.count - i));
                }
                if columns.first == 0
                    && let Some(weights) = call.weights(self.head, self.first + r)
                {
                    weights.add(visible).write_bytes(0, len - visible);
                    for i in (0..visible).step_by(V::LANES) {
                        let (at, lanes) = (weights.add(i), V::LANES.min(visible - i));
                        store(load::<V>(at, lanes).div(V::splat(divisor)), at, lanes);
                    }
                }
            }
        }
    }

    /// The scaled queries, columns `from .. from + depth` of the head, as factors in rows of [`MAX_DEPTH`]; zeros follow to whole pairs of
    /// vectors.
    ///
    /// # Safety
    /// The tile's rows and the columns are in the call's views; called within [`Simd::run`] of `S`.
    #[inline(always)]
    unsafe fn queries<S: Simd<Vector = V>, V: Vector, A: TileArithmetic<S>>(
        &self,
        from: usize,
        depth: usize,
        factors: *mut f32,
    ) {
        let scale = self.call.scale;
        for r in 0..self.rows {
            // SAFETY: the caller's promise; no more lanes are read than the row has.
            unsafe {
                let row = self
                    .call
                    .queries
                    .offset((self.first + r) as isize * self.call.queries_stride)
                    .add(self.head * self.call.kv.head_dim() + from);
                let scaled = |i: usize| {
                    let lanes = V::LANES.min(depth.saturating_sub(i));
                    load::<V>(row.wrapping_add(i), lanes).mul(V::splat(scale))
                };
                let factors = factors.add(r * MAX_DEPTH);
                for i in (0..depth).step_by(2 * V::LANES) {
                    A::store_factors(
                        scaled(i),
                        scaled(i + V::LANES),
                        factors.add(i * A::FACTORS / A::STEP),
                    );
                }
            }
        }
    }
}

impl Call<'_> {
    /// Where a row's weights begin, if they are wanted.
    #[inline(always)]
    fn weights(&self, head: usize, query: usize) -> Option<*mut f32> {
        let row = head * self.rows + query;
        self.weights
            .map(|weights| weights.wrapping_add(row * self.kv.len()))
    }
}
