//! RMSNorm over rows, or over each head of a row.

use saccade_vla_kernels::RowsMut;

use super::weights::Weights;
use crate::engine::Engine;
use crate::error::Result;
use crate::ops::{self, rows, rows_mut};

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
    pub(crate) fn apply(&self, engine: Engine, x: &[f32], out: &mut [f32]) -> Result<()> {
        let width = self.weight.len();
        ops::rms_norm(
            engine,
            self.eps,
            &self.weight,
            rows(x, width),
            rows_mut(out, width),
        )
    }

    /// Norms each head of each row by itself, in place.
    pub(crate) fn apply_to_heads(&self, engine: Engine, x: RowsMut<'_>) -> Result<()> {
        ops::rms_norm_in_place(engine, self.eps, &self.weight, x)
    }
}
