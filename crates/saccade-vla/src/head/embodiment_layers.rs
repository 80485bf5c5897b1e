//! Layers with separate weights for each embodiment (`CategorySpecificLinear` and `CategorySpecificMLP` of the released code).

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch};

use super::embodiments::Embodiments;
use crate::alloc::sized;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::linear::Linear;
use crate::nn::weights::Weights;
use crate::precision::Role;
use crate::profile::Part;

/// One linear layer per embodiment: `y = x W[embodiment_id] + b[embodiment_id]`. Only the slices in use are in memory.
pub(crate) struct EmbodimentLinear {
    /// By embodiment id; `None` where it was not loaded.
    layers: Vec<Option<Linear>>,
    in_features: usize,
    out_features: usize,
}

impl EmbodimentLinear {
    /// From `W (num_embodiments, in_features, out_features)` and `b (num_embodiments, out_features)`.
    pub(crate) fn new(
        weights: &Weights<'_>,
        embodiments: Embodiments<'_>,
        in_features: usize,
        out_features: usize,
    ) -> Result<Self> {
        Self::of(embodiments, in_features, out_features, |id| {
            let weight = weights.slice("W", &[embodiments.count, in_features, out_features], id)?;
            let bias = weights
                .slice("b", &[embodiments.count, out_features], id)?
                .into_f32()?;
            let parts = [(
                weight.transposed(out_features, in_features),
                Some(bias.as_slice()),
            )];
            Ok(Linear::packed(weights.pack(Role::Other, &parts)?))
        })
    }

    /// From the layer of each embodiment in use.
    pub(crate) fn of(
        embodiments: Embodiments<'_>,
        in_features: usize,
        out_features: usize,
        mut layer: impl FnMut(usize) -> Result<Linear>,
    ) -> Result<Self> {
        let mut layers: Vec<_> = (0..embodiments.count).map(|_| None).collect();
        for &id in embodiments.ids {
            layers[id] = Some(layer(id)?.counted(Part::Embodiment));
        }
        Ok(Self {
            layers,
            in_features,
            out_features,
        })
    }

    pub(crate) fn in_features(&self) -> usize {
        self.in_features
    }

    /// Runs the rows of each batch element, equally many, through the layer of its embodiment.
    pub(crate) fn apply(
        &self,
        engine: Engine,
        embodiment_ids: &[usize],
        x: &[f32],
        epilogue: Epilogue,
        out: &mut [f32],
        scratch: &mut LinearScratch,
    ) -> Result<()> {
        let (mut x, mut out) = (x, out);
        let (x_element, out_element) = (x.len() / embodiment_ids.len(), out.len() / embodiment_ids.len());
        // Neighbours of one embodiment share a product: the weights are then read once.
        for run in embodiment_ids.chunk_by(|a, b| a == b) {
            let layer = self.layers[run[0]]
                .as_ref()
                .expect("embodiment ids are checked against the loaded ones");
            let (x_run, x_rest) = x.split_at(x_element * run.len());
            let (out_run, out_rest) = std::mem::take(&mut out).split_at_mut(out_element * run.len());
            layer.apply(engine, x_run, epilogue, out_run, scratch)?;
            (x, out) = (x_rest, out_rest);
        }
        Ok(())
    }
}

/// `layer2(relu(layer1(x)))`: the state encoder and the action decoders.
pub(crate) struct EmbodimentMlp {
    layer1: EmbodimentLinear,
    layer2: EmbodimentLinear,
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
        })
    }

    pub(crate) fn out_features(&self) -> usize {
        self.layer2.out_features
    }

    /// Rows of `x`, equally many for each embodiment, to `out`; both buffers take the size that is needed.
    pub(crate) fn apply<'a>(
        &self,
        engine: Engine,
        embodiment_ids: &[usize],
        x: &[f32],
        hidden: &mut Activations,
        out: &'a mut Activations,
        scratch: &mut LinearScratch,
    ) -> Result<&'a mut [f32]> {
        let rows = x.len() / self.layer1.in_features;
        let hidden = sized(hidden, rows * self.layer1.out_features)?; // (rows, hidden)
        let out = sized(out, rows * self.layer2.out_features)?; // (rows, out_features)
        self.layer1
            .apply(engine, embodiment_ids, x, Epilogue::Relu, hidden, scratch)?;
        self.layer2
            .apply(engine, embodiment_ids, hidden, Epilogue::Store, out, scratch)?;
        Ok(out)
    }
}
