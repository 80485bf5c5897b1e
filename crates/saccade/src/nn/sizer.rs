//! A back end that adds up the bytes that a model's layers would hold: one panel of each kind is packed and measured.

use std::cell::RefCell;
use std::collections::BTreeMap;

use half::bf16;
use saccade_kernels::{Arithmetic, Isa, Matrix, PackedLinear, WeightRef};
use safetensors::Dtype;

use super::weights::{Outline, Request, Source, Stored, Tensor};
use crate::alloc::filled;
use crate::engine::Engine;
use crate::error::Result;
use crate::ops::packing_error;
use crate::precision::Role;

/// Measures layers made of tensors of the types that `dtype` gives by name.
pub(crate) struct Sizer<D> {
    dtype: D,
    engine: Engine,
    /// Outputs in a panel.
    columns: usize,
    /// Bytes of one.
    panels: RefCell<BTreeMap<PanelKind, usize>>,
}

/// Panels of one kind are of one size: by whether they compute in float32, whether they are a block's, what they are packed from, and their
/// inputs.
type PanelKind = (bool, bool, Stored, usize);

impl<D: Fn(&str) -> Result<Dtype>> Sizer<D> {
    pub(crate) fn new(engine: Engine, dtype: D) -> Result<Self> {
        Ok(Self {
            dtype,
            engine,
            columns: columns(engine.isa)?,
            panels: RefCell::default(),
        })
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
        let Outline {
            stored,
            out_features,
            in_features,
        } = outline;
        let arithmetic = self.engine.precision.arithmetic(role);
        let kind = (
            arithmetic == Arithmetic::Float32,
            role == Role::Block,
            stored,
            in_features,
        );
        let known = self.panels.borrow().get(&kind).copied();
        let panel = match known {
            Some(panel) => panel,
            None => {
                let panel = packed_nbytes(self.engine.isa, arithmetic, stored, [1, in_features])?;
                self.panels.borrow_mut().insert(kind, panel);
                panel
            }
        };
        Ok(out_features.div_ceil(self.columns) * panel)
    }
}

/// Outputs in a panel: one more takes a second.
fn columns(isa: Isa) -> Result<usize> {
    let packed = |outputs| packed_nbytes(isa, Arithmetic::Float32, Stored::F32, [outputs, 1]);
    let one = packed(1)?;
    let mut outputs = 1;
    while packed(outputs + 1)? == one {
        outputs += 1;
    }
    Ok(outputs)
}

/// Bytes of a packed layer of `[out_features, in_features]`.
fn packed_nbytes(
    isa: Isa,
    arithmetic: Arithmetic,
    stored: Stored,
    [out_features, in_features]: [usize; 2],
) -> Result<usize> {
    let (wide, narrow);
    let weight = match stored {
        Stored::F32 => {
            wide = filled("weights", out_features * in_features, 0.0)?;
            WeightRef::F32(Matrix::new(&wide, in_features))
        }
        Stored::Bf16 => {
            narrow = filled("weights", out_features * in_features, bf16::ZERO)?;
            WeightRef::Bf16(Matrix::new(&narrow, in_features))
        }
    };
    let layer = PackedLinear::pack(isa, arithmetic, 1, &[(weight, None)]);
    layer.map(|layer| layer.nbytes()).map_err(packing_error)
}
