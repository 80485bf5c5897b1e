//! Norms over rows: LayerNorm and RMSNorm.

use saccade_vla_kernels::{Rows, RowsMut};

use super::weights::Weights;
use crate::engine::Engine;
use crate::error::Result;
use crate::ops::kernel;
use crate::profile::Part;

/// `(x - mean) / sqrt(variance + eps) * weight + bias`.
pub(crate) struct LayerNorm {
    weight: Vec<f32>,
    bias: Vec<f32>,
    eps: f32,
}

impl LayerNorm {
    /// From `weight (width)` and `bias (width)`.
    pub(crate) fn new(weights: &Weights<'_>, width: usize, eps: f32) -> Result<Self> {
        Ok(Self {
            weight: weights.vector("weight", width)?,
            bias: weights.vector("bias", width)?,
            eps,
        })
    }

    pub(crate) fn apply(&self, engine: Engine, x: Rows<'_>, out: RowsMut<'_>) -> Result<()> {
        layer_norm(engine, self.eps, Some((&self.weight, &self.bias)), x, out)
    }
}

/// `(x - mean) / sqrt(variance + eps)`, times the first of `scale_shift` plus the second if they are given.
pub(crate) fn layer_norm(
    engine: Engine,
    eps: f32,
    scale_shift: Option<(&[f32], &[f32])>,
    x: Rows<'_>,
    out: RowsMut<'_>,
) -> Result<()> {
    kernel(Some(Part::Norm), (0, 0), || {
        saccade_vla_kernels::layer_norm(engine.isa, engine.threads, x, eps, scale_shift, out);
    })
}

/// `x / sqrt(mean(x^2) + eps) * weight`, the mean over as many consecutive columns as there are weights.
pub(crate) struct RmsNorm {
    weight: Vec<f32>,
    eps: f32,
}

impl RmsNorm {
    /// From `weight (width)`.
    pub(crate) fn new(weights: &Weights<'_>, width: usize, eps: f32) -> Result<Self> {
        Ok(Self {
            weight: weights.vector("weight", width)?,
            eps,
        })
    }

    /// Norms rows of the width of the weight.
    pub(crate) fn apply(&self, engine: Engine, x: Rows<'_>, out: RowsMut<'_>) -> Result<()> {
        kernel(Some(Part::Norm), (0, 0), || {
            saccade_vla_kernels::rms_norm(engine.isa, engine.threads, x, self.eps, &self.weight, out);
        })
    }

    /// Norms each head of each row by itself, in place.
    pub(crate) fn apply_to_heads(&self, engine: Engine, x: RowsMut<'_>) -> Result<()> {
        kernel(Some(Part::Norm), (0, 0), || {
            saccade_vla_kernels::rms_norm_in_place(engine.isa, engine.threads, x, self.eps, &self.weight);
        })
    }
}
