//! Rotary position embedding: the angles of positions.

use saccade_vla_kernels::RowsMut;

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

/// What turns a pair of a head: a position on one axis of a row, times a frequency.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Turn {
    pub axis: usize,
    pub frequency: f32,
}

/// Frequency `base^(-i / pairs)` for pair `i` of `pairs`, float32 as in released code.
pub(crate) fn frequencies(base: f64, pairs: usize) -> impl Iterator<Item = f32> {
    (0..pairs).map(move |pair| base.powf(-(pair as f64) / pairs as f64) as f32)
}

/// All pairs of heads of `head_dim`, turned by the only axis.
pub(crate) fn one_axis(base: f64, head_dim: usize) -> Vec<Turn> {
    let turn = |frequency| Turn { axis: 0, frequency };
    frequencies(base, head_dim / 2).map(turn).collect()
}

impl Rotation {
    /// Angle `position * frequency` for the pairs of heads of `head_dim`, of which those with a turn are rotated; `positions` has the axes of
    /// each row. Angles are float32 as in released code; the functions are evaluated in float64 and rounded once.
    pub(crate) fn new<const AXES: usize>(
        head_dim: usize,
        turns: &[Turn],
        positions: &[[usize; AXES]],
    ) -> Result<Self> {
        let len = product("rotary embedding", &[positions.len(), turns.len()])?;
        let (mut cos, mut sin) = (Vec::new(), Vec::new());
        reserve("rotary embedding", &mut cos, len)?;
        reserve("rotary embedding", &mut sin, len)?;
        for position in positions {
            for turn in turns {
                let angle = f64::from(position[turn.axis] as f32 * turn.frequency);
                cos.push(angle.cos() as f32);
                sin.push(angle.sin() as f32);
            }
        }
        Ok(Self {
            cos,
            sin,
            pairs: turns.len(),
            head_dim,
        })
    }

    /// Rotates each head of each row in place.
    pub(crate) fn apply(&self, engine: Engine, x: RowsMut<'_>) -> Result<()> {
        let (cos, sin) = (rows(&self.cos, self.pairs), rows(&self.sin, self.pairs));
        ops::rotary_embedding(engine, x, self.head_dim, cos, sin)
    }
}
