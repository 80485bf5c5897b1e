//! How many bytes of weights a head would hold, without loading it: the same layers, one panel of each packed.

use std::collections::BTreeMap;

use half::bf16;
use saccade_kernels::{Arithmetic, Isa, Matrix, PackedLinear, WeightRef};
use safetensors::Dtype;

use crate::error::{Error, Result};
use crate::layout::{
    AttentionNames, CategoryLinearNames, FeedForwardNames, HeadNames, LinearNames, NormNames, Role,
};
use crate::precision::Precision;
use crate::recognise::Published;

impl Published {
    /// What [`ActionHead::nbytes`](crate::ActionHead::nbytes) would be.
    ///
    /// # Errors
    /// [`Error::Input`] for an unknown instruction set in the environment; [`Error::Checkpoint`] for a tensor that is not there or has too
    /// many inputs for int8.
    pub fn nbytes(&self, precision: Precision, num_embodiments: usize) -> Result<usize> {
        let isa = Isa::from_env().map_err(|error| Error::Input(error.to_string()))?;
        let mut sizes = Sizes {
            published: self,
            isa,
            columns: columns(isa)?,
            precision,
            panels: BTreeMap::new(),
        };
        let config = &self.config;
        let names = HeadNames::new(config);
        let mut bytes = 4 * config.num_future_tokens * config.width;
        if names.position_embedding.is_some() {
            bytes += 4 * config.action_horizon * config.width;
        }
        bytes += names.vlln.as_ref().map_or(0, norm);
        for block in &names.vl_blocks {
            bytes += norm(&block.norm1) + norm(&block.norm3);
            bytes += sizes.attention(&block.attention)? + sizes.feed_forward(&block.feed_forward)?;
        }
        for block in &names.blocks {
            bytes += sizes.linear(&[&block.modulation])?;
            bytes += sizes.attention(&block.attention)? + sizes.feed_forward(&block.feed_forward)?;
        }
        for layer in names.timestep_embedder.iter().chain(&names.proj_out) {
            bytes += sizes.linear(&[layer])?;
        }
        let mut slices = sizes.action_encoder(&names.action_encoder)?;
        for layer in names.state_encoder.iter().chain(names.decoders.iter().flatten()) {
            slices += sizes.category(layer)?;
        }
        Ok(bytes + num_embodiments * slices)
    }
}

fn norm(names: &NormNames) -> usize {
    4 * 2 * names.width
}

/// What a weight is packed from.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Stored {
    F32,
    Bf16,
}

struct Sizes<'a> {
    published: &'a Published,
    isa: Isa,
    precision: Precision,
    /// Outputs in a panel.
    columns: usize,
    /// Bytes of one, by whether it computes in float32, whether it is a block's, what it is packed from, and its inputs.
    panels: BTreeMap<(bool, bool, Stored, usize), usize>,
}

impl Sizes<'_> {
    fn linear(&mut self, parts: &[&LinearNames]) -> Result<usize> {
        let role = parts[0].role;
        let mut stored = Stored::Bf16;
        for names in parts {
            stored = stored.min(self.stored(&names.weight, role)?);
        }
        let out_features = parts.iter().map(|names| names.out_features).sum();
        self.packed(role, stored, parts[0].in_features, out_features)
    }

    fn attention(&mut self, names: &AttentionNames) -> Result<usize> {
        Ok(self.linear(&[&names.to_q])?
            + self.linear(&[&names.to_k, &names.to_v])?
            + self.linear(&[&names.to_out])?)
    }

    fn feed_forward(&mut self, names: &FeedForwardNames) -> Result<usize> {
        Ok(self.linear(&[&names.proj])? + self.linear(&[&names.out])?)
    }

    fn category(&mut self, names: &CategoryLinearNames) -> Result<usize> {
        let stored = self.stored(&names.weight, Role::Other)?;
        self.packed(Role::Other, stored, names.in_features, names.out_features)
    }

    /// As `ActionEncoder` takes its first two layers apart.
    fn action_encoder(&mut self, [w1, w2, w3]: &[CategoryLinearNames; 3]) -> Result<usize> {
        let width = w3.in_features;
        let time = self.stored(&w2.weight, Role::Time)?;
        Ok(self.packed(Role::Other, Stored::F32, w1.in_features, width)?
            + self.packed(Role::Time, time, width, width)?
            + self.category(w3)?)
    }

    fn stored(&self, name: &str, role: Role) -> Result<Stored> {
        let dtype = self
            .published
            .checkpoint
            .dtype(&format!("{}{name}", self.published.prefix))?;
        let is_rounded = role == Role::Time && self.precision.rounds_weights() && dtype != Dtype::I8;
        Ok(match dtype {
            Dtype::BF16 => Stored::Bf16,
            _ if is_rounded => Stored::Bf16,
            _ => Stored::F32,
        })
    }

    fn packed(
        &mut self,
        role: Role,
        stored: Stored,
        in_features: usize,
        out_features: usize,
    ) -> Result<usize> {
        let arithmetic = self.precision.arithmetic(role);
        let key = (
            arithmetic == Arithmetic::Float32,
            role == Role::Block,
            stored,
            in_features,
        );
        let panel = match self.panels.get(&key) {
            Some(panel) => *panel,
            None => {
                let panel = pack(self.isa, arithmetic, stored, in_features, 1)?;
                self.panels.insert(key, panel);
                panel
            }
        };
        Ok(out_features.div_ceil(self.columns) * panel)
    }
}

/// Outputs in a panel: one more takes a second.
fn columns(isa: Isa) -> Result<usize> {
    let packed = |outputs| pack(isa, Arithmetic::Float32, Stored::F32, 1, outputs);
    let one = packed(1)?;
    let mut outputs = 1;
    while packed(outputs + 1)? == one {
        outputs += 1;
    }
    Ok(outputs)
}

/// Bytes of a packed layer of these sizes.
fn pack(
    isa: Isa,
    arithmetic: Arithmetic,
    stored: Stored,
    in_features: usize,
    out_features: usize,
) -> Result<usize> {
    let (wide, narrow);
    let weight = match stored {
        Stored::F32 => {
            wide = vec![0.0; out_features * in_features];
            WeightRef::F32(Matrix::new(&wide, in_features))
        }
        Stored::Bf16 => {
            narrow = vec![bf16::ZERO; out_features * in_features];
            WeightRef::Bf16(Matrix::new(&narrow, in_features))
        }
    };
    let layer = PackedLinear::pack(isa, arithmetic, 1, &[(weight, None)]);
    layer
        .map(|layer| layer.nbytes())
        .map_err(|error| Error::Checkpoint(format!("source: {error}")))
}
