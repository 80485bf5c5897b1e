//! A back end that adds up the bytes that a model's layers would hold.

use saccade_vla_kernels::{Element, PackedLinear};
use safetensors::Dtype;

use crate::engine::Engine;
use crate::error::Result;
use crate::nn::weights::{Outline, Request, Source, Stored, Tensor};
use crate::ops::packing_error;
use crate::precision::Role;

/// Measures layers made of tensors of the types that `dtype` gives by name.
pub(crate) struct Sizer<D> {
    dtype: D,
    engine: Engine,
}

impl<D: Fn(&str) -> Result<Dtype>> Sizer<D> {
    pub(crate) fn new(engine: Engine, dtype: D) -> Self {
        Self { dtype, engine }
    }
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
