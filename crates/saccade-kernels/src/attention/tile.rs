//! A few queries of one head: both products, the softmax between them, and the registers they live in.

use std::marker::PhantomData;
use std::mem::MaybeUninit;

use half::bf16;

use super::{Mask, PackedKeyValues};
use crate::isa::Isa;
use crate::simd::{Dot, DotKernel, Dots, Kernel, Vector, dispatch, dispatch_dots, load, store};

/// Keys between two updates of a query's running maximum, at most: whole pairs of vectors of every instruction set.
const KEY_BLOCK: usize = 320;

/// Rows of the largest tile, over all instruction sets.
const MAX_ROWS: usize = 8;

/// Width of the values that one pass accumulates on the stack. Wider heads take more passes, each with its own scores.
const MAX_VALUES: usize = 256;

/// Elements of the queries that are on the stack at a time: an even number of whole vectors. Wider heads take more passes.
const MAX_DEPTH: usize = 256;

/// Queries of the largest tile: as many as keep the accumulators in registers, and hide the latency of the multiply-adds.
pub(super) fn tile_rows(isa: Isa) -> usize {
    match isa {
        Isa::Portable => 4,
        Isa::Avx2 | Isa::Avx2Vnni => 6,
        Isa::Avx512f | Isa::Avx512 => 8,
    }
}

pub(super) struct Job<'a> {
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
unsafe impl Sync for Job<'_> {}

/// A few queries of one head.
pub(super) struct Tile<'a> {
    pub job: &'a Job<'a>,
    pub head: usize,
    pub first: usize,
    pub rows: usize,
}

/// Of float32 keys and values.
impl Kernel for Tile<'_> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<V: Vector>(self) {
        // SAFETY: the caller has the instruction set; keys and values are float32.
        unsafe { self.run_as::<V, Float32<Plain>>() }
    }
}

/// Of bfloat16 keys and values.
impl DotKernel for Tile<'_> {
    type Output = ();

    const DOT: Dot = Dot::Bf16;

    #[inline(always)]
    unsafe fn run<V: Vector, D: Dots<V>>(self) {
        // SAFETY: the caller has the instruction set and the dot product; keys and values are pairs of bfloat16.
        unsafe {
            if D::HAS_BF16 {
                self.run_as::<V, Pairs<D>>();
            } else {
                self.run_as::<V, Float32<Widened>>();
            }
        }
    }
}

impl Tile<'_> {
    /// # Safety
    /// The CPU has the instruction set of `V`; keys and values are held as `A` reads them.
    #[inline(always)]
    unsafe fn run_as<V: Vector, A: Arithmetic<V>>(&self) {
        let dims = self.job.kv.head_dim();
        for first in (0..dims).step_by(MAX_VALUES) {
            let columns = Columns {
                first,
                count: MAX_VALUES.min(dims - first),
            };
            // SAFETY: the rows and columns are in the job's views; the rest is the caller's promise.
            unsafe { attend::<V, A>(self, &columns) }
        }
    }
}

/// How keys and values are held, and what multiplies them. A word of them is met by one or two broadcast factors, words too, that are made
/// from queries and probabilities.
///
/// # Safety
/// Every method needs a CPU that has the instruction set of `V`, and pointers that are valid for all that it names.
trait Arithmetic<V: Vector> {
    /// Elements of the summed dimension in a word of keys or values.
    const STEP: usize;
    /// Factors that meet it, one after the other.
    const FACTORS: usize;
    /// Keeps `2 * LANES` elements as factors.
    unsafe fn store_factors(first: V, second: V, to: *mut f32);
    /// Adds them to `sum`, as they are kept.
    unsafe fn add_factors(sum: V, first: V, second: V, kept: *const f32) -> V;
    /// Element number `index` of what [`Self::store_factors`] kept.
    unsafe fn element(factors: *const f32, index: usize) -> f32;
    /// A vector of factors, or of what they multiply.
    type Operand: Copy;
    /// Every lane the factor at `from`.
    unsafe fn broadcast(from: *const f32) -> Self::Operand;
    /// What factor number `part` of a word multiplies.
    unsafe fn column(from: *const u32, part: usize) -> Self::Operand;
    /// `sum` and the products of factor and column.
    unsafe fn multiply_add(factor: Self::Operand, column: Self::Operand, sum: V) -> V;
    /// Element number `part` of each word of values.
    unsafe fn widen(from: *const u32, part: usize) -> V;
    /// `exp(x)` for `x <= 0`, NaN where it is NaN.
    unsafe fn exp(x: V) -> V;
    /// A product in a piece of code of its own: its tiles are many, and compilers take minutes over them.
    unsafe fn multiply(product: &Product);
}

/// How keys and values are held where products are of float32.
trait Stored {
    /// Elements of a word.
    const STEP: usize;

    /// Element number `part` of each word.
    ///
    /// # Safety
    /// A whole vector of words is there; the CPU has the instruction set of `V`.
    unsafe fn widen<V: Vector>(from: *const u32, part: usize) -> V;
}

/// float32.
struct Plain;

impl Stored for Plain {
    const STEP: usize = 1;

    #[inline(always)]
    unsafe fn widen<V: Vector>(from: *const u32, _: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { V::load(from.cast()) }
    }
}

/// Pairs of bfloat16, widened in registers: the bits of float32 with the same keys and values.
struct Widened;

impl Stored for Widened {
    const STEP: usize = 2;

    #[inline(always)]
    unsafe fn widen<V: Vector>(from: *const u32, part: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe {
            let words = V::load_ints(from.cast());
            if part == 0 {
                V::low_halves(words)
            } else {
                V::high_halves(words)
            }
        }
    }
}

/// Products of float32, of keys and values held as `S`.
struct Float32<S>(PhantomData<S>);

impl<V: Vector, S: Stored> Arithmetic<V> for Float32<S> {
    const STEP: usize = S::STEP;
    const FACTORS: usize = S::STEP;
    type Operand = V;

    #[inline(always)]
    unsafe fn store_factors(first: V, second: V, to: *mut f32) {
        // SAFETY: the trait's contract; so throughout.
        unsafe {
            first.store(to);
            second.store(to.add(V::LANES));
        }
    }

    #[inline(always)]
    unsafe fn element(factors: *const f32, index: usize) -> f32 {
        // SAFETY: as above.
        unsafe { *factors.add(index) }
    }

    #[inline(always)]
    unsafe fn add_factors(sum: V, first: V, second: V, _: *const f32) -> V {
        // SAFETY: as above.
        unsafe { sum.add(first).add(second) }
    }

    #[inline(always)]
    unsafe fn broadcast(from: *const f32) -> V {
        // SAFETY: as above.
        unsafe { V::splat(*from) }
    }

    #[inline(always)]
    unsafe fn column(from: *const u32, part: usize) -> V {
        // SAFETY: as above.
        unsafe { S::widen(from, part) }
    }

    #[inline(always)]
    unsafe fn multiply_add(factor: V, column: V, sum: V) -> V {
        // SAFETY: as above.
        unsafe { factor.fma(column, sum) }
    }

    #[inline(always)]
    unsafe fn widen(from: *const u32, part: usize) -> V {
        // SAFETY: as above.
        unsafe { S::widen(from, part) }
    }

    #[inline(always)]
    unsafe fn exp(x: V) -> V {
        // SAFETY: as above.
        unsafe { exp_below_zero(x, &EXP2) }
    }

    #[inline(always)]
    unsafe fn multiply(product: &Product) {
        let stored = PhantomData::<S>;
        dispatch(product.isa, ProductKernel { product, stored });
    }
}

/// Products of pairs of bfloat16 in one instruction, summed in float32: queries and probabilities are rounded too.
struct Pairs<D>(PhantomData<D>);

impl<V: Vector, D: Dots<V>> Arithmetic<V> for Pairs<D> {
    const STEP: usize = 2;
    const FACTORS: usize = 1;
    type Operand = V::Ints;

    #[inline(always)]
    unsafe fn store_factors(first: V, second: V, to: *mut f32) {
        // SAFETY: the trait's contract; so throughout.
        unsafe { D::store_bf16(first, second, to.cast()) }
    }

    #[inline(always)]
    unsafe fn add_factors(sum: V, _: V, _: V, kept: *const f32) -> V {
        /// Two times 1 in bfloat16.
        const ONES: i32 = 0x3f80_3f80;
        // SAFETY: as above.
        unsafe { D::bf16(sum, V::load_ints(kept.cast()), V::splat_int(ONES)) }
    }

    #[inline(always)]
    unsafe fn element(factors: *const f32, index: usize) -> f32 {
        // SAFETY: as above.
        bf16::from_bits(unsafe { *factors.cast::<u16>().add(index) }).to_f32()
    }

    #[inline(always)]
    unsafe fn broadcast(from: *const f32) -> V::Ints {
        // SAFETY: as above.
        unsafe { V::splat_int(*from.cast()) }
    }

    #[inline(always)]
    unsafe fn column(from: *const u32, _: usize) -> V::Ints {
        // SAFETY: as above.
        unsafe { V::load_ints(from.cast()) }
    }

    #[inline(always)]
    unsafe fn multiply_add(factor: V::Ints, column: V::Ints, sum: V) -> V {
        // SAFETY: as above.
        unsafe { D::bf16(sum, factor, column) }
    }

    #[inline(always)]
    unsafe fn widen(from: *const u32, part: usize) -> V {
        // SAFETY: as above.
        unsafe { Widened::widen(from, part) }
    }

    #[inline(always)]
    unsafe fn exp(x: V) -> V {
        // SAFETY: as above.
        unsafe { exp_below_zero(x, &EXP2_FOR_BF16) }
    }

    #[inline(always)]
    unsafe fn multiply(product: &Product) {
        dispatch_dots(product.isa, PairProduct(product));
    }
}

/// `2^r` for `|r| <= 1/2`, highest power first: least relative error among the polynomials of this degree that are 1 at 0; 8e-8 evaluated in
/// float32.
const EXP2: [f32; 7] = [
    1.535_336_2e-4,
    1.339_887_5e-3,
    9.618_437e-3,
    5.550_332_4e-2,
    0.240_226_48,
    std::f32::consts::LN_2,
    1.0,
];

/// The same of degree 3; 1.02e-4, a fortieth of what rounding to bfloat16 may change.
const EXP2_FOR_BF16: [f32; 4] = [5.500_893_3e-2, 0.242_210_97, 0.693_282_9, 1.0];

/// `exp(x)` for `x <= 0` by a polynomial for `2^r`; 0 below -104, NaN where it is NaN.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn exp_below_zero<V: Vector, const N: usize>(x: V, polynomial: &[f32; N]) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        // Below, the result is 0, and the whole part stays small. The second operand wins if it is NaN.
        let x = V::splat(-105.0).max(x);
        let log2_e = V::splat(std::f32::consts::LOG2_E);
        let whole = x.mul(log2_e).round();
        let rest = x.fma(log2_e, V::splat(0.0).sub(whole));
        let mut power = V::splat(polynomial[0]);
        for &coefficient in &polynomial[1..] {
            power = power.fma(rest, V::splat(coefficient));
        }
        power.scale_by_power_of_two(whole)
    }
}

/// Columns of a head's values.
struct Columns {
    first: usize,
    count: usize,
}

#[repr(align(64))]
struct Scratch<const N: usize>([MaybeUninit<f32>; N]);

impl<const N: usize> Scratch<N> {
    #[inline(always)]
    fn new() -> Self {
        Self([const { MaybeUninit::uninit() }; N])
    }

    #[inline(always)]
    fn pointer(&mut self) -> *mut f32 {
        self.0.as_mut_ptr().cast()
    }
}

/// The running softmax of one query.
#[derive(Clone, Copy)]
struct Running {
    /// Largest logit so far.
    max: f32,
    /// Sum of `exp(logit - max)` so far.
    sum: f32,
}

/// Attention of a tile's queries.
///
/// # Safety
/// The tile's rows and the columns are in the job's views; the CPU has the instruction set of `V`; keys and values are held as `A` reads
/// them.
#[inline(always)]
unsafe fn attend<V: Vector, A: Arithmetic<V>>(tile: &Tile<'_>, columns: &Columns) {
    let (job, kv) = (tile.job, tile.job.kv);
    let (len, padded) = (kv.len(), columns.count.next_multiple_of(V::LANES));
    let value_width = kv.value_width();
    let mut factors = Scratch::<{ MAX_ROWS * MAX_DEPTH }>::new();
    let factors = factors.pointer();
    let mut probabilities = Scratch::<{ MAX_ROWS * KEY_BLOCK }>::new();
    let probabilities = probabilities.pointer();
    let mut sums = Scratch::<{ MAX_ROWS * MAX_VALUES }>::new();
    let sums = sums.pointer();
    let mut running = [Running {
        max: f32::NEG_INFINITY,
        sum: 0.0,
    }; MAX_ROWS];
    let running = &mut running[..tile.rows];
    let block = match (job.mask, len.div_ceil(KEY_BLOCK)) {
        // Where a block ends must not depend on how many keys follow.
        (Mask::Causal { .. }, _) | (_, 0) => KEY_BLOCK,
        // Blocks of equal size, so that the last one is not a small rest.
        (_, blocks) => len.div_ceil(blocks).next_multiple_of(V::LANES),
    };
    // Keys beyond are seen by none of these queries.
    let visible = job.mask.visible(tile.first + tile.rows - 1, len);
    let kv_head = tile.head / job.heads_per_kv_head;
    // SAFETY: the scratch holds as many rows as a tile may have, of MAX_DEPTH factors, KEY_BLOCK probabilities and `padded` sums; blocks end at the last key, whose
    // vector is padded in the keys; everything else is the caller's promise.
    unsafe {
        for i in (0..tile.rows * padded).step_by(V::LANES) {
            V::splat(0.0).store(sums.add(i));
        }
        let keys = kv.head_keys(kv_head).as_ptr();
        let values = kv.head_values(kv_head).as_ptr();
        for first in (0..visible).step_by(block) {
            let count = block.min(visible - first);
            for from in (0..kv.head_dim()).step_by(MAX_DEPTH) {
                let depth = MAX_DEPTH.min(kv.head_dim() - from);
                // The queries stay for all blocks, unless they are too wide.
                if first == 0 || kv.head_dim() > MAX_DEPTH {
                    tile.queries::<V, A>(from, depth, factors);
                }
                let steps = kv.head_dim().div_ceil(A::STEP);
                let product = Product {
                    isa: kv.isa(),
                    rows: tile.rows,
                    factors,
                    factors_stride: MAX_DEPTH,
                    b: keys.add(first * steps + from / A::STEP * V::LANES),
                    b_step: V::LANES,
                    b_vector: V::LANES * steps,
                    depth,
                    out: probabilities,
                    out_stride: KEY_BLOCK,
                    vectors: count.div_ceil(V::LANES),
                    add: from > 0,
                };
                A::multiply(&product);
            }
            for (r, running) in running.iter_mut().enumerate() {
                let row = Row {
                    job,
                    head: tile.head,
                    query: tile.first + r,
                    first,
                    count,
                };
                let probabilities = probabilities.add(r * KEY_BLOCK);
                let rescale = row.softmax::<V, A>(probabilities, running);
                if columns.first == 0 {
                    row.keep_weights::<V, A>(probabilities, rescale);
                }
                for i in (0..padded).step_by(V::LANES) {
                    let at = sums.add(r * padded + i);
                    V::load(at).mul(V::splat(rescale)).store(at);
                }
            }
            let product = Product {
                isa: kv.isa(),
                rows: tile.rows,
                factors: probabilities,
                factors_stride: KEY_BLOCK,
                b: values.add(first / A::STEP * value_width + columns.first),
                b_step: value_width,
                b_vector: V::LANES,
                depth: count,
                out: sums,
                out_stride: padded,
                vectors: padded / V::LANES,
                add: true,
            };
            if kv.is_finite() || matches!(job.mask, Mask::None) {
                A::multiply(&product);
            } else {
                product.without_removed::<V, A>(tile, first);
            }
        }
        for (r, running) in running.iter().enumerate() {
            // Nothing was added where no key is left: zeros divided by one.
            let divisor = if running.sum == 0.0 { 1.0 } else { running.sum };
            let out = job.out.offset((tile.first + r) as isize * job.out_stride);
            let out = out.add(tile.head * kv.head_dim() + columns.first);
            for i in (0..columns.count).step_by(V::LANES) {
                let value = V::load(sums.add(r * padded + i)).div(V::splat(divisor));
                store(value, out.add(i), V::LANES.min(columns.count - i));
            }
            if columns.first == 0
                && let Some(weights) = job.weights(tile.head, tile.first + r)
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

impl Tile<'_> {
    /// The scaled queries, columns `from .. from + depth` of the head, as factors in rows of [`MAX_DEPTH`]; zeros follow to whole pairs of
    /// vectors.
    ///
    /// # Safety
    /// The tile's rows and the columns are in the job's views; the CPU has the instruction set of `V`.
    #[inline(always)]
    unsafe fn queries<V: Vector, A: Arithmetic<V>>(&self, from: usize, depth: usize, factors: *mut f32) {
        let scale = self.job.scale;
        for r in 0..self.rows {
            // SAFETY: the caller's promise; no more lanes are read than the row has.
            unsafe {
                let row = self
                    .job
                    .queries
                    .offset((self.first + r) as isize * self.job.queries_stride)
                    .add(self.head * self.job.kv.head_dim() + from);
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

/// One query and a block of keys.
struct Row<'a> {
    job: &'a Job<'a>,
    head: usize,
    query: usize,
    first: usize,
    count: usize,
}

impl Job<'_> {
    /// Where a row's weights begin, if they are wanted.
    #[inline(always)]
    fn weights(&self, head: usize, query: usize) -> Option<*mut f32> {
        let row = head * self.rows + query;
        self.weights
            .map(|weights| weights.wrapping_add(row * self.kv.len()))
    }
}

impl Row<'_> {
    /// Turns the scores of a block into probabilities relative to the running maximum, kept as factors in their place, with zeros to whole
    /// pairs of vectors. Returns the factor by which sums so far change.
    ///
    /// # Safety
    /// `scores` points to the block's scores in whole pairs of vectors, the last of which may be missing; the CPU has the instruction set
    /// of `V`.
    #[inline(always)]
    unsafe fn softmax<V: Vector, A: Arithmetic<V>>(&self, scores: *mut f32, running: &mut Running) -> f32 {
        let len = self.job.kv.len();
        let bias = self.job.mask.bias(self.head, self.query, len);
        let bias = bias.map(|bias| bias[self.first..].as_ptr());
        // Those of the block that this query sees; the rest is as if removed.
        let seen = self.job.mask.visible(self.query, len).saturating_sub(self.first);
        let seen = seen.min(self.count);
        // SAFETY: the caller's promise; the bias has `count` elements from here on.
        unsafe {
            let removed = V::splat(f32::NEG_INFINITY);
            let mut max = V::splat(running.max);
            for i in (0..self.count).step_by(V::LANES) {
                let lanes = V::LANES.min(self.count - i);
                let mut logits = V::load(scores.add(i));
                if let Some(bias) = bias {
                    let bias = load::<V>(bias.add(i), lanes);
                    logits = logits.add(bias).replace_where(bias, removed);
                    logits.store(scores.add(i));
                }
                if i + V::LANES > seen {
                    // Lanes beyond the last key: as if removed.
                    let from = i.max(seen);
                    removed.store_partial(scores.add(from), i + V::LANES - from);
                    logits = V::load(scores.add(i));
                }
                max = logits.max(max);
            }
            let max = max.reduce_max();
            // All logits so far are -inf: anything finite makes them zeros.
            let shift = if max == f32::NEG_INFINITY { 0.0 } else { max };
            let rescale = first_lane(A::exp(V::splat(running.max - shift)));
            let shift = V::splat(shift);
            let mut sum = V::splat(0.0);
            for i in (0..self.count).step_by(2 * V::LANES) {
                let first = A::exp(V::load(scores.add(i)).sub(shift));
                let second = if i + V::LANES < self.count {
                    A::exp(V::load(scores.add(i + V::LANES)).sub(shift))
                } else {
                    V::splat(0.0)
                };
                let kept = scores.add(i * A::FACTORS / A::STEP);
                A::store_factors(first, second, kept);
                // Of what the values are multiplied with, so that the weights of a query add up to 1.
                sum = A::add_factors(sum, first, second, kept);
            }
            *running = Running {
                max,
                sum: running.sum * rescale + sum.reduce_add(),
            };
            rescale
        }
    }

    /// Keeps the probabilities of a block as they are used, if they are wanted, and rescales those of the blocks before.
    ///
    /// # Safety
    /// `factors` are what [`Self::softmax`] left; the CPU has the instruction set of `V`.
    #[inline(always)]
    unsafe fn keep_weights<V: Vector, A: Arithmetic<V>>(&self, factors: *const f32, rescale: f32) {
        let Some(weights) = self.job.weights(self.head, self.query) else {
            return;
        };
        // SAFETY: the caller's promise; a row of the weights has an element for every key.
        unsafe {
            for key in 0..self.first {
                *weights.add(key) *= rescale;
            }
            for index in 0..self.count {
                *weights.add(self.first + index) = A::element(factors, index);
            }
        }
    }
}

/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn first_lane<V: Vector>(vector: V) -> f32 {
    let mut lane = 0.0;
    // SAFETY: one lane, one element.
    unsafe { vector.store_partial(&raw mut lane, 1) };
    lane
}

/// `out[r][v] (+)= sum over k of a[r][k] b[k][v]`: few rows, and vectors for columns.
struct Product {
    isa: Isa,
    rows: usize,
    /// `a`, as factors.
    factors: *const f32,
    factors_stride: usize,
    b: *const u32,
    /// Words from one step over `k` to the next.
    b_step: usize,
    /// Words from one vector to the next.
    b_vector: usize,
    /// Elements over which is summed.
    depth: usize,
    out: *mut f32,
    out_stride: usize,
    /// Columns, in whole vectors.
    vectors: usize,
    /// Whether to add to what `out` holds.
    add: bool,
}

struct ProductKernel<'a, S> {
    product: &'a Product,
    stored: PhantomData<S>,
}

impl<S: Stored> Kernel for ProductKernel<'_, S> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<V: Vector>(self) {
        // SAFETY: the promise to `Arithmetic::multiply`; the caller has the instruction set.
        unsafe { self.product.run::<V, Float32<S>>() }
    }
}

/// The same of pairs.
struct PairProduct<'a>(&'a Product);

impl DotKernel for PairProduct<'_> {
    type Output = ();

    const DOT: Dot = Dot::Bf16;

    #[inline(always)]
    unsafe fn run<V: Vector, D: Dots<V>>(self) {
        // SAFETY: the promise to `Arithmetic::multiply`; the caller has the instruction set and the dot product.
        unsafe { self.0.run::<V, Pairs<D>>() }
    }
}

impl Product {
    /// All of it.
    ///
    /// # Safety
    /// The pointers are valid for all rows, `depth` elements in whole steps and all vectors; the CPU has the instruction set of `V`.
    #[inline(always)]
    unsafe fn run<V: Vector, A: Arithmetic<V>>(&self) {
        // SAFETY: the caller's promise.
        unsafe {
            match self.rows {
                1 => self.all::<V, A, 1>(),
                2 => self.all::<V, A, 2>(),
                3 => self.all::<V, A, 3>(),
                4 => self.all::<V, A, 4>(),
                // Only where there are registers for them.
                5 if V::REGISTERS > 8 => self.all::<V, A, 5>(),
                6 if V::REGISTERS > 8 => self.all::<V, A, 6>(),
                7 if V::REGISTERS > 16 => self.all::<V, A, 7>(),
                8 if V::REGISTERS > 16 => self.all::<V, A, 8>(),
                rows => unreachable!("a tile of {rows} rows"),
            }
        }
    }

    /// All columns of `MR` rows, a few at a time.
    ///
    /// # Safety
    /// As [`Self::run`].
    #[inline(always)]
    unsafe fn all<V: Vector, A: Arithmetic<V>, const MR: usize>(&self) {
        let most = match V::REGISTERS {
            8 => 1,
            16 => 2,
            _ => 3,
        };
        let groups = self.vectors.div_ceil(most);
        for group in 0..groups {
            let first = self.vectors * group / groups;
            let end = self.vectors * (group + 1) / groups;
            // SAFETY: the caller's promise.
            unsafe {
                match end - first {
                    1 => self.tile::<V, A, MR, 1>(first),
                    2 if V::REGISTERS > 8 => self.tile::<V, A, MR, 2>(first),
                    3 if V::REGISTERS > 16 => self.tile::<V, A, MR, 3>(first),
                    vectors => unreachable!("a tile of {vectors} vectors"),
                }
            }
        }
    }

    /// `NV` vectors from `first` on.
    ///
    /// # Safety
    /// As [`Self::run`].
    #[inline(always)]
    unsafe fn tile<V: Vector, A: Arithmetic<V>, const MR: usize, const NV: usize>(&self, first: usize) {
        // SAFETY: the caller's promise.
        unsafe {
            let out = self.out.add(first * V::LANES);
            let mut acc = [[V::splat(0.0); NV]; MR];
            if self.add {
                for (r, row) in acc.iter_mut().enumerate() {
                    for (v, sum) in row.iter_mut().enumerate() {
                        *sum = V::load(out.add(r * self.out_stride + v * V::LANES));
                    }
                }
            }
            let mut b = self.b.add(first * self.b_vector);
            let mut factors = self.factors;
            for _ in 0..self.depth.div_ceil(A::STEP) {
                for part in 0..A::FACTORS {
                    let mut columns = [A::column(b, part); NV];
                    for (v, column) in columns.iter_mut().enumerate().skip(1) {
                        *column = A::column(b.add(v * self.b_vector), part);
                    }
                    for (r, row) in acc.iter_mut().enumerate() {
                        let factor = A::broadcast(factors.add(r * self.factors_stride + part));
                        for (sum, &column) in row.iter_mut().zip(&columns) {
                            *sum = A::multiply_add(factor, column, *sum);
                        }
                    }
                }
                b = b.wrapping_add(self.b_step);
                factors = factors.wrapping_add(A::FACTORS);
            }
            for (r, row) in acc.iter().enumerate() {
                for (v, sum) in row.iter().enumerate() {
                    sum.store(out.add(r * self.out_stride + v * V::LANES));
                }
            }
        }
    }

    /// Adds as [`Self::run`] does, where values are not all finite: keys that the bias removes are passed over, because zero times infinity
    /// is not zero.
    ///
    /// # Safety
    /// As [`Self::run`].
    #[inline(always)]
    unsafe fn without_removed<V: Vector, A: Arithmetic<V>>(&self, tile: &Tile<'_>, first: usize) {
        for r in 0..self.rows {
            let (query, len) = (tile.first + r, tile.job.kv.len());
            let bias = tile.job.mask.bias(tile.head, query, len);
            let seen = tile.job.mask.visible(query, len);
            for k in 0..self.depth.min(seen.saturating_sub(first)) {
                if bias.is_some_and(|bias| bias[first + k] == f32::NEG_INFINITY) {
                    continue;
                }
                // SAFETY: the caller's promise.
                unsafe {
                    let factor = V::splat(A::element(self.factors.add(r * self.factors_stride), k));
                    for v in 0..self.vectors {
                        let value = A::widen(
                            self.b.add(k / A::STEP * self.b_step + v * self.b_vector),
                            k % A::STEP,
                        );
                        let at = self.out.add(r * self.out_stride + v * V::LANES);
                        factor.fma(value, V::load(at)).store(at);
                    }
                }
            }
        }
    }
}
