//! Fused attention: scores, bias, stable softmax and the product with the values, block of keys by block of
//! keys, in registers and on the stack.
//!
//! Keys are packed vectors of keys wide and `head_dim`-major, so that scores of many keys come from one
//! broadcast query element; values stay key-major. Both products are the same micro-kernel, or tiles of a
//! unit for them. Softmax runs over fixed blocks of keys with a running maximum and sum for each query, so
//! that a query's bits depend on its row, the keys and the instruction set only.

mod arithmetic;
mod keys_values;
mod mask;
mod pack;
mod product;
mod queries;
mod softmax;

use crate::parts::part;
use crate::pool::parallel_for;
use crate::rows::{Rows, RowsMut, SharedRows};
use crate::weights::Element;
pub use keys_values::PackedKeyValues;
pub use mask::{LogitBias, Mask};
use queries::{AttendBf16, AttendF32, AttendInTiles, QueryBlock};

/// Multiply-adds from which a second thread pays: some 10 us of one core.
const MACS_FOR_THREADS: usize = 1 << 19;

/// `out[q] = softmax(q K^T * scale + bias) V` for each head, heads side by side, over the keys that `mask`
/// leaves.
///
/// `queries` and `out` are `(queries, num_heads * head_dim)`. The keys have as many heads, or a divisor of
/// it: then groups of `num_heads / num_kv_heads` consecutive heads share a head of the keys and values
/// (grouped-query attention). A query with no key left gets zeros. `weights`, if given, is
/// `(num_heads, queries, len)` and receives the probabilities; otherwise they are never in memory together.
///
/// Sums and the softmax are float32. Where pairs of bfloat16 are multiplied, by vectors or in tiles, and `kv`
/// holds them, queries and probabilities are rounded to bfloat16 too, the sum of a query's probabilities is
/// that of the rounded ones, and denormals may count as zero; elsewhere nothing but `kv` is rounded.
///
/// # Panics
/// If a shape does not fit.
///
/// ```
/// use saccade_vla_kernels::{Element, Isa, LogitBias, Mask, PackedKeyValues, Rows, RowsMut, attention};
/// let mut kv = PackedKeyValues::new(Isa::best(), Element::F32, 1, 1);
/// kv.pack(1, Rows::new(&[0.0, 0.0, 0.0], 1), Rows::new(&[1.0, 3.0, 100.0], 1)).unwrap();
/// let bias = LogitBias { values: &[0.0, 0.0, f32::NEG_INFINITY], head_stride: 0, query_stride: 0 };
/// let mut out = [0.0];
/// let queries = Rows::new(&[1.0], 1);
/// attention(1, queries, &kv, 1.0, Mask::Bias(bias), None, RowsMut::new(&mut out, 1));
/// assert_eq!(out, [2.0]);
/// ```
pub fn attention(
    threads: usize,
    queries: Rows<'_>,
    kv: &PackedKeyValues,
    scale: f32,
    mask: Mask<'_>,
    weights: Option<&mut [f32]>,
    out: RowsMut<'_>,
) {
    let (rows, width) = (queries.num_rows(), queries.num_columns());
    let num_heads = width / kv.head_dim();
    let fits = match kv.num_kv_heads() {
        0 => width == 0,
        num_kv_heads => width.is_multiple_of(kv.head_dim() * num_kv_heads),
    };
    assert!(
        fits,
        "queries: expected num_heads * {} columns with a multiple of {} as num_heads, got {width}",
        kv.head_dim(),
        kv.num_kv_heads()
    );
    assert_eq!(
        (out.num_rows(), out.num_columns()),
        (rows, width),
        "out: expected the shape of queries"
    );
    if let Some(weights) = &weights {
        assert!(
            holds(weights.len(), [num_heads, rows, kv.len()]),
            "weights: expected (num_heads, queries, len) = ({num_heads}, {rows}, {}), got {} elements",
            kv.len(),
            weights.len()
        );
    }
    if rows == 0 || num_heads == 0 {
        return;
    }
    mask.check(num_heads, rows, kv.len());
    let (head_dim, len) = (kv.head_dim(), kv.len());
    let weights = weights.map(|weights| RowsMut::strided(weights, num_heads * rows, len, len));
    let (out, weights) = (SharedRows::new(out), weights.map(SharedRows::new));
    let blocks = rows.div_ceil(kv.tile_rows());
    let macs = rows.saturating_mul(len).saturating_mul(width).saturating_mul(2);
    let threads = if macs < MACS_FOR_THREADS { 1 } else { threads };
    // Blocks of one head follow each other: its keys and values are then in the caches of all threads.
    parallel_for(threads, num_heads * blocks, &|task| {
        let (head, block) = (task / blocks, task % blocks);
        // Rows are dealt evenly: 49 are 7 blocks of 7, not 6 of 8 and one of 1.
        let rows_of_block = part(rows, block, blocks);
        let columns = head * head_dim..(head + 1) * head_dim;
        let weights_of_block = head * rows + rows_of_block.start..head * rows + rows_of_block.end;
        // SAFETY: each task has a head and a part of the rows that no other has, and runs once.
        let (out, weights) = unsafe {
            (
                out.block(rows_of_block.clone(), columns.clone()),
                weights
                    .as_ref()
                    .map(|weights| weights.block(weights_of_block, 0..len)),
            )
        };
        let block = &mut QueryBlock {
            kv,
            queries: queries.rows(rows_of_block.clone()).columns(columns),
            scale,
            mask: &mask,
            head,
            kv_head: head / (num_heads / kv.num_kv_heads()),
            first: rows_of_block.start,
            out,
            weights,
        };
        match kv.element() {
            Element::Bf16 if kv.isa().has_tiles() => kv.isa().run_tiles(&mut AttendInTiles(block)),
            Element::Bf16 => kv.isa().run(&mut AttendBf16(block)),
            _ => kv.isa().run(&mut AttendF32(block)),
        }
    });
}

/// Whether `len` elements are an array of these sizes. A product that wraps must not pass.
fn holds(len: usize, sizes: [usize; 3]) -> bool {
    let product = sizes
        .iter()
        .try_fold(1_usize, |product, &size| product.checked_mul(size));
    product == Some(len)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_whose_product_wraps_fit_no_array() {
        assert!(holds(24, [2, 3, 4]) && holds(0, [2, 0, 4]));
        let half = 1 << (usize::BITS / 2);
        for (len, sizes) in [
            (0, [1, half, half]),
            (0, [half, 2, half]),
            (2, [2, usize::MAX / 2 + 2, 1]),
        ] {
            assert!(!holds(len, sizes), "{sizes:?} in {len}");
        }
    }
}
