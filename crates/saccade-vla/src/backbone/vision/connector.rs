//! The connector between vision tower and language model: squares of patches are joined, normed, and
//! projected to the width of the language model.
//!
//! Equations 22 and 23 of docs/equations.md.

use saccade_vla_kernels::{Epilogue, Rows, RowsMut};

use crate::alloc::{Scratch, filled, product};
use crate::engine::Kernels;
use crate::error::Result;
use crate::nn::linear::Linear;
use crate::nn::norm::LayerNorm;
use crate::nn::weights::Weights;
use crate::precision::Role;
use crate::profile::Part;
use crate::release::PatchOrder;

/// `linear2(gelu(linear1(norm(x))))`, or one linear layer alone.
pub(super) struct Connector {
    norm: Option<LayerNorm>,
    first: Linear,
    second: Option<Linear>,
}

/// The names of the parts of a connector.
pub(super) struct ConnectorNames {
    pub norm: &'static str,
    pub layers: [&'static str; 2],
}

/// The width of the norm and of the three sides of the two layers.
pub(super) struct ConnectorSizes {
    /// The width of a patch, or that of the joined ones.
    pub norm: usize,
    pub input: usize,
    pub hidden: usize,
    pub output: usize,
}

/// Memory kept between calls.
#[derive(Default)]
pub(super) struct ConnectorWorkspace {
    normed: Scratch,
    hidden: Scratch,
}

impl Connector {
    /// One linear layer, with a bias.
    pub(super) fn linear(weights: &Weights<'_>, input: usize, output: usize) -> Result<Self> {
        Ok(Self {
            norm: None,
            first: Linear::new(weights, input, output, Role::Other)?.counted(Part::Connector),
            second: None,
        })
    }

    /// A norm and two layers.
    pub(super) fn new(
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

    /// The tokens `(tokens, output)` of rows of the width of the norm, several of which make a token if that
    /// is the width of a patch.
    pub(super) fn tokens(
        &self,
        kernels: &mut Kernels<'_>,
        x: Rows<'_>,
        workspace: &mut ConnectorWorkspace,
    ) -> Result<Vec<f32>> {
        let ConnectorWorkspace { normed, hidden } = workspace;
        let x = match &self.norm {
            Some(norm) => {
                norm.apply(kernels.engine, x, normed.rows(x.num_rows(), x.num_columns())?)?;
                let patches_of_token = self.first.in_features() / x.num_columns();
                normed.as_rows().joined(patches_of_token)
            }
            None => x,
        };
        let (last, x) = match &self.second {
            Some(second) => {
                let rows = hidden.rows(x.num_rows(), self.first.out_features())?;
                self.first.apply(kernels, x, Epilogue::GeluErf, rows)?;
                (second, hidden.as_rows())
            }
            None => (&self.first, x),
        };
        let len = product("tokens of views", &[x.num_rows(), last.out_features()])?;
        let mut tokens = filled("tokens of views", len, 0.0)?;
        let out = RowsMut::new(&mut tokens, last.out_features());
        last.apply(kernels, x, Epilogue::Store, out)?;
        Ok(tokens)
    }
}

/// Pixel shuffle: joins the squares of `merge` patches on each side of a view `x (rows * columns, width)`,
/// row by row, to `out (rows * columns / merge^2, merge^2 * width)`.
pub(super) fn pixel_shuffle(
    merge: usize,
    order: PatchOrder,
    [rows, columns]: [usize; 2],
    x: Rows<'_>,
    mut out: RowsMut<'_>,
) {
    let (width, patches) = (x.num_columns(), merge * merge);
    let squares = (0..rows)
        .step_by(merge)
        .flat_map(|row| (0..columns).step_by(merge).map(move |column| [row, column]));
    for ([row, column], out) in squares.zip(out.iter_mut()) {
        for inside in 0..patches {
            let patch = x.row((row + inside / merge) * columns + column + inside % merge);
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
