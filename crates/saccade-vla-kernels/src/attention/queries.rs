//! A few queries of one head: scores, softmax and the product with the values, block of keys by block of
//! keys, on the stack and in registers.

use std::mem::MaybeUninit;
use std::ops::Range;

use super::arithmetic::{Bf16Products, Float32Products, StoredBf16, StoredF32, TileArithmetic};
use super::keys_values::PackedKeyValues;
use super::mask::Mask;
use super::product::{AttentionProduct, Multiply, Operands, Removed, VectorProducts};
use super::softmax::{Row, Running};
use crate::rows::{Rows, RowsMut};
use crate::simd::bits::write_uninit;
use crate::simd::slices::update;
use crate::simd::{Kernel, LINE, MAX_TILE_ROWS, Simd};
use crate::tiles::{MAX_ROWS, Session, TileKernel, TileUnit};

/// Keys between two updates of a query's running maximum, at most: whole pairs of vectors of every
/// instruction set.
const KEY_BLOCK: usize = 320;

/// Width of the values that one pass accumulates on the stack. Wider heads take more passes, each with its
/// own scores.
const MAX_VALUES: usize = 256;

/// Elements of the queries that are on the stack at a time: an even number of whole vectors. Wider heads take
/// more passes.
const MAX_DEPTH: usize = 256;

/// A few queries of one head.
pub(super) struct QueryBlock<'a> {
    pub kv: &'a PackedKeyValues,
    /// All columns of the head.
    pub queries: Rows<'a>,
    pub scale: f32,
    pub mask: &'a Mask<'a>,
    /// The number of the head.
    pub head: usize,
    /// The number of its keys and values.
    pub kv_head: usize,
    /// The number of the first query.
    pub first: usize,
    pub out: RowsMut<'a>,
    /// Of the queries' probabilities, if they are wanted: an element for each key.
    pub weights: Option<RowsMut<'a>>,
}

/// Attention over float32 keys and values.
pub(super) struct AttendF32<'a, 'b>(pub &'b mut QueryBlock<'a>);

/// Attention over bfloat16 keys and values.
pub(super) struct AttendBf16<'a, 'b>(pub &'b mut QueryBlock<'a>);

/// Attention over bfloat16 keys and values, by a unit that multiplies tiles.
pub(super) struct AttendInTiles<'a, 'b>(pub &'b mut QueryBlock<'a>);

impl Kernel for AttendF32<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        self.0
            .run::<S, Float32Products<StoredF32>, _, MAX_TILE_ROWS>(simd, &mut VectorProducts);
    }
}

impl Kernel for AttendBf16<'_, '_> {
    type Output = ();
    const USES_DOT_BF16: bool = true;

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        if S::HAS_DOT_BF16 {
            self.0
                .run::<S, Bf16Products, _, MAX_TILE_ROWS>(simd, &mut VectorProducts);
        } else {
            self.0
                .run::<S, Float32Products<StoredBf16>, _, MAX_TILE_ROWS>(simd, &mut VectorProducts);
        }
    }
}

impl TileKernel for AttendInTiles<'_, '_> {
    type Output = ();

    fn run<U: TileUnit>(&mut self, unit: U) {
        let block = &mut *self.0;
        unit.simd().run(&mut BesideUnit { block, unit });
    }
}

/// The same on the vectors beside the unit.
struct BesideUnit<'a, 'b, U> {
    block: &'b mut QueryBlock<'a>,
    unit: U,
}

impl<U: TileUnit> Kernel for BesideUnit<'_, '_, U> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        // SAFETY: no other session is open on this thread: products end theirs before they return.
        let mut session = unsafe { Session::new(self.unit) };
        self.block.run::<S, Bf16Products, _, MAX_ROWS>(simd, &mut session);
    }
}

/// Columns of a head's values.
#[derive(Clone, Copy)]
struct Columns {
    first: usize,
    count: usize,
}

/// Rows on the stack that are written before they are read.
#[repr(align(64))]
struct Scratch<const ROWS: usize, const N: usize>([[MaybeUninit<f32>; N]; ROWS]);

impl<const ROWS: usize, const N: usize> Scratch<ROWS, N> {
    #[inline(always)]
    fn new() -> Self {
        Self([const { [const { MaybeUninit::uninit() }; N] }; ROWS])
    }

    #[inline(always)]
    fn as_mut_ptr(&mut self) -> *mut f32 {
        self.0.as_mut_ptr().cast()
    }

    /// Rows of `num_columns` elements, `row_stride` apart.
    ///
    /// # Safety
    /// These elements were written.
    #[inline(always)]
    unsafe fn rows(&mut self, num_rows: usize, num_columns: usize, row_stride: usize) -> RowsMut<'_> {
        assert!(num_rows <= ROWS && num_columns <= row_stride && row_stride <= N);
        // SAFETY: the rows are within the scratch, which is borrowed for as long as they are; the caller has
        // written them.
        unsafe { RowsMut::from_raw(self.as_mut_ptr(), num_rows, num_columns, row_stride) }
    }
}

impl QueryBlock<'_> {
    /// The attention of the queries, at most `ROWS`.
    #[inline(always)]
    fn run<S: Simd, A: TileArithmetic<S>, M: Multiply<S, A>, const ROWS: usize>(
        &mut self,
        simd: S,
        multiplier: &mut M,
    ) {
        let head_dim = self.kv.head_dim();
        for first in (0..head_dim).step_by(MAX_VALUES) {
            let count = MAX_VALUES.min(head_dim - first);
            self.attend::<S, A, M, ROWS>(simd, multiplier, Columns { first, count });
        }
    }

    /// Some columns of the results.
    #[inline(always)]
    fn attend<S: Simd, A: TileArithmetic<S>, M: Multiply<S, A>, const ROWS: usize>(
        &mut self,
        simd: S,
        multiplier: &mut M,
        columns: Columns,
    ) {
        let (kv, mask, head, first_query) = (self.kv, self.mask, self.head, self.first);
        let (len, rows) = (kv.len(), self.queries.num_rows());
        let (padded, value_width) = (columns.count.next_multiple_of(S::LANES), kv.value_width());
        let mut factors = Scratch::<ROWS, MAX_DEPTH>::new();
        let mut scores = Scratch::<ROWS, KEY_BLOCK>::new();
        let mut sums = Scratch::<ROWS, MAX_VALUES>::new();
        let none = Running {
            max: f32::NEG_INFINITY,
            sum: 0.0,
        };
        let mut running = [none; ROWS];
        let running = &mut running[..rows];
        let mut maxima = [f32::NEG_INFINITY; ROWS];
        let block = keys_of_block(mask, len, M::KEYS);
        // None of these queries attends to keys beyond.
        let visible = mask.visible(first_query + rows - 1, len);
        // Whether zeros may be multiplied by the values of removed keys.
        let can_multiply = kv.is_finite() || matches!(mask, Mask::None);
        if visible == 0 || !can_multiply {
            sums.0.as_flattened_mut()[..rows * padded].fill(MaybeUninit::new(0.0));
        }
        for first in (0..visible).step_by(block) {
            let count = block.min(visible - first);
            self.scores(simd, multiplier, first..first + count, &mut factors, &mut scores);
            let (vectors, pairs) = (
                count.next_multiple_of(S::LANES),
                count.next_multiple_of(2 * S::LANES),
            );
            if vectors < pairs {
                for row in &mut scores.0[..rows] {
                    row[vectors..pairs].fill(MaybeUninit::new(0.0));
                }
            }
            // SAFETY: the product has written whole vectors, and the loop above the rest of whole pairs.
            let mut probabilities = unsafe { scores.rows(rows, pairs, KEY_BLOCK) };
            // SAFETY: after the first block, the product with its values has written the sums.
            let mut sums_so_far = (first > 0).then(|| unsafe { sums.rows(rows, padded, padded) });
            let row = |r: usize| Row {
                mask,
                head,
                query: first_query + r,
                len,
                first,
                count,
            };
            // All maxima before all exponentials: rows are then independent, and the CPU works on several of
            // them at once.
            for (r, (max, running)) in maxima.iter_mut().zip(running.iter()).enumerate() {
                *max = row(r).logits(simd, probabilities.row_mut(r), running.max);
            }
            let values = &kv.head_values(self.kv_head)[first / A::STEP * value_width + columns.first..];
            for (r, (running, &max)) in running.iter_mut().zip(&maxima).enumerate() {
                // The first block of a head's queries prefetches the values while it computes: from memory
                // they came at its bandwidth while nothing else was done (Intel with AMX).
                if first_query == 0 {
                    prefetch_values(
                        simd,
                        values,
                        count.div_ceil(A::STEP),
                        padded,
                        value_width,
                        (r, rows),
                    );
                }
                let row = row(r);
                let probabilities = probabilities.row_mut(r);
                let rescale = row.softmax::<S, A>(simd, probabilities, max, running);
                if columns.first == 0
                    && let Some(weights) = &mut self.weights
                {
                    row.keep_weights::<S, A>(probabilities, rescale, weights.row_mut(r));
                }
                if let Some(sums) = &mut sums_so_far {
                    for sums in sums.row_mut(r).chunks_exact_mut(S::LANES) {
                        simd.store(simd.mul(simd.load(sums), simd.splat(rescale)), sums);
                    }
                }
            }
            // SAFETY: `softmax` left the factors of `count` elements in each row, to whole pairs of vectors;
            // values have `padded` columns of every step; the sums of rows of `padded` elements have been
            // written if there was a block before, or zeros are to be added to.
            let product = unsafe {
                AttentionProduct::new(Operands {
                    rows,
                    factors: scores.as_mut_ptr(),
                    factors_stride: KEY_BLOCK,
                    b: values.as_ptr(),
                    b_step: value_width,
                    b_vector: S::LANES,
                    depth: count,
                    out: sums.as_mut_ptr(),
                    out_stride: padded,
                    vectors: padded / S::LANES,
                    add: first > 0,
                })
            };
            if can_multiply {
                multiplier.multiply(simd, &product);
            } else {
                let removed = Removed {
                    mask,
                    head,
                    first_query,
                    first_key: first,
                    len,
                };
                product.add_without_removed(simd, &removed);
            }
        }
        // SAFETY: the product with the values of the last block has written the sums; without a block they
        // were set to zero.
        let mut sums = unsafe { sums.rows(rows, padded, padded) };
        for (r, running) in running.iter().enumerate() {
            self.finish(simd, r, columns, running, sums.row_mut(r), visible);
        }
    }

    /// The scores of the keys in `block`, in whole vectors of each row. `factors` keeps the queries.
    #[inline(always)]
    fn scores<S: Simd, A: TileArithmetic<S>, M: Multiply<S, A>, const ROWS: usize>(
        &self,
        simd: S,
        multiplier: &mut M,
        block: Range<usize>,
        factors: &mut Scratch<ROWS, MAX_DEPTH>,
        scores: &mut Scratch<ROWS, KEY_BLOCK>,
    ) {
        let (head_dim, steps) = (self.kv.head_dim(), self.kv.key_steps());
        let keys = &self.kv.head_keys(self.kv_head)[block.start * steps..];
        for from in (0..head_dim).step_by(MAX_DEPTH) {
            let depth = MAX_DEPTH.min(head_dim - from);
            // The queries stay for all blocks, unless they are too wide.
            if block.start == 0 || head_dim > MAX_DEPTH {
                self.scale_queries::<S, A, ROWS>(simd, from..from + depth, factors);
            }
            // SAFETY: the factors of `depth` elements were written for each row, to whole pairs of vectors;
            // keys have a vector for every step, in whole vectors of keys; scores have room for the keys of a
            // block in whole vectors, and were written if they are to be added to.
            let product = unsafe {
                AttentionProduct::new(Operands {
                    rows: self.queries.num_rows(),
                    factors: factors.as_mut_ptr(),
                    factors_stride: MAX_DEPTH,
                    b: keys[from / A::STEP * S::LANES..].as_ptr(),
                    b_step: S::LANES,
                    b_vector: S::LANES * steps,
                    depth,
                    out: scores.as_mut_ptr(),
                    out_stride: KEY_BLOCK,
                    vectors: block.len().div_ceil(S::LANES),
                    add: from > 0,
                })
            };
            multiplier.multiply(simd, &product);
        }
    }

    /// Some columns of the scaled queries as factors; zeros follow to whole pairs of vectors.
    #[inline(always)]
    fn scale_queries<S: Simd, A: TileArithmetic<S>, const ROWS: usize>(
        &self,
        simd: S,
        columns: Range<usize>,
        factors: &mut Scratch<ROWS, MAX_DEPTH>,
    ) {
        let scale = simd.splat(self.scale);
        for (query, factors) in self.queries.iter().zip(&mut factors.0) {
            let factors = factors.chunks_exact_mut(2 * S::LANES * A::FACTORS / A::STEP);
            for (query, factors) in query[columns.clone()].chunks(2 * S::LANES).zip(factors) {
                let (first, second) = query.split_at(S::LANES.min(query.len()));
                let (first, second) = (simd.load_partial(first), simd.load_partial(second));
                let scaled = A::factors(simd, simd.mul(first, scale), simd.mul(second, scale));
                write_uninit(scaled, factors);
            }
        }
    }

    /// Divides the sums of query number `r` by that of its probabilities, and the probabilities as well if
    /// they are wanted.
    #[inline(always)]
    fn finish<S: Simd>(
        &mut self,
        simd: S,
        r: usize,
        columns: Columns,
        running: &Running,
        sums: &[f32],
        visible: usize,
    ) {
        // Nothing was added where no key is left: zeros divided by one.
        let divisor = simd.splat(if running.sum == 0.0 { 1.0 } else { running.sum });
        let out = &mut self.out.row_mut(r)[columns.first..][..columns.count];
        update(simd, out, [sums], |_, [sum]| simd.div(sum, divisor));
        if columns.first == 0
            && let Some(weights) = &mut self.weights
        {
            let (weights, removed) = weights.row_mut(r).split_at_mut(visible);
            update(simd, weights, [], |weight, []| simd.div(weight, divisor));
            removed.fill(0.0);
        }
    }
}

/// Prefetches a share of the values of a block, that of row `r` of `rows`.
#[inline(always)]
fn prefetch_values<S: Simd>(
    simd: S,
    values: &[u32],
    steps: usize,
    padded: usize,
    value_width: usize,
    (r, rows): (usize, usize),
) {
    // A pass of a wide head takes some columns of each step. Where it takes all of them, they are one stretch
    // of memory: a loop over steps there costs 2 % (Intel with AMX, bfloat16).
    let (stretches, words) = match padded == value_width {
        true => (1, steps * value_width),
        false => (steps, padded),
    };
    let lines = words.div_ceil(LINE);
    for stretch in 0..stretches {
        let from = values.as_ptr().wrapping_add(stretch * value_width);
        for line in lines * r / rows..lines * (r + 1) / rows {
            simd.prefetch(from.wrapping_add(line * LINE).cast());
        }
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
