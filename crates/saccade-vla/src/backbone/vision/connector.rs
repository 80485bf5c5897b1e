//! From patches to tokens: squares of patches are joined, normed, and projected to the width of the language model.

use saccade_vla_kernels::{Activations, Epilogue, LinearScratch};

use crate::alloc::sized;
use crate::backbone::config::PatchOrder;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::linear::Linear;
use crate::nn::norm::LayerNorm;
use crate::nn::weights::Weights;
use crate::precision::Role;
use crate::profile::Part;

/// `linear2(gelu(linear1(norm(x))))`, or one linear layer alone.
pub(crate) struct Connector {
    norm: Option<LayerNorm>,
    first: Linear,
    second: Option<Linear>,
}

/// What the parts of a connector are called.
pub(crate) struct ConnectorNames {
    pub norm: &'static str,
    pub layers: [&'static str; 2],
}

/// The width of the norm and of the three sides of the two layers.
pub(crate) struct ConnectorSizes {
    pub norm: usize,
    pub input: usize,
    pub hidden: usize,
    pub output: usize,
}

/// Memory of one call that is kept for the next.
#[derive(Default)]
pub(crate) struct ConnectorBuffers {
    pub joined: Activations,
    pub normed: Activations,
    pub hidden: Activations,
}

impl Connector {
    /// One linear layer, with a bias.
    pub(crate) fn linear(weights: &Weights<'_>, input: usize, output: usize) -> Result<Self> {
        Ok(Self {
            norm: None,
            first: Linear::new(weights, input, output, Role::Other)?.counted(Part::Connector),
            second: None,
        })
    }

    /// A norm and two layers. The norm is over rows of `sizes.norm`, the width of a patch or of several that are joined.
    pub(crate) fn new(
        weights: &Weights<'_>,
        names: &ConnectorNames,
        sizes: &ConnectorSizes,
        eps: f32,
    ) -> Result<Self> {
        let [first, second] = names.layers.map(|name| weights.at(name));
        let first = Linear::new(&first, sizes.input, sizes.hidden, Role::Other)?;
        let second = Linear::new(&second, sizes.hidden, sizes.output, Role::Other)?;
        Ok(Self {
            norm: Some(LayerNorm::new(&weights.at(names.norm), sizes.norm, eps)?),
            first: first.counted(Part::Connector),
            second: Some(second.counted(Part::Connector)),
        })
    }

    /// The tokens `out (tokens, output)` of joined patches `x (tokens, input)`.
    pub(crate) fn apply(
        &self,
        engine: Engine,
        x: &[f32],
        (buffers, scratch): ([&mut Activations; 2], &mut LinearScratch),
        out: &mut [f32],
    ) -> Result<()> {
        let [normed, hidden] = buffers;
        let x = match &self.norm {
            Some(norm) => {
                let normed = sized(normed, x.len())?;
                norm.apply(engine, x, normed)?;
                normed
            }
            None => x,
        };
        let Some(second) = &self.second else {
            return self.first.apply(engine, x, Epilogue::Store, out, scratch);
        };
        let rows = x.len() / self.first.in_features();
        let hidden = sized(hidden, rows * self.first.out_features())?;
        self.first.apply(engine, x, Epilogue::GeluErf, hidden, scratch)?;
        second.apply(engine, hidden, Epilogue::Store, out, scratch)
    }

    pub(crate) fn out_features(&self) -> usize {
        self.second.as_ref().unwrap_or(&self.first).out_features()
    }
}

/// Joins the squares of `merge` patches on each side of a view `x (rows * columns, width)`, row by row, to
/// `out (rows * columns / merge^2, merge^2 * width)`.
pub(crate) fn join(merge: usize, order: PatchOrder, [rows, columns]: [usize; 2], x: &[f32], out: &mut [f32]) {
    let (width, patches) = (x.len() / (rows * columns), merge * merge);
    let squares = (0..rows)
        .step_by(merge)
        .flat_map(|row| (0..columns).step_by(merge).map(move |column| [row, column]));
    for ([row, column], out) in squares.zip(out.chunks_exact_mut(patches * width)) {
        for inside in 0..patches {
            let patch = (row + inside / merge) * columns + column + inside % merge;
            let patch = &x[patch * width..][..width];
            match order {
                PatchOrder::PatchFirst => out[inside * width..][..width].copy_from_slice(patch),
                PatchOrder::PatchLast => {
                    let elements = out.chunks_exact_mut(patches).zip(patch);
                    elements.for_each(|(out, element)| out[inside] = *element);
                }
            }
        }
    }
}
