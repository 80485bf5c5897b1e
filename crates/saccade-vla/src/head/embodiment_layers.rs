//! Layers with separate weights for each embodiment (`CategorySpecificLinear` and `CategorySpecificMLP` of
//! the released code).
//!
//! Equation 1 of docs/equations.md.

use saccade_vla_kernels::{Epilogue, Rows, RowsMut};

use super::embodiments::Embodiments;
use crate::alloc::Scratch;
use crate::engine::Kernels;
use crate::error::Result;
use crate::nn::linear::Linear;
use crate::nn::sequences::Sequences;
use crate::nn::weights::Weights;
use crate::precision::Role;
use crate::profile::Part;

/// One linear layer per embodiment: `y = x W[embodiment_id] + b[embodiment_id]`. Only the slices in use are
/// in memory.
pub(crate) struct EmbodimentLinear {
    /// By embodiment id; `None` where it was not loaded.
    layers: Vec<Option<Linear>>,
}

impl EmbodimentLinear {
    /// From `W (num_embodiments, in_features, out_features)` and `b (num_embodiments, out_features)`.
    pub(crate) fn new(
        weights: &Weights<'_>,
        embodiments: Embodiments<'_>,
        in_features: usize,
        out_features: usize,
    ) -> Result<Self> {
        Self::of(embodiments, |id| {
            let weight = weights.slice("W", &[embodiments.count, in_features, out_features], id)?;
            let bias = weights
                .slice("b", &[embodiments.count, out_features], id)?
                .into_f32()?;
            let weight = weight.transposed(out_features, in_features);
            let packed = weights.pack(Role::Other, &[(weight, Some(bias.as_slice()))])?;
            Ok(Linear::packed(packed))
        })
    }

    /// From the layer of each embodiment in use.
    pub(crate) fn of(
        embodiments: Embodiments<'_>,
        mut layer: impl FnMut(usize) -> Result<Linear>,
    ) -> Result<Self> {
        let mut layers: Vec<_> = (0..embodiments.count).map(|_| None).collect();
        for &id in embodiments.ids {
            layers[id] = Some(layer(id)?.counted(Part::Embodiment));
        }
        Ok(Self { layers })
    }

    /// `out = epilogue(x W + b)`, with the rows of each observation, equally many, in the layer of its
    /// embodiment.
    pub(crate) fn apply(
        &self,
        kernels: &mut Kernels<'_>,
        embodiment_ids: &[usize],
        x: Rows<'_>,
        epilogue: Epilogue,
        mut out: RowsMut<'_>,
    ) -> Result<()> {
        let observations = Sequences::new(x, embodiment_ids.len());
        // Neighbours of one embodiment share a product: the weights are then read once.
        for (&id, rows) in observations.runs(embodiment_ids, |a, b| a == b) {
            let layer = self.layers[id]
                .as_ref()
                .expect("embodiment ids are checked against the loaded ones");
            let out = out.reborrow().rows(rows.clone());
            layer.apply(kernels, x.rows(rows), epilogue, out)?;
        }
        Ok(())
    }
}

/// `layer2(relu(layer1(x)))`: the state encoder and the action decoders.
pub(crate) struct EmbodimentMlp {
    layer1: EmbodimentLinear,
    layer2: EmbodimentLinear,
    in_features: usize,
    hidden: usize,
    out_features: usize,
}

impl EmbodimentMlp {
    /// `[in_features, hidden, out_features]` of `layer1` and `layer2`.
    pub(crate) fn new(
        weights: &Weights<'_>,
        embodiments: Embodiments<'_>,
        [in_features, hidden, out_features]: [usize; 3],
    ) -> Result<Self> {
        Ok(Self {
            layer1: EmbodimentLinear::new(&weights.at("layer1"), embodiments, in_features, hidden)?,
            layer2: EmbodimentLinear::new(&weights.at("layer2"), embodiments, hidden, out_features)?,
            in_features,
            hidden,
            out_features,
        })
    }

    pub(crate) fn in_features(&self) -> usize {
        self.in_features
    }

    /// The output rows, in `out`, for rows of `x`, equally many for each embodiment.
    pub(crate) fn apply<'a>(
        &self,
        kernels: &mut Kernels<'_>,
        embodiment_ids: &[usize],
        x: Rows<'_>,
        hidden: &mut Scratch,
        out: &'a mut Scratch,
    ) -> Result<Rows<'a>> {
        let mut hidden = hidden.rows(x.num_rows(), self.hidden)?;
        self.layer1
            .apply(kernels, embodiment_ids, x, Epilogue::Relu, hidden.reborrow())?;
        let rows = out.rows(x.num_rows(), self.out_features)?;
        self.layer2
            .apply(kernels, embodiment_ids, hidden.as_rows(), Epilogue::Store, rows)?;
        Ok(out.as_rows())
    }
}
