//! Rotary position embedding (RoPE): the angles of positions.
//!
//! Equation 25 of docs/equations.md.

use saccade_vla_kernels::{Rows, RowsMut};

use crate::alloc::{product, reserve};
use crate::engine::Engine;
use crate::error::Result;
use crate::ops::kernel;
use crate::profile::Part;

/// The angle by which a pair of elements of a head is rotated, as a function of the row's position:
/// `position[axis] * frequency`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct RopePair {
    pub axis: usize,
    pub frequency: f32,
}

/// Frequency `base^(-i / pairs)` for pair `i` of `pairs`, float32 as in released code.
pub(crate) fn frequencies(base: f64, pairs: usize) -> impl Iterator<Item = f32> {
    (0..pairs).map(move |pair| base.powf(-(pair as f64) / pairs as f64) as f32)
}

/// All pairs of heads of `head_dim`, rotated by a position with one axis.
pub(crate) fn one_axis(base: f64, head_dim: usize) -> Vec<RopePair> {
    let pair = |frequency| RopePair { axis: 0, frequency };
    frequencies(base, head_dim / 2).map(pair).collect()
}

/// Cosines and sines of the angles by which the pairs of each row are rotated, `(rows, pairs)`.
pub(crate) struct Rope {
    cos: Vec<f32>,
    sin: Vec<f32>,
    num_pairs: usize,
    head_dim: usize,
}

impl Rope {
    /// The angles of the first `pairs` of heads of `head_dim`, whose other elements stay as they are, for
    /// rows at `positions`. Angles are float32 as in released code; their cosines and sines are evaluated in
    /// float64 and rounded once.
    pub(crate) fn new<const AXES: usize>(
        head_dim: usize,
        pairs: &[RopePair],
        positions: &[[usize; AXES]],
    ) -> Result<Self> {
        let len = product("rotary embedding", &[positions.len(), pairs.len()])?;
        let (mut cos, mut sin) = (Vec::new(), Vec::new());
        reserve("rotary embedding", &mut cos, len)?;
        reserve("rotary embedding", &mut sin, len)?;
        for position in positions {
            for pair in pairs {
                let angle = f64::from(position[pair.axis] as f32 * pair.frequency);
                cos.push(angle.cos() as f32);
                sin.push(angle.sin() as f32);
            }
        }
        Ok(Self {
            cos,
            sin,
            num_pairs: pairs.len(),
            head_dim,
        })
    }

    /// Rotates each head of each row in place.
    pub(crate) fn apply(&self, engine: Engine, x: RowsMut<'_>) -> Result<()> {
        let [cos, sin] = [&self.cos, &self.sin].map(|table| Rows::new(table, self.num_pairs));
        kernel(Some(Part::Pack), (0, 0), || {
            saccade_vla_kernels::rotary_embedding(engine.isa, engine.threads, x, self.head_dim, cos, sin);
        })
    }
}
