//! Fused attention: scores, bias, stable softmax and the value product, block of keys by block of keys, in registers and on the stack.
//!
//! Keys are packed vectors of keys wide and `head_dim`-major, so that scores of many keys come from one broadcast query element; values stay
//! key-major. Both products are the same register tile. Softmax runs over fixed blocks of [`KEY_BLOCK`] keys with a running maximum and sum
//! for each query, so that a query's bits depend on its row, the keys and the instruction set only.

use std::mem::MaybeUninit;
use std::sync::atomic::{AtomicBool, Ordering};

use faer::{MatMut, MatRef};

use crate::activation::exp_vector;
use crate::aligned::AlignedBuffer;
use crate::isa::Isa;
use crate::pool::parallel_for;
use crate::simd::{Kernel, Vector, dispatch, lanes, load, store};

/// Keys between two updates of a query's running maximum: whole vectors and whole tiles of every instruction set.
const KEY_BLOCK: usize = 96;

/// Rows of the largest tile, over all instruction sets.
const MAX_ROWS: usize = 8;

/// Width of the values that one pass accumulates on the stack. Wider heads take more passes, each with its own scores.
const MAX_VALUES: usize = 256;

/// Multiply-adds from which a second thread pays: some 10 us of one core.
const MACS_FOR_THREADS: usize = 1 << 19;

/// Keys and values of one sequence, all heads, in the layout that [`attention`] reads.
///
/// ```
/// use faer::MatRef;
/// use saccade_kernels::{Isa, PackedKeyValues};
/// let (keys, values) = ([1.0; 12], [2.0; 12]); // three keys of two heads of width 2
/// let mut kv = PackedKeyValues::new(Isa::best(), 2, 2);
/// kv.pack(1, MatRef::from_row_major_slice(&keys, 3, 4), MatRef::from_row_major_slice(&values, 3, 4));
/// assert_eq!(kv.len(), 3);
/// ```
#[derive(Clone)]
pub struct PackedKeyValues {
    isa: Isa,
    num_heads: usize,
    head_dim: usize,
    len: usize,
    /// `[head][vector of keys][head_dim][lane]`; lanes beyond the last key are zero.
    keys: AlignedBuffer<f32>,
    /// `[head][key][head_dim]`, each row padded with zeros to whole vectors.
    values: AlignedBuffer<f32>,
    /// Zero times any value is zero: removed keys need no care in the product.
    finite: bool,
}

impl PackedKeyValues {
    /// Holds no key yet.
    ///
    /// # Panics
    /// If this CPU lacks `isa`, or `head_dim` is 0.
    #[must_use]
    pub fn new(isa: Isa, num_heads: usize, head_dim: usize) -> Self {
        assert!(head_dim > 0, "head_dim: expected at least 1");
        assert!(isa.is_available(), "this CPU lacks {isa}");
        let empty = || AlignedBuffer::zeroed(0);
        Self {
            isa,
            num_heads,
            head_dim,
            len: 0,
            keys: empty(),
            values: empty(),
            finite: true,
        }
    }

    /// Replaces what is held by `keys` and `values`, `(len, num_heads * head_dim)` each, row-major with any row stride.
    /// Memory is claimed only if this needs more than ever before.
    ///
    /// # Panics
    /// If a shape does not fit, or columns are not contiguous.
    pub fn pack(&mut self, threads: usize, keys: MatRef<'_, f32>, values: MatRef<'_, f32>) {
        self.len = keys.nrows();
        let (keys_size, values_size) = (self.keys_of_head(), self.values_of_head());
        reserve(&mut self.keys, self.num_heads * keys_size);
        reserve(&mut self.values, self.num_heads * values_size);
        self.finite = true;
        self.pack_from(threads, 0, keys, values);
    }

    /// Replaces the keys and values from number `first` to the end; the others stay as they are.
    ///
    /// # Panics
    /// If there are not as many of them as are replaced, a shape does not fit, or columns are not contiguous.
    pub fn pack_from(
        &mut self,
        threads: usize,
        first: usize,
        keys: MatRef<'_, f32>,
        values: MatRef<'_, f32>,
    ) {
        let width = self.num_heads * self.head_dim;
        let count = keys.nrows();
        assert_eq!(
            first + count,
            self.len,
            "keys: expected all that are held from number {first} on"
        );
        assert_eq!(keys.ncols(), width, "keys: expected num_heads * head_dim columns");
        assert_eq!(
            (values.nrows(), values.ncols()),
            (count, width),
            "values: expected the shape of keys"
        );
        assert!(
            keys.col_stride() == 1 || width <= 1,
            "keys: expected contiguous rows"
        );
        assert!(
            values.col_stride() == 1 || width <= 1,
            "values: expected contiguous rows"
        );
        if count == 0 || width == 0 {
            return;
        }
        let (keys_size, values_size) = (self.keys_of_head(), self.values_of_head());
        let finite = AtomicBool::new(self.finite);
        let job = Pack {
            first,
            keys,
            values,
            keys_to: self.keys.as_mut_ptr(),
            values_to: self.values.as_mut_ptr(),
            lanes: lanes(self.isa),
            head_dim: self.head_dim,
        };
        let threads = if 2 * count * width < ELEMENTS_FOR_THREADS {
            1
        } else {
            threads
        };
        parallel_for(threads, self.num_heads, &|head| {
            // SAFETY: heads write their own parts of the two buffers, which have room for all of them.
            let head_is_finite = unsafe { job.head(head, keys_size, values_size) };
            if !head_is_finite {
                finite.store(false, Ordering::Relaxed);
            }
        });
        self.finite = finite.into_inner();
    }

    /// Number of keys.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it holds no key.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Number of heads.
    #[must_use]
    pub fn num_heads(&self) -> usize {
        self.num_heads
    }

    /// Width of a head's queries, keys and values.
    #[must_use]
    pub fn head_dim(&self) -> usize {
        self.head_dim
    }

    /// The instruction set whose layout this is.
    #[must_use]
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Bytes held.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        size_of::<f32>() * (self.keys.len() + self.values.len())
    }

    fn keys_of_head(&self) -> usize {
        self.len.next_multiple_of(lanes(self.isa)) * self.head_dim
    }

    fn values_of_head(&self) -> usize {
        self.len * self.head_dim.next_multiple_of(lanes(self.isa))
    }
}

/// Elements from which packing on a second thread pays.
const ELEMENTS_FOR_THREADS: usize = 1 << 16;

fn reserve(buffer: &mut AlignedBuffer<f32>, elements: usize) {
    if buffer.len() < elements {
        *buffer = AlignedBuffer::zeroed(elements);
    }
}

struct Pack<'a> {
    /// Number of the first key that is replaced.
    first: usize,
    keys: MatRef<'a, f32>,
    values: MatRef<'a, f32>,
    keys_to: *mut f32,
    values_to: *mut f32,
    lanes: usize,
    head_dim: usize,
}

// SAFETY: tasks read the views and write different heads of the buffers.
unsafe impl Sync for Pack<'_> {}

impl Pack<'_> {
    /// Packs one head; returns whether its values are all finite.
    ///
    /// # Safety
    /// The buffers have room for `head + 1` heads of the given sizes, and nobody else touches this one.
    unsafe fn head(&self, head: usize, keys_size: usize, values_size: usize) -> bool {
        // SAFETY: the caller's promise.
        let (keys_to, values_to) = unsafe {
            (
                std::slice::from_raw_parts_mut(self.keys_to.add(head * keys_size), keys_size),
                std::slice::from_raw_parts_mut(self.values_to.add(head * values_size), values_size),
            )
        };
        let (lanes, head_dim) = (self.lanes, self.head_dim);
        let row = |of: MatRef<'_, f32>, key: usize| {
            // SAFETY: the row is in the view, its columns are contiguous, and the head's are among them.
            unsafe {
                let start = of
                    .as_ptr()
                    .offset(key as isize * of.row_stride())
                    .add(head * head_dim);
                std::slice::from_raw_parts(start, head_dim)
            }
        };
        let count = self.keys.nrows();
        let end = self.first + count;
        for key in self.first..end.next_multiple_of(lanes) {
            let to = keys_to[key / lanes * lanes * head_dim + key % lanes..]
                .iter_mut()
                .step_by(lanes)
                .take(head_dim);
            if key < end {
                to.zip(row(self.keys, key - self.first))
                    .for_each(|(to, &from)| *to = from);
            } else {
                to.for_each(|to| *to = 0.0);
            }
        }
        let mut finite = true;
        let padded = head_dim.next_multiple_of(lanes);
        for (index, to) in values_to[self.first * padded..]
            .chunks_exact_mut(padded)
            .enumerate()
        {
            let from = row(self.values, index);
            finite &= from.iter().fold(true, |finite, value| finite & value.is_finite());
            to[..head_dim].copy_from_slice(from);
            to[head_dim..].fill(0.0);
        }
        finite
    }
}

/// What is added to the logits: element `(head, query, key)` is `values[head * head_stride + query * query_stride + key]`.
///
/// A stride of 0 repeats a row. `f32::NEG_INFINITY` removes a key: neither it nor its value then has any influence.
#[derive(Clone, Copy, Debug)]
pub struct LogitBias<'a> {
    /// Rows of one element per key.
    pub values: &'a [f32],
    /// Elements from a head's rows to the next one's.
    pub head_stride: usize,
    /// Elements from a query's row to the next one's.
    pub query_stride: usize,
}

/// `out[q] = softmax(q K^T * scale + bias) V` for each head, heads side by side.
///
/// `queries` and `out` are `(queries, num_heads * head_dim)`, row-major with any row stride. A query with no key left gets zeros. `weights`,
/// if given, is `(num_heads, queries, len)` and receives the probabilities; otherwise they are never in memory together.
///
/// # Panics
/// If a shape does not fit, or columns are not contiguous.
///
/// ```
/// use faer::{MatMut, MatRef};
/// use saccade_kernels::{Isa, LogitBias, PackedKeyValues, attention};
/// let mut kv = PackedKeyValues::new(Isa::best(), 1, 1);
/// let (keys, values) = ([0.0, 0.0, 0.0], [1.0, 3.0, 100.0]);
/// kv.pack(1, MatRef::from_row_major_slice(&keys, 3, 1), MatRef::from_row_major_slice(&values, 3, 1));
/// let bias = LogitBias { values: &[0.0, 0.0, f32::NEG_INFINITY], head_stride: 0, query_stride: 0 };
/// let (query, mut out) = ([1.0], [0.0]);
/// let queries = MatRef::from_row_major_slice(&query, 1, 1);
/// attention(1, queries, &kv, 1.0, Some(bias), None, MatMut::from_row_major_slice_mut(&mut out, 1, 1));
/// assert_eq!(out, [2.0]);
/// ```
pub fn attention(
    threads: usize,
    queries: MatRef<'_, f32>,
    kv: &PackedKeyValues,
    scale: f32,
    bias: Option<LogitBias<'_>>,
    weights: Option<&mut [f32]>,
    out: MatMut<'_, f32>,
) {
    let (rows, width) = (queries.nrows(), kv.num_heads * kv.head_dim);
    assert_eq!(
        queries.ncols(),
        width,
        "queries: expected num_heads * head_dim columns"
    );
    assert_eq!(
        (out.nrows(), out.ncols()),
        (rows, width),
        "out: expected the shape of queries"
    );
    assert!(
        queries.col_stride() == 1 || width <= 1,
        "queries: expected contiguous rows"
    );
    assert!(
        out.col_stride() == 1 || width <= 1,
        "out: expected contiguous rows"
    );
    if let Some(weights) = &weights {
        assert_eq!(
            weights.len(),
            kv.num_heads * rows * kv.len,
            "weights: expected (num_heads, queries, len)"
        );
    }
    if rows == 0 || kv.num_heads == 0 {
        return;
    }
    if let Some(bias) = &bias {
        let needed = (kv.num_heads - 1) * bias.head_stride + (rows - 1) * bias.query_stride + kv.len;
        assert!(
            bias.values.len() >= needed,
            "bias: expected {needed} elements, got {}",
            bias.values.len()
        );
    }
    let job = Job {
        kv,
        queries: queries.as_ptr(),
        queries_stride: queries.row_stride(),
        rows,
        scale,
        bias,
        weights: weights.map(<[f32]>::as_mut_ptr),
        out_stride: out.row_stride(),
        out: out.as_ptr_mut(),
    };
    let tiles = rows.div_ceil(tile_rows(kv.isa));
    let threads = if 2 * rows * kv.len * width < MACS_FOR_THREADS {
        1
    } else {
        threads
    };
    // Tiles of one head follow each other: its keys and values are then in the caches of all threads.
    parallel_for(threads, kv.num_heads * tiles, &|task| {
        let (head, tile) = (task / tiles, task % tiles);
        // Rows are dealt evenly: 49 are 7 tiles of 7, not 6 of 8 and one of 1.
        let (first, end) = (rows * tile / tiles, rows * (tile + 1) / tiles);
        dispatch(
            kv.isa,
            Tile {
                job: &job,
                head,
                first,
                rows: end - first,
            },
        );
    });
}

/// Queries of the largest tile: as many as keep the accumulators in registers, and hide the latency of the multiply-adds.
fn tile_rows(isa: Isa) -> usize {
    match isa {
        Isa::Portable => 4,
        Isa::Avx2 | Isa::Avx2Vnni => 6,
        Isa::Avx512f | Isa::Avx512 => 8,
    }
}

struct Job<'a> {
    kv: &'a PackedKeyValues,
    queries: *const f32,
    queries_stride: isize,
    rows: usize,
    scale: f32,
    bias: Option<LogitBias<'a>>,
    weights: Option<*mut f32>,
    out: *mut f32,
    out_stride: isize,
}

// SAFETY: tasks read the queries and write different (head, query) parts of `out` and `weights`; all views are borrowed for the whole call.
unsafe impl Sync for Job<'_> {}

impl Job<'_> {
    /// The bias of one query, one element per key.
    fn bias(&self, head: usize, row: usize) -> Option<&[f32]> {
        let bias = self.bias.as_ref()?;
        Some(&bias.values[head * bias.head_stride + row * bias.query_stride..][..self.kv.len])
    }
}

/// A few queries of one head.
struct Tile<'a> {
    job: &'a Job<'a>,
    head: usize,
    first: usize,
    rows: usize,
}

impl Kernel for Tile<'_> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<V: Vector>(self) {
        let dims = self.job.kv.head_dim;
        for first in (0..dims).step_by(MAX_VALUES) {
            let columns = Columns {
                first,
                count: MAX_VALUES.min(dims - first),
            };
            // SAFETY: the rows and columns are in the job's views; the caller has the instruction set.
            unsafe {
                match self.rows {
                    1 => attend::<V, 1>(&self, &columns),
                    2 => attend::<V, 2>(&self, &columns),
                    3 => attend::<V, 3>(&self, &columns),
                    4 => attend::<V, 4>(&self, &columns),
                    // Only where there are registers for them.
                    5 if V::REGISTERS > 8 => attend::<V, 5>(&self, &columns),
                    6 if V::REGISTERS > 8 => attend::<V, 6>(&self, &columns),
                    7 if V::REGISTERS > 16 => attend::<V, 7>(&self, &columns),
                    8 if V::REGISTERS > 16 => attend::<V, 8>(&self, &columns),
                    rows => unreachable!("a tile of {rows} rows"),
                }
            }
        }
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

/// Attention of `MR` queries of one head.
///
/// # Safety
/// The tile's rows and the columns are in the job's views; the CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn attend<V: Vector, const MR: usize>(tile: &Tile<'_>, columns: &Columns) {
    let (job, kv) = (tile.job, tile.job.kv);
    let padded = columns.count.next_multiple_of(V::LANES);
    let value_width = kv.head_dim.next_multiple_of(V::LANES);
    let mut probabilities = Scratch::<{ MAX_ROWS * KEY_BLOCK }>::new();
    let probabilities = probabilities.pointer();
    let mut sums = Scratch::<{ MAX_ROWS * MAX_VALUES }>::new();
    let sums = sums.pointer();
    let mut running = [Running {
        max: f32::NEG_INFINITY,
        sum: 0.0,
    }; MR];
    // SAFETY: the scratch holds MR rows of KEY_BLOCK probabilities and of `padded` sums; blocks end at the last key, whose vector is
    // padded in `keys`; everything else is the caller's promise.
    unsafe {
        for i in (0..MR * padded).step_by(V::LANES) {
            V::splat(0.0).store(sums.add(i));
        }
        let queries = job
            .queries
            .offset(tile.first as isize * job.queries_stride)
            .add(tile.head * kv.head_dim);
        let keys = kv.keys.as_ptr().add(tile.head * kv.keys_of_head());
        let values = kv
            .values
            .as_ptr()
            .add(tile.head * kv.values_of_head() + columns.first);
        for first in (0..kv.len).step_by(KEY_BLOCK) {
            let count = KEY_BLOCK.min(kv.len - first);
            let product = Product {
                a: queries,
                a_stride: job.queries_stride,
                b: keys.add(first * kv.head_dim),
                b_step: V::LANES,
                b_vector: V::LANES * kv.head_dim,
                depth: kv.head_dim,
                out: probabilities,
                out_stride: KEY_BLOCK,
            };
            product.all::<V, MR, false>(count.div_ceil(V::LANES));
            for (r, running) in running.iter_mut().enumerate() {
                let row = Row {
                    job,
                    head: tile.head,
                    query: tile.first + r,
                    first,
                    count,
                };
                let rescale = row.softmax::<V>(probabilities.add(r * KEY_BLOCK), running);
                for i in (0..padded).step_by(V::LANES) {
                    let at = sums.add(r * padded + i);
                    V::load(at).mul(V::splat(rescale)).store(at);
                }
            }
            let product = Product {
                a: probabilities,
                a_stride: KEY_BLOCK as isize,
                b: values.add(first * value_width),
                b_step: value_width,
                b_vector: V::LANES,
                depth: count,
                out: sums,
                out_stride: padded,
            };
            if kv.finite || job.bias.is_none() {
                product.all::<V, MR, true>(padded / V::LANES);
            } else {
                product.without_removed::<V>(tile, first, MR, padded / V::LANES);
            }
        }
        for (r, running) in running.iter().enumerate() {
            // Nothing was added where no key is left: zeros divided by one.
            let divisor = if running.sum == 0.0 { 1.0 } else { running.sum };
            let out = job.out.offset((tile.first + r) as isize * job.out_stride);
            let out = out.add(tile.head * kv.head_dim + columns.first);
            for i in (0..columns.count).step_by(V::LANES) {
                let value = V::load(sums.add(r * padded + i)).div(V::splat(divisor));
                let lanes = V::LANES.min(columns.count - i);
                if lanes == V::LANES {
                    value.store(out.add(i))
                } else {
                    value.store_partial(out.add(i), lanes)
                }
            }
            if columns.first == 0 {
                let row = Row {
                    job,
                    head: tile.head,
                    query: tile.first + r,
                    first: 0,
                    count: kv.len,
                };
                row.normalise_weights::<V>(running, divisor);
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

/// What is taken off the logits before `exp`: their maximum, unless all of them are `-inf`.
#[inline(always)]
fn finite_max(max: f32) -> f32 {
    if max == f32::NEG_INFINITY { 0.0 } else { max }
}

impl Row<'_> {
    /// Where this row's weights begin, if they are wanted.
    #[inline(always)]
    unsafe fn weights(&self) -> Option<*mut f32> {
        let row = self.head * self.job.rows + self.query;
        // SAFETY: `(num_heads, queries, len)`, checked by `attention`.
        self.job
            .weights
            .map(|weights| unsafe { weights.add(row * self.job.kv.len) })
    }

    /// Turns the scores of a block into probabilities relative to the running maximum. Returns the factor by which sums so far change.
    ///
    /// # Safety
    /// `scores` points to the block's scores in whole vectors; the CPU has the instruction set of `V`.
    #[inline(always)]
    unsafe fn softmax<V: Vector>(&self, scores: *mut f32, running: &mut Running) -> f32 {
        let bias = self
            .job
            .bias(self.head, self.query)
            .map(|bias| bias[self.first..].as_ptr());
        let removed = f32::NEG_INFINITY;
        // SAFETY: the caller's promise; the bias has `count` elements from here on, and so have the weights.
        unsafe {
            let weights = self.weights().map(|weights| weights.add(self.first));
            let mut max = V::splat(running.max);
            for i in (0..self.count).step_by(V::LANES) {
                let lanes = V::LANES.min(self.count - i);
                let mut logits = V::load(scores.add(i)).mul(V::splat(self.job.scale));
                if let Some(bias) = bias {
                    let bias = load::<V>(bias.add(i), lanes);
                    logits = logits.add(bias).replace_where(bias, V::splat(removed));
                }
                if let Some(weights) = weights {
                    store(logits, weights.add(i), lanes);
                }
                logits.store(scores.add(i));
                if lanes < V::LANES {
                    // Lanes beyond the last key: as if removed.
                    for lane in lanes..V::LANES {
                        *scores.add(i + lane) = removed;
                    }
                    logits = V::load(scores.add(i));
                }
                max = logits.max(max);
            }
            let max = max.reduce_max();
            let shift = V::splat(finite_max(max));
            let rescale = exp_vector(V::splat(running.max).sub(shift));
            let mut sum = V::splat(0.0);
            for i in (0..self.count).step_by(V::LANES) {
                let probability = exp_vector(V::load(scores.add(i)).sub(shift));
                probability.store(scores.add(i));
                sum = sum.add(probability);
            }
            let rescale = first_lane(rescale);
            *running = Running {
                max,
                sum: running.sum * rescale + sum.reduce_add(),
            };
            rescale
        }
    }

    /// Turns the logits that [`Self::softmax`] left in the weights into probabilities.
    ///
    /// # Safety
    /// All blocks of this row are done; the CPU has the instruction set of `V`.
    #[inline(always)]
    unsafe fn normalise_weights<V: Vector>(&self, running: &Running, divisor: f32) {
        // SAFETY: the caller's promise; `count` is the number of keys.
        unsafe {
            let Some(weights) = self.weights() else { return };
            for i in (0..self.count).step_by(V::LANES) {
                let lanes = V::LANES.min(self.count - i);
                let logits = load::<V>(weights.add(i), lanes);
                let probability =
                    exp_vector(logits.sub(V::splat(finite_max(running.max)))).div(V::splat(divisor));
                store(probability, weights.add(i), lanes);
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
    a: *const f32,
    a_stride: isize,
    b: *const f32,
    /// Elements from one `k` to the next.
    b_step: usize,
    /// Elements from one vector to the next.
    b_vector: usize,
    depth: usize,
    out: *mut f32,
    out_stride: usize,
}

impl Product {
    /// All columns: `vectors` of them, a few at a time. `ADD` adds to what `out` holds.
    ///
    /// # Safety
    /// The pointers are valid for `MR` rows, `depth` steps and `vectors` whole vectors; the CPU has the instruction set of `V`.
    #[inline(always)]
    unsafe fn all<V: Vector, const MR: usize, const ADD: bool>(&self, vectors: usize) {
        let most = match V::REGISTERS {
            8 => 1,
            16 => 2,
            _ => 3,
        };
        let groups = vectors.div_ceil(most);
        for group in 0..groups {
            let (first, end) = (vectors * group / groups, vectors * (group + 1) / groups);
            // SAFETY: the caller's promise.
            unsafe {
                match end - first {
                    1 => self.tile::<V, MR, 1, ADD>(first),
                    2 => self.tile::<V, MR, 2, ADD>(first),
                    _ => self.tile::<V, MR, 3, ADD>(first),
                }
            }
        }
    }

    /// `NV` vectors from `first` on.
    ///
    /// # Safety
    /// As [`Self::all`].
    #[inline(always)]
    unsafe fn tile<V: Vector, const MR: usize, const NV: usize, const ADD: bool>(&self, first: usize) {
        // SAFETY: the caller's promise.
        unsafe {
            let out = self.out.add(first * V::LANES);
            let mut acc = [[V::splat(0.0); NV]; MR];
            if ADD {
                for (r, row) in acc.iter_mut().enumerate() {
                    for (v, sum) in row.iter_mut().enumerate() {
                        *sum = V::load(out.add(r * self.out_stride + v * V::LANES));
                    }
                }
            }
            let mut a = [self.a; MR];
            for (r, a) in a.iter_mut().enumerate() {
                *a = self.a.offset(r as isize * self.a_stride);
            }
            let mut b = self.b.add(first * self.b_vector);
            for k in 0..self.depth {
                let mut columns = [V::splat(0.0); NV];
                for (v, column) in columns.iter_mut().enumerate() {
                    *column = V::load(b.add(v * self.b_vector));
                }
                for r in 0..MR {
                    let x = V::splat(*a[r].add(k));
                    for v in 0..NV {
                        acc[r][v] = x.fma(columns[v], acc[r][v]);
                    }
                }
                b = b.wrapping_add(self.b_step);
            }
            for (r, row) in acc.iter().enumerate() {
                for (v, sum) in row.iter().enumerate() {
                    sum.store(out.add(r * self.out_stride + v * V::LANES));
                }
            }
        }
    }

    /// As [`Self::all`] with `ADD`, where values are not all finite: keys that the bias removes are passed over, because zero times infinity
    /// is not zero.
    ///
    /// # Safety
    /// As [`Self::all`].
    #[inline(always)]
    unsafe fn without_removed<V: Vector>(&self, tile: &Tile<'_>, first: usize, rows: usize, vectors: usize) {
        for r in 0..rows {
            let bias = tile.job.bias(tile.head, tile.first + r);
            for k in 0..self.depth {
                if bias.is_some_and(|bias| bias[first + k] == f32::NEG_INFINITY) {
                    continue;
                }
                // SAFETY: the caller's promise.
                unsafe {
                    let one = Self {
                        a: self.a.offset(r as isize * self.a_stride).add(k),
                        b: self.b.add(k * self.b_step),
                        depth: 1,
                        out: self.out.add(r * self.out_stride),
                        ..*self
                    };
                    one.all::<V, 1, true>(vectors);
                }
            }
        }
    }
}
