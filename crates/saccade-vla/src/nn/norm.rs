//! Norms with learned weights.

use super::weights::Weights;
use crate::engine::Engine;
use crate::error::Result;
use crate::ops;

/// `(x - mean) / sqrt(variance + eps) * weight + bias`.
pub(crate) struct LayerNorm {
    weight: Vec<f32>,
    bias: Vec<f32>,
    eps: f32,
}

impl LayerNorm {
    pub(crate) fn new(weights: &Weights<'_>, width: usize, eps: f32) -> Result<Self> {
        Ok(Self {
            weight: weights.vector("weight", width)?,
            bias: weights.vector("bias", width)?,
            eps,
        })
    }

    pub(crate) fn apply(&self, engine: Engine, x: &[f32], out: &mut [f32]) -> Result<()> {
        let scale_shift = Some((self.weight.as_slice(), self.bias.as_slice()));
        ops::layer_norm(engine, self.weight.len(), self.eps, scale_shift, x, out)
    }
}
