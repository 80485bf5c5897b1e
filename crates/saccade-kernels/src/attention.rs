//! Fused attention: scores, bias, stable softmax and the value product, block of keys by block of keys, in registers and on the stack.
//!
//! Keys are packed vectors of keys wide and `head_dim`-major, so that scores of many keys come from one broadcast query element; values stay
//! key-major. Both products are the same register tile. Softmax runs over fixed blocks of keys with a running maximum and sum
//! for each query, so that a query's bits depend on its row, the keys and the instruction set only.

mod packed;
mod tile;

use faer::{MatMut, MatRef};

use crate::linear::Element;
use crate::pool::parallel_for;
use crate::simd::{dispatch, dispatch_dots};
pub use packed::PackedKeyValues;
use tile::{Job, Tile, tile_rows};

/// Multiply-adds from which a second thread pays: some 10 us of one core.
const MACS_FOR_THREADS: usize = 1 << 19;

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
/// Sums and the softmax are float32. Where the CPU multiplies pairs of bfloat16 and `kv` holds them, queries and probabilities are rounded to
/// bfloat16 too, the sum of a query's probabilities is that of the rounded ones, and denormals may count as zero; elsewhere nothing but
/// `kv` is rounded.
///
/// # Panics
/// If a shape does not fit, or columns are not contiguous.
///
/// ```
/// use faer::{MatMut, MatRef};
/// use saccade_kernels::{Element, Isa, LogitBias, PackedKeyValues, attention};
/// let mut kv = PackedKeyValues::new(Isa::best(), Element::F32, 1, 1);
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
    let (rows, width) = (queries.nrows(), kv.num_heads() * kv.head_dim());
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
            kv.num_heads() * rows * kv.len(),
            "weights: expected (num_heads, queries, len)"
        );
    }
    if rows == 0 || kv.num_heads() == 0 {
        return;
    }
    if let Some(bias) = &bias {
        let needed = (kv.num_heads() - 1) * bias.head_stride + (rows - 1) * bias.query_stride + kv.len();
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
    let tiles = rows.div_ceil(tile_rows(kv.isa()));
    let threads = if 2 * rows * kv.len() * width < MACS_FOR_THREADS {
        1
    } else {
        threads
    };
    // Tiles of one head follow each other: its keys and values are then in the caches of all threads.
    parallel_for(threads, kv.num_heads() * tiles, &|task| {
        let (head, tile) = (task / tiles, task % tiles);
        // Rows are dealt evenly: 49 are 7 tiles of 7, not 6 of 8 and one of 1.
        let (first, end) = (rows * tile / tiles, rows * (tile + 1) / tiles);
        let tile = Tile {
            job: &job,
            head,
            first,
            rows: end - first,
        };
        match kv.element() {
            Element::Bf16 => dispatch_dots(kv.isa(), tile),
            _ => dispatch(kv.isa(), tile),
        }
    });
}
