//! Rotary position embedding: the angles of positions.

use saccade_kernels::RowsMut;

use crate::alloc::{product, reserve};
use crate::engine::Engine;
use crate::error::Result;
use crate::ops::{self, rows};

/// Cosines and sines of the angles by which the pairs of each row are rotated, `(rows, pairs)`.
pub(crate) struct Rotation {
    cos: Vec<f32>,
    sin: Vec<f32>,
    pairs: usize,
    head_dim: usize,
}

impl Rotation {
    /// Angle `position * base^(-i / pairs)` for pair `i` of heads of `head_dim`, of which all are rotated. Frequencies and angles are float32 as
    /// in released code; the functions are evaluated in float64 and rounded once.
    pub(crate) fn new(head_dim: usize, base: f64, positions: &[usize]) -> Result<Self> {
        let pairs = head_dim / 2;
        let len = product("rotary embedding", &[positions.len(), pairs])?;
        let (mut cos, mut sin) = (Vec::new(), Vec::new());
        reserve("rotary embedding", &mut cos, len)?;
        reserve("rotary embedding", &mut sin, len)?;
        for &position in positions {
            for pair in 0..pairs {
                let frequency = base.powf(-(pair as f64) / pairs as f64) as f32;
                let angle = f64::from(position as f32 * frequency);
                cos.push(angle.cos() as f32);
                sin.push(angle.sin() as f32);
            }
        }
        Ok(Self {
            cos,
            sin,
            pairs,
            head_dim,
        })
    }

    /// Rotates each head of each row in place.
    pub(crate) fn apply(&self, engine: Engine, x: RowsMut<'_>) -> Result<()> {
        let (cos, sin) = (rows(&self.cos, self.pairs), rows(&self.sin, self.pairs));
        ops::rotary_embedding(engine, x, self.head_dim, cos, sin)
    }
}
