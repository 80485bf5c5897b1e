//! The kernels' calls: each counted for the profile of the thread that makes it, its refusals and interruptions made errors.

use saccade_vla_kernels::{
    AllocError, Epilogue, KernelError, LinearScratch, Mask, PackedKeyValues, PackedLinear, Rows, RowsMut,
};

use crate::engine::Engine;
use crate::error::{Error, Result};
use crate::profile::{Part, counted, counted_by};

/// Runs `work`, and asks `poll` every 20 ms or so whether to stop it.
///
/// `poll` is called on this thread, between the tasks of every kernel that `work` calls, between blocks and between tensors. Once it returns
/// true, `work` ends soon, however large it is. A head, a layer or a checkpoint that was in use stays usable.
///
/// # Errors
/// [`Error::Interrupted`] if `poll` returned true, otherwise those of `work`.
///
/// ```
/// use saccade_vla::{Error, interruptible};
/// assert_eq!(interruptible(&|| false, || Ok(7)).unwrap(), 7);
/// let stopped = interruptible(&|| true, || Err::<(), _>(Error::Interrupted));
/// assert!(matches!(stopped, Err(Error::Interrupted)));
/// ```
pub fn interruptible<R>(poll: &dyn Fn() -> bool, work: impl FnOnce() -> Result<R>) -> Result<R> {
    saccade_vla_kernels::interruptible(poll, work).unwrap_or(Err(Error::Interrupted))
}

/// Whether an [`interruptible`] call that this code runs in is to stop: what kernels gave since then is not to be used.
///
/// # Errors
/// [`Error::Interrupted`] if so.
pub(crate) fn check_interrupted() -> Result<()> {
    if saccade_vla_kernels::interrupted() {
        return Err(Error::Interrupted);
    }
    Ok(())
}

/// `data` as rows of `width`.
pub(crate) fn rows(data: &[f32], width: usize) -> Rows<'_> {
    Rows::new(data, width)
}

/// `data` as rows of `width`, to be written.
pub(crate) fn rows_mut(data: &mut [f32], width: usize) -> RowsMut<'_> {
    RowsMut::new(data, width)
}

/// The error for memory that a kernel was refused.
pub(crate) fn refused(what: &'static str) -> impl Fn(AllocError) -> Error {
    move |AllocError { bytes }| Error::Memory { what, bytes }
}

/// The error for a layer that was not packed.
pub(crate) fn packing_error(error: KernelError) -> Error {
    match error {
        KernelError::Alloc(error) => refused("weights")(error),
        KernelError::Interrupted(_) => Error::Interrupted,
        other => Error::Packing(other),
    }
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
    let multiply_adds = x.num_rows() * layer.in_features() * layer.out_features();
    let (kernel, work) = (layer.kernel_name(), (multiply_adds, layer.nbytes()));
    let applied = counted_by(Some(kernel), part, work, || {
        layer.apply(threads, x, epilogue, out, scratch)
    });
    applied.map_err(refused("activations"))?;
    check_interrupted()
}

/// [`saccade_vla_kernels::attention`].
pub(crate) fn attention(
    threads: usize,
    queries: Rows<'_>,
    kv: &PackedKeyValues,
    scale: f32,
    mask: Mask<'_>,
    weights: Option<&mut [f32]>,
    out: RowsMut<'_>,
) -> Result<()> {
    let keys: usize = match mask {
        Mask::Causal { offset } => (offset..offset + queries.num_rows())
            .map(|before| kv.len().min(before + 1))
            .sum(),
        _ => queries.num_rows() * kv.len(),
    };
    let multiply_adds = 2 * keys * queries.num_columns();
    counted(Some(Part::Attention), (multiply_adds, kv.nbytes()), || {
        saccade_vla_kernels::attention(threads, queries, kv, scale, mask, weights, out);
    });
    check_interrupted()
}

/// [`saccade_vla_kernels::layer_norm`] of rows of `width` that follow each other in memory.
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
        saccade_vla_kernels::layer_norm(engine.isa, engine.threads, x, eps, scale_shift, out);
    });
    check_interrupted()
}

/// [`saccade_vla_kernels::rms_norm`].
pub(crate) fn rms_norm(
    engine: Engine,
    eps: f32,
    weight: &[f32],
    x: Rows<'_>,
    out: RowsMut<'_>,
) -> Result<()> {
    counted(Some(Part::Norm), (0, 0), || {
        saccade_vla_kernels::rms_norm(engine.isa, engine.threads, x, eps, weight, out);
    });
    check_interrupted()
}

/// [`saccade_vla_kernels::rms_norm_in_place`].
pub(crate) fn rms_norm_in_place(engine: Engine, eps: f32, weight: &[f32], x: RowsMut<'_>) -> Result<()> {
    counted(Some(Part::Norm), (0, 0), || {
        saccade_vla_kernels::rms_norm_in_place(engine.isa, engine.threads, x, eps, weight);
    });
    check_interrupted()
}

/// [`saccade_vla_kernels::rotary_embedding`].
pub(crate) fn rotary_embedding(
    engine: Engine,
    x: RowsMut<'_>,
    head_dim: usize,
    cos: Rows<'_>,
    sin: Rows<'_>,
) -> Result<()> {
    counted(Some(Part::Pack), (0, 0), || {
        saccade_vla_kernels::rotary_embedding(engine.isa, engine.threads, x, head_dim, cos, sin);
    });
    check_interrupted()
}

/// [`PackedKeyValues::pack_from`]; from 0 it is [`PackedKeyValues::pack`].
pub(crate) fn pack(
    threads: usize,
    packed: &mut PackedKeyValues,
    first: usize,
    keys: Rows<'_>,
    values: Rows<'_>,
) -> Result<()> {
    let result = counted(Some(Part::Pack), (0, 0), || match first {
        0 => packed.pack(threads, keys, values),
        _ => {
            packed.pack_from(threads, first, keys, values);
            Ok(())
        }
    });
    result.map_err(refused("keys and values"))?;
    check_interrupted()
}

/// [`PackedKeyValues::append`].
pub(crate) fn append(
    threads: usize,
    packed: &mut PackedKeyValues,
    keys: Rows<'_>,
    values: Rows<'_>,
) -> Result<()> {
    let result = counted(Some(Part::Pack), (0, 0), || packed.append(threads, keys, values));
    result.map_err(refused("keys and values"))?;
    check_interrupted()
}

/// No keys yet, of the type in which `engine` holds them, with room for `capacity`.
pub(crate) fn room_for_keys_values(
    engine: Engine,
    [num_heads, head_dim]: [usize; 2],
    capacity: usize,
) -> Result<PackedKeyValues> {
    let mut packed = no_keys_values(engine, num_heads, head_dim);
    packed.reserve(capacity).map_err(refused("keys and values"))?;
    Ok(packed)
}

/// [`PackedKeyValues::try_clone_first`].
pub(crate) fn first_keys_values(
    packed: &PackedKeyValues,
    len: usize,
    capacity: usize,
) -> Result<PackedKeyValues> {
    packed
        .try_clone_first(len, capacity)
        .map_err(refused("keys and values"))
}

/// No keys yet, of the type in which `engine` holds them.
pub(crate) fn no_keys_values(engine: Engine, num_heads: usize, head_dim: usize) -> PackedKeyValues {
    PackedKeyValues::new(engine.isa, engine.precision.keys_values(), num_heads, head_dim)
}
