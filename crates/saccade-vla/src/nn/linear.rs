//! Linear layers: `x W^T + b`, one or several of the same input packed as one.

use saccade_vla_kernels::{Epilogue, PackedLinear, Rows, RowsMut};

use super::weights::Weights;
use crate::engine::Kernels;
use crate::error::Result;
use crate::ops::{check_interrupted, refused};
use crate::precision::Role;
use crate::profile::{Part, counted_by};
use crate::watch::note;

/// A linear layer: `weight (out_features, in_features)` and, if it has one, `bias (out_features)`.
pub(crate) struct Linear {
    packed: PackedLinear,
    /// The part that its work is counted under; `None` does not count it.
    part: Option<Part>,
    /// The names of its weights, for those who watch its inputs; none of a layer that was packed elsewhere.
    weights: Vec<String>,
}

impl Linear {
    /// The layer whose tensors are `weights`, with a bias.
    pub(crate) fn new(
        weights: &Weights<'_>,
        in_features: usize,
        out_features: usize,
        role: Role,
    ) -> Result<Self> {
        Self::stacked(&[(weights.clone(), out_features)], in_features, role, true)
    }

    /// Layers of the same input, each with its `out_features`, as one: their outputs are concatenated.
    pub(crate) fn stacked(
        parts: &[(Weights<'_>, usize)],
        in_features: usize,
        role: Role,
        has_bias: bool,
    ) -> Result<Self> {
        let parts: Vec<_> = parts
            .iter()
            .map(|(weights, out_features)| (weights, vec![*out_features, in_features]))
            .collect();
        Self::of_shapes(&parts, role, has_bias)
    }

    /// A convolution whose windows do not overlap, `weight (out_features, ...)` and a bias: each window is a
    /// row.
    pub(crate) fn windows(weights: &Weights<'_>, shape: &[usize], role: Role) -> Result<Self> {
        Self::of_shapes(&[(weights, shape.to_vec())], role, true)
    }

    fn of_shapes(parts: &[(&Weights<'_>, Vec<usize>)], role: Role, has_bias: bool) -> Result<Self> {
        let (builder, shape) = &parts[0];
        let in_features = shape[1..].iter().product();
        let mut tensors = Vec::with_capacity(parts.len());
        let names = parts.iter().map(|(weights, _)| weights.name("weight")).collect();
        for (weights, shape) in parts {
            let weight = weights.weight(role, shape)?;
            let bias = has_bias.then(|| weights.bias("bias", shape[0])).transpose()?;
            tensors.push((weight, shape[0], bias));
        }
        let views: Vec<_> = tensors
            .iter()
            .map(|(weight, out_features, bias)| (weight.weight(*out_features, in_features), bias.as_deref()))
            .collect();
        let packed = builder.pack(role, &views)?;
        drop(views);
        if role.is_given_back() {
            for (weight, ..) in tensors {
                builder.give_back(weight);
            }
        }
        Ok(Self {
            packed,
            part: None,
            weights: names,
        })
    }

    /// A layer that is packed already.
    pub(crate) fn packed(packed: PackedLinear) -> Self {
        Self {
            packed,
            part: None,
            weights: Vec::new(),
        }
    }

    /// The layer, its work counted under `part`.
    pub(crate) fn counted(self, part: Part) -> Self {
        Self {
            part: Some(part),
            ..self
        }
    }

    pub(crate) fn in_features(&self) -> usize {
        self.packed.in_features()
    }

    pub(crate) fn out_features(&self) -> usize {
        self.packed.out_features()
    }

    /// `out = epilogue(x W^T + b)`.
    pub(crate) fn apply(
        &self,
        kernels: &mut Kernels<'_>,
        x: Rows<'_>,
        epilogue: Epilogue,
        out: RowsMut<'_>,
    ) -> Result<()> {
        let Self {
            packed,
            part,
            weights,
        } = self;
        note(weights, x, kernels.engine.threads)?;
        let multiply_adds = x.num_rows() * packed.in_features() * packed.out_features();
        let work = (multiply_adds, packed.nbytes());
        let applied = counted_by(Some(packed.kernel_name()), *part, work, || {
            packed.apply(kernels.engine.threads, x, epilogue, out, kernels.scratch)
        });
        applied.map_err(refused("activations"))?;
        check_interrupted()
    }
}
