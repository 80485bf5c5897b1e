//! Feed-forward layers, with and without a gate.

use saccade_vla_kernels::{Epilogue, Rows, RowsMut};

use super::linear::Linear;
use super::weights::Weights;
use crate::alloc::Scratch;
use crate::engine::Kernels;
use crate::error::Result;
use crate::precision::Role;
use crate::profile::Part;

/// The names of the two layers in diffusers.
pub(crate) const DIFFUSERS: [&str; 2] = ["net.0.proj", "net.2"];

/// `down(activation(up(y)))`, or with a gate `down(activation(gate(y)) * up(y))`.
pub(crate) struct FeedForward {
    gate: Option<Linear>,
    up: Linear,
    down: Linear,
    activation: Epilogue,
}

impl FeedForward {
    /// From two layers of these names with biases, the first of which makes `hidden` elements of `width`.
    pub(crate) fn new(
        weights: &Weights<'_>,
        [up, down]: [&str; 2],
        [width, hidden]: [usize; 2],
        activation: Epilogue,
        role: Role,
    ) -> Result<Self> {
        Ok(Self {
            gate: None,
            up: Linear::new(&weights.at(up), width, hidden, role)?.counted(Part::FeedForwardIn),
            down: Linear::new(&weights.at(down), hidden, width, role)?.counted(Part::FeedForwardOut),
            activation,
        })
    }

    /// From `gate_proj`, `up_proj` and `down_proj` without biases, as Llama and Qwen name them.
    pub(crate) fn gated(
        weights: &Weights<'_>,
        [width, hidden]: [usize; 2],
        activation: Epilogue,
    ) -> Result<Self> {
        let linear = |name: &str, inputs, outputs| {
            let layer = [(weights.at(name), outputs)];
            Linear::stacked(&layer, inputs, Role::BackboneBlock, false)
        };
        Ok(Self {
            gate: Some(linear("gate_proj", width, hidden)?.counted(Part::FeedForwardIn)),
            up: linear("up_proj", width, hidden)?.counted(Part::FeedForwardIn),
            down: linear("down_proj", hidden, width)?.counted(Part::FeedForwardOut),
            activation,
        })
    }

    /// `x += feed_forward(y)`.
    pub(crate) fn add(
        &self,
        kernels: &mut Kernels<'_>,
        y: Rows<'_>,
        hidden: &mut Scratch,
        x: RowsMut<'_>,
    ) -> Result<()> {
        let mut hidden = hidden.rows(y.num_rows(), self.up.out_features())?;
        match &self.gate {
            None => self.up.apply(kernels, y, self.activation, hidden.reborrow())?,
            Some(gate) => {
                gate.apply(kernels, y, self.activation, hidden.reborrow())?;
                self.up.apply(kernels, y, Epilogue::Mul, hidden.reborrow())?;
            }
        }
        self.down.apply(kernels, hidden.as_rows(), Epilogue::Add, x)
    }
}
