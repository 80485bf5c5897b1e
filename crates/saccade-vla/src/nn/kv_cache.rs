//! KV caches: packed keys and values, in the element type that an engine's precision asks for, and the
//! attention to them.

use saccade_vla_kernels::{Mask, PackedKeyValues, Rows, RowsMut};

use crate::engine::Engine;
use crate::error::Result;
use crate::ops::{kernel, refused};
use crate::profile::Part;

/// An empty KV cache.
pub(crate) fn empty(engine: Engine, num_heads: usize, head_dim: usize) -> PackedKeyValues {
    PackedKeyValues::new(engine.isa, engine.precision.keys_values(), num_heads, head_dim)
}

/// An empty KV cache with capacity for `capacity` keys.
pub(crate) fn with_capacity(
    engine: Engine,
    [num_heads, head_dim]: [usize; 2],
    capacity: usize,
) -> Result<PackedKeyValues> {
    let mut cache = empty(engine, num_heads, head_dim);
    cache.reserve(capacity).map_err(refused("keys and values"))?;
    Ok(cache)
}

/// A copy of the first `len` keys and values of a cache, with capacity for `capacity`.
pub(crate) fn first(cache: &PackedKeyValues, len: usize, capacity: usize) -> Result<PackedKeyValues> {
    let copy = cache.try_clone_first(len, capacity);
    copy.map_err(refused("keys and values"))
}

/// Makes a cache hold its first `first` keys and values, followed by these.
pub(crate) fn replace_from(
    engine: Engine,
    cache: &mut PackedKeyValues,
    first: usize,
    keys: Rows<'_>,
    values: Rows<'_>,
) -> Result<()> {
    let packed = kernel(Some(Part::Pack), (0, 0), || match first {
        0 => cache.pack(engine.threads, keys, values),
        _ => {
            cache.pack_from(engine.threads, first, keys, values);
            Ok(())
        }
    });
    packed?.map_err(refused("keys and values"))
}

/// Appends keys and values.
pub(crate) fn append(
    engine: Engine,
    cache: &mut PackedKeyValues,
    keys: Rows<'_>,
    values: Rows<'_>,
) -> Result<()> {
    let packed = kernel(Some(Part::Pack), (0, 0), || {
        cache.append(engine.threads, keys, values)
    });
    packed?.map_err(refused("keys and values"))
}

/// `out = softmax(queries keys^T / sqrt(head_dim) + mask) values`; `probabilities (heads, queries, keys)`, if
/// given, receives the softmax.
pub(crate) fn attend(
    engine: Engine,
    queries: Rows<'_>,
    cache: &PackedKeyValues,
    mask: Mask<'_>,
    probabilities: Option<&mut [f32]>,
    out: RowsMut<'_>,
) -> Result<()> {
    let keys: usize = match mask {
        Mask::Causal { offset } => (offset..offset + queries.num_rows())
            .map(|before| cache.len().min(before + 1))
            .sum(),
        _ => queries.num_rows() * cache.len(),
    };
    let multiply_adds = 2 * keys * queries.num_columns();
    let scale = 1.0 / (cache.head_dim() as f32).sqrt();
    kernel(Some(Part::Attention), (multiply_adds, cache.nbytes()), || {
        saccade_vla_kernels::attention(engine.threads, queries, cache, scale, mask, probabilities, out);
    })
}
