//! A back end that adds up the bytes that a model's layers would hold.

use saccade_vla_kernels::{Element, PackedLinear};
use safetensors::Dtype;

use super::{Outline, Request, Source, Stored, Tensor};
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::weights::{self, Weights};
use crate::ops::packing_error;
use crate::precision::Role;

/// Measures layers made of tensors of the types that `dtype` gives by name.
struct Sizer<D> {
    dtype: D,
    engine: Engine,
}

/// Bytes of the layers that `build` makes, of tensors that are stored as `dtype` says by name.
pub(crate) fn nbytes<L>(
    engine: Engine,
    dtype: impl Fn(&str) -> Result<Dtype>,
    build: impl FnOnce(&Weights<'_>) -> Result<L>,
) -> Result<usize> {
    let (_, nbytes) = weights::build(&Sizer { dtype, engine }, engine, build)?;
    Ok(nbytes)
}

impl<D: Fn(&str) -> Result<Dtype>> Source for Sizer<D> {
    fn tensor(&self, request: &Request) -> Result<Tensor> {
        let spec = &request.spec;
        if spec.shape.contains(&0) {
            return Ok(Tensor::Outline(Stored::F32));
        }
        let stored = match (self.dtype)(&spec.name)? {
            Dtype::BF16 => Stored::Bf16,
            _ => Stored::F32,
        };
        Ok(Tensor::Outline(stored))
    }

    fn packed_nbytes(&self, role: Role, outline: Outline) -> Result<usize> {
        let arithmetic = self.engine.precision.arithmetic(role);
        let element = match outline.stored {
            Stored::F32 => Element::F32,
            Stored::Bf16 => Element::Bf16,
        };
        let shape = (outline.out_features, outline.in_features);
        PackedLinear::packed_nbytes(self.engine.isa, arithmetic, element, shape).map_err(packing_error)
    }
}
