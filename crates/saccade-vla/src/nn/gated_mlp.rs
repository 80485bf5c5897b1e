//! Gated feed-forward layers.

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch};

use super::linear::Linear;
use super::weights::Weights;
use crate::alloc::sized;
use crate::engine::Engine;
use crate::error::Result;
use crate::precision::Role;
use crate::profile::Part;

/// `down(activation(gate(y)) * up(y))`.
pub(crate) struct GatedMlp {
    gate: Linear,
    up: Linear,
    down: Linear,
    activation: Epilogue,
}

impl GatedMlp {
    /// From `gate_proj`, `up_proj` and `down_proj`, as Llama and Qwen name them.
    pub(crate) fn new(
        weights: &Weights<'_>,
        width: usize,
        hidden: usize,
        activation: Epilogue,
        has_bias: bool,
    ) -> Result<Self> {
        let linear = |name: &str, inputs, outputs| {
            Linear::stacked(
                &[(weights.at(name), outputs)],
                inputs,
                Role::BackboneBlock,
                has_bias,
            )
        };
        Ok(Self {
            gate: linear("gate_proj", width, hidden)?.counted(Part::FeedForwardIn),
            up: linear("up_proj", width, hidden)?.counted(Part::FeedForwardIn),
            down: linear("down_proj", hidden, width)?.counted(Part::FeedForwardOut),
            activation,
        })
    }

    /// `x += mlp(y)`, both `(rows, width)`.
    pub(crate) fn add(
        &self,
        engine: Engine,
        y: &[f32],
        buffer: &mut Activations,
        scratch: &mut LinearScratch,
        x: &mut [f32],
    ) -> Result<()> {
        let rows = y.len() / self.gate.in_features();
        let hidden = sized(buffer, rows * self.gate.out_features())?; // (rows, hidden)
        self.gate.apply(engine, y, self.activation, hidden, scratch)?;
        self.up.apply(engine, y, Epilogue::Mul, hidden, scratch)?;
        self.down.apply(engine, hidden, Epilogue::Add, x, scratch)
    }
}
