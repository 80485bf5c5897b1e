//! How a quantised weight is stored: beside it, the scales of its rows.

use saccade_vla_checkpoint::spec::{SCALE_SUFFIX, is_quantized};
use saccade_vla_checkpoint::{Checkpoint, CheckpointWriter, Dtype, Elements, PlannedTensor};
use saccade_vla_kernels::quantize_rows_int4;

use crate::alloc::{filled, product};
use crate::error::{Error, Result, bail};
use crate::nn::source::weight_view;

/// Checks that a weight is not quantised already.
///
/// # Errors
/// [`Error::Checkpoint`] if it is; [`Error::File`] if it is not there.
pub(crate) fn check_not_quantized(checkpoint: &Checkpoint, name: &str) -> Result<()> {
    let dtype = checkpoint.dtype(name)?;
    if is_quantized(dtype) {
        bail!(Checkpoint, "source"; "it is quantised already: {name} is {dtype:?}, expected F32, BF16 or F16");
    }
    Ok(())
}

/// The tensors of a weight in four bits: two values in a byte, and the scales.
pub(crate) fn planned_int4(name: &str, out_features: usize, in_features: usize) -> [PlannedTensor; 2] {
    planned_with_scales(name, Dtype::U8, [out_features, in_features.div_ceil(2)])
}

/// The tensors of a weight whose values are stored so, and the scales.
pub(crate) fn planned_with_scales(name: &str, dtype: Dtype, shape: [usize; 2]) -> [PlannedTensor; 2] {
    [
        PlannedTensor {
            name: name.to_owned(),
            dtype,
            shape: shape.to_vec(),
        },
        PlannedTensor {
            name: format!("{name}{SCALE_SUFFIX}"),
            dtype: Dtype::F32,
            shape: vec![shape[0]],
        },
    ]
}

/// Values and scales of a weight in four bits, each rounded for itself.
///
/// # Errors
/// [`Error::Memory`].
pub(crate) fn plain_int4(
    weight: &Elements,
    out_features: usize,
    in_features: usize,
) -> Result<(Vec<u8>, Vec<f32>)> {
    let num_bytes = product("source", &[out_features, in_features.div_ceil(2)])?;
    let (mut values, mut scales) = (
        filled("source", num_bytes, 0_u8)?,
        filled("source", out_features, 0.0)?,
    );
    quantize_rows_int4(
        weight_view(weight, out_features, in_features),
        &mut values,
        &mut scales,
    );
    Ok((values, scales))
}

/// Writes the values of a weight, as they are stored, and its scales.
///
/// # Errors
/// [`Error::File`] if they cannot be written.
pub(crate) fn write_with_scales(
    name: &str,
    values: &[u8],
    scales: &[f32],
    writer: &mut CheckpointWriter,
) -> Result<()> {
    writer.tensor(name, values)?;
    let scales: Vec<u8> = scales.iter().flat_map(|scale| scale.to_le_bytes()).collect();
    Ok(writer.tensor(&format!("{name}{SCALE_SUFFIX}"), &scales)?)
}
