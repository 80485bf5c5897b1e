//! The kernels' calls, each counted for the profile of the thread that makes it.

use faer::{MatMut, MatRef};
use saccade_kernels::{Epilogue, LinearScratch, LogitBias, PackedKeyValues, PackedLinear};

use crate::engine::Engine;
use crate::error::Result;
use crate::profile::{Part, counted};

/// `data` as rows of `width`.
pub(crate) fn rows(data: &[f32], width: usize) -> MatRef<'_, f32> {
    MatRef::from_row_major_slice(data, data.len() / width, width)
}

/// `data` as rows of `width`, to be written.
pub(crate) fn rows_mut(data: &mut [f32], width: usize) -> MatMut<'_, f32> {
    let count = data.len() / width;
    MatMut::from_row_major_slice_mut(data, count, width)
}

/// Whether the caller has asked this thread's call to stop: what kernels gave since then is not to be used.
///
/// # Errors
/// [`Error::Interrupted`](crate::Error::Interrupted) if so.
pub(crate) fn check_interrupted() -> Result<()> {
    Ok(())
}

/// [`PackedLinear::apply`] on rows that follow each other in memory.
pub(crate) fn linear(
    part: Option<Part>,
    layer: &PackedLinear,
    threads: usize,
    x: &[f32],
    epilogue: Epilogue,
    out: &mut [f32],
    scratch: &mut LinearScratch,
) -> Result<()> {
    let (x, out) = (rows(x, layer.in_features()), rows_mut(out, layer.out_features()));
    let multiply_adds = x.nrows() * layer.in_features() * layer.out_features();
    counted(part, (multiply_adds, layer.nbytes()), || {
        layer.apply(threads, x, epilogue, out, scratch);
    });
    check_interrupted()
}

/// [`saccade_kernels::attention`].
pub(crate) fn attention(
    threads: usize,
    queries: MatRef<'_, f32>,
    kv: &PackedKeyValues,
    scale: f32,
    bias: Option<LogitBias<'_>>,
    weights: Option<&mut [f32]>,
    out: MatMut<'_, f32>,
) -> Result<()> {
    let multiply_adds = 2 * queries.nrows() * kv.len() * queries.ncols();
    counted(Some(Part::Attention), (multiply_adds, kv.nbytes()), || {
        saccade_kernels::attention(threads, queries, kv, scale, bias, weights, out);
    });
    check_interrupted()
}

/// [`saccade_kernels::layer_norm`] of rows of `width` that follow each other in memory.
pub(crate) fn layer_norm(
    engine: Engine,
    width: usize,
    eps: f32,
    scale_shift: Option<(&[f32], &[f32])>,
    x: &[f32],
    out: &mut [f32],
) -> Result<()> {
    let (x, out) = (rows(x, width), rows_mut(out, width));
    counted(Some(Part::Norm), (0, 0), || {
        saccade_kernels::layer_norm(engine.isa, engine.threads, x, eps, scale_shift, out);
    });
    check_interrupted()
}

/// [`PackedKeyValues::pack_from`]; from 0 it is [`PackedKeyValues::pack`].
pub(crate) fn pack(
    threads: usize,
    packed: &mut PackedKeyValues,
    first: usize,
    keys: MatRef<'_, f32>,
    values: MatRef<'_, f32>,
) -> Result<()> {
    counted(Some(Part::Pack), (0, 0), || match first {
        0 => packed.pack(threads, keys, values),
        _ => packed.pack_from(threads, first, keys, values),
    });
    check_interrupted()
}

/// No keys yet, of the type in which `engine` holds them.
pub(crate) fn no_keys_values(engine: Engine, num_heads: usize, head_dim: usize) -> PackedKeyValues {
    PackedKeyValues::new(engine.isa, engine.precision.keys_values(), num_heads, head_dim)
}
