//! Feed-forward layers.

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch};

use super::linear::Linear;
use super::weights::Weights;
use crate::alloc::sized;
use crate::engine::Engine;
use crate::error::Result;
use crate::precision::Role;
use crate::profile::Part;

/// The names of the two layers in diffusers.
pub(crate) const DIFFUSERS: [&str; 2] = ["net.0.proj", "net.2"];

/// `W2 activation(W1 y + b1) + b2`.
pub(crate) struct FeedForward {
    proj: Linear,
    out: Linear,
    activation: Epilogue,
}

impl FeedForward {
    /// From the two layers of these names, the first of which makes `hidden` elements of `width`.
    pub(crate) fn new(
        weights: &Weights<'_>,
        [proj, out]: [&str; 2],
        [width, hidden]: [usize; 2],
        activation: Epilogue,
        role: Role,
    ) -> Result<Self> {
        let proj = Linear::new(&weights.at(proj), width, hidden, role)?;
        let out = Linear::new(&weights.at(out), hidden, width, role)?;
        Ok(Self {
            proj: proj.counted(Part::FeedForwardIn),
            out: out.counted(Part::FeedForwardOut),
            activation,
        })
    }

    /// `x += feed_forward(y)`, both `(rows, width)`.
    pub(crate) fn add(
        &self,
        engine: Engine,
        y: &[f32],
        buffer: &mut Activations,
        scratch: &mut LinearScratch,
        x: &mut [f32],
    ) -> Result<()> {
        let rows = y.len() / self.proj.in_features();
        let hidden = sized(buffer, rows * self.proj.out_features())?; // (rows, hidden)
        self.proj.apply(engine, y, self.activation, hidden, scratch)?;
        self.out.apply(engine, hidden, Epilogue::Add, x, scratch)
    }
}
