//! The layers that the head is made of: loaded by name, run by the kernels.

use std::ops::Range;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};
use half::bf16;
use saccade_kernels::{Epilogue, Isa, LinearScratch, Matrix, PackedLinear, Rows, RowsMut, WeightRef};

use crate::error::{Error, Result};
use crate::layout::{CategoryLinearNames, LinearNames, NormNames, Role};
use crate::precision::Precision;
use crate::profile::{Part, apply, layer_norm};
use saccade_checkpoint::Elements;

/// Which instruction set and how many threads the kernels use, and how precisely they compute.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Engine {
    pub isa: Isa,
    pub threads: usize,
    pub precision: Precision,
}

/// Where layers get their tensors from.
pub(crate) trait TensorSource {
    /// Tensor `name`, whole.
    fn tensor(&self, name: &str) -> Result<Elements>;

    /// Slices `slices` of the first axis of tensor `name`.
    fn slices(&self, name: &str, slices: Range<usize>) -> Result<Elements>;

    /// Takes back a tensor that is not needed any more.
    fn give_back(&self, _used: Elements) {}
}

/// `data` as rows of `width`.
pub(crate) fn rows(data: &[f32], width: usize) -> Rows<'_> {
    Rows::new(data, width)
}

/// `data` as rows of `width`, to be written.
pub(crate) fn rows_mut(data: &mut [f32], width: usize) -> RowsMut<'_> {
    RowsMut::new(data, width)
}

/// Sets the length of a buffer that keeps its memory.
pub(crate) fn sized(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    buffer.resize(len, 0.0);
    buffer
}

/// `(out_features, in_features)` as they are stored.
pub(crate) fn weight_view(elements: &Elements, out_features: usize, in_features: usize) -> WeightRef<'_> {
    let weight = match elements {
        Elements::F32(data) => WeightRef::F32(Matrix::new(data, in_features)),
        Elements::Bf16(data) => WeightRef::Bf16(Matrix::new(data, in_features)),
        Elements::Int8 { values, scales } => WeightRef::Int8 {
            values: Matrix::new(values, in_features),
            scales,
        },
    };
    debug_assert_eq!(weight.shape(), (out_features, in_features));
    weight
}

/// Weights stored in-major `(in_features, out_features)`, as the category-specific layers are.
fn in_major_view(elements: &Elements, in_features: usize, out_features: usize) -> WeightRef<'_> {
    match weight_view(elements, in_features, out_features) {
        WeightRef::F32(view) => WeightRef::F32(view.transpose()),
        WeightRef::Bf16(view) => WeightRef::Bf16(view.transpose()),
        WeightRef::Int8 { .. } => unreachable!("category-specific weights are checked to be floating point"),
    }
}

/// The weights of a layer of this role, rounded to bf16 where it computes in float32 but is to be held in bf16.
fn held(engine: Engine, role: Role, weight: Elements) -> Elements {
    match weight {
        Elements::F32(values) if role == Role::Time && engine.precision.rounds_weights() => {
            Elements::Bf16(values.into_iter().map(bf16::from_f32).collect())
        }
        as_stored => as_stored,
    }
}

fn pack(engine: Engine, role: Role, parts: &[(WeightRef<'_>, Option<&[f32]>)]) -> Result<PackedLinear> {
    let arithmetic = engine.precision.arithmetic(role);
    PackedLinear::pack(engine.isa, arithmetic, engine.threads, parts)
        .map_err(|error| Error::Checkpoint(format!("source: {error}")))
}

/// Packs the layers `parts`, which have the same inputs and role, as one: their outputs stand side by side.
pub(crate) fn load_linear(
    source: &dyn TensorSource,
    engine: Engine,
    parts: &[&LinearNames],
) -> Result<PackedLinear> {
    let mut tensors = Vec::with_capacity(parts.len());
    for names in parts {
        let weight = held(engine, names.role, source.tensor(&names.weight)?);
        tensors.push((weight, source.tensor(&names.bias)?.into_f32()));
    }
    let views: Vec<_> = parts
        .iter()
        .zip(&tensors)
        .map(|(names, (weight, bias))| {
            (
                weight_view(weight, names.out_features, names.in_features),
                Some(bias.as_slice()),
            )
        })
        .collect();
    let layer = pack(engine, parts[0].role, &views)?;
    for (names, (weight, _)) in parts.iter().zip(tensors) {
        if names.role == Role::Block {
            source.give_back(weight);
        }
    }
    Ok(layer)
}

/// An affine layer norm's weight and bias.
pub(crate) struct Norm {
    weight: Vec<f32>,
    bias: Vec<f32>,
    eps: f32,
}

impl Norm {
    pub(crate) fn load(source: &dyn TensorSource, names: &NormNames, eps: f32) -> Result<Self> {
        let weight = source.tensor(&names.weight)?.into_f32();
        let bias = source.tensor(&names.bias)?.into_f32();
        debug_assert_eq!(weight.len(), names.width);
        Ok(Self { weight, bias, eps })
    }

    pub(crate) fn apply(&self, engine: Engine, x: &[f32], out: &mut [f32]) {
        let width = self.weight.len();
        let scale_shift = Some((self.weight.as_slice(), self.bias.as_slice()));
        layer_norm(
            engine,
            rows(x, width),
            self.eps,
            scale_shift,
            rows_mut(out, width),
        );
    }

    pub(crate) fn nbytes(&self) -> usize {
        4 * (self.weight.len() + self.bias.len())
    }
}

/// One linear layer per embodiment: `y = x W[embodiment_id] + b[embodiment_id]`. Only the slices in use are in memory.
pub(crate) struct CategoryLinear {
    /// By embodiment id; `None` where it was not loaded.
    slices: Vec<Option<PackedLinear>>,
}

impl CategoryLinear {
    pub(crate) fn load(
        tensors: &dyn TensorSource,
        engine: Engine,
        names: &CategoryLinearNames,
        embodiment_ids: &[usize],
    ) -> Result<Self> {
        Self::build(names.num_embodiments, embodiment_ids, |id| {
            let weight = tensors.slices(&names.weight, id..id + 1)?;
            let bias = tensors.slices(&names.bias, id..id + 1)?.into_f32();
            let view = in_major_view(&weight, names.in_features, names.out_features);
            pack(engine, Role::Other, &[(view, Some(&bias))])
        })
    }

    fn build(
        num_embodiments: usize,
        embodiment_ids: &[usize],
        mut slice: impl FnMut(usize) -> Result<PackedLinear>,
    ) -> Result<Self> {
        let mut slices: Vec<_> = (0..num_embodiments).map(|_| None).collect();
        for &id in embodiment_ids {
            slices[id] = Some(slice(id)?);
        }
        Ok(Self { slices })
    }

    /// The layer of one embodiment, which the caller has checked to be loaded.
    pub(crate) fn of(&self, embodiment_id: usize) -> &PackedLinear {
        self.slices[embodiment_id]
            .as_ref()
            .expect("embodiment ids are checked against the loaded ones")
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
    ) {
        let (mut x, mut out) = (x, out);
        let (x_element, out_element) = (x.len() / embodiment_ids.len(), out.len() / embodiment_ids.len());
        // Neighbours of one embodiment share a product: the weights are then read once.
        for run in embodiment_ids.chunk_by(|a, b| a == b) {
            let layer = self.of(run[0]);
            let (x_run, x_rest) = x.split_at(x_element * run.len());
            let (out_run, out_rest) = std::mem::take(&mut out).split_at_mut(out_element * run.len());
            apply(
                Part::Embodiment,
                layer,
                engine.threads,
                rows(x_run, layer.in_features()),
                epilogue,
                rows_mut(out_run, layer.out_features()),
                scratch,
            );
            (x, out) = (x_rest, out_rest);
        }
    }

    pub(crate) fn nbytes(&self) -> usize {
        self.slices.iter().flatten().map(PackedLinear::nbytes).sum()
    }
}

/// The action encoder with its first two layers taken apart (spec I12).
///
/// The released layers compute `W2([W1(x); tau])`. The action half of that is linear in `x` and becomes one small layer; the time half,
/// with everything constant added to it, depends on embodiment and bucket only.
pub(crate) struct ActionEncoder {
    /// `W1 W2[0:width]`, without bias: `(encoder_action_dim -> width)`.
    pub action: CategoryLinear,
    /// `tau -> tau W2[width:] + b1 W2[0:width] + b2`.
    pub time: CategoryLinear,
    /// `W3`.
    pub out: CategoryLinear,
}

impl ActionEncoder {
    pub(crate) fn load(
        tensors: &dyn TensorSource,
        engine: Engine,
        [w1, w2, w3]: &[CategoryLinearNames; 3],
        embodiment_ids: &[usize],
    ) -> Result<Self> {
        let width = w3.in_features;
        let num_embodiments = w1.num_embodiments;
        let mut time = Vec::with_capacity(embodiment_ids.len());
        let action = CategoryLinear::build(num_embodiments, embodiment_ids, |id| {
            let first = tensors.slices(&w1.weight, id..id + 1)?.into_f32();
            let first_bias = tensors.slices(&w1.bias, id..id + 1)?.into_f32();
            let second = tensors.slices(&w2.weight, id..id + 1)?;
            let second_bias = tensors.slices(&w2.bias, id..id + 1)?.into_f32();
            let second_view = in_major_view(&second, 2 * width, width);

            // Products in float64: the fused layer is then closer to the exact one than two float32 layers are.
            let action_half = widened(submatrix(second_view, 0, width)); // (out, in)
            let fused = product(action_half.as_ref(), widened_rows(&first, width).transpose()); // (out, action)
            let bias = product(action_half.as_ref(), widened_rows(&first_bias, width).transpose()); // (out, 1)
            let constant: Vec<f32> = second_bias
                .iter()
                .enumerate()
                .map(|(row, &b)| (f64::from(b) + bias[(row, 0)]) as f32)
                .collect();
            let second = held(engine, Role::Time, second);
            let time_half = submatrix(in_major_view(&second, 2 * width, width), width, width);
            time.push(Some(pack(engine, Role::Time, &[(time_half, Some(&constant))])?));

            let columns = 0..fused.ncols();
            let fused: Vec<f32> = (0..fused.nrows())
                .flat_map(|i| columns.clone().map(move |j| (i, j)))
                .map(|(i, j)| fused[(i, j)] as f32)
                .collect();
            let fused = WeightRef::F32(Matrix::new(&fused, columns.len()));
            pack(engine, Role::Other, &[(fused, None)])
        })?;
        let mut time = time.into_iter();
        let time = CategoryLinear::build(num_embodiments, embodiment_ids, |_| {
            Ok(time.next().flatten().expect("one per loaded embodiment"))
        })?;
        let out = CategoryLinear::load(tensors, engine, w3, embodiment_ids)?;
        Ok(Self { action, time, out })
    }

    pub(crate) fn nbytes(&self) -> usize {
        self.action.nbytes() + self.time.nbytes() + self.out.nbytes()
    }
}

/// Columns `first .. first + count` of a `(out, in)` weight.
fn submatrix(weight: WeightRef<'_>, first: usize, count: usize) -> WeightRef<'_> {
    match weight {
        WeightRef::F32(view) => WeightRef::F32(view.columns(first..first + count)),
        WeightRef::Bf16(view) => WeightRef::Bf16(view.columns(first..first + count)),
        WeightRef::Int8 { values, scales } => WeightRef::Int8 {
            values: values.columns(first..first + count),
            scales,
        },
    }
}

fn widened(weight: WeightRef<'_>) -> Mat<f64> {
    match weight {
        WeightRef::F32(view) => Mat::from_fn(view.num_rows(), view.num_columns(), |i, j| {
            f64::from(view.get(i, j))
        }),
        WeightRef::Bf16(view) => Mat::from_fn(view.num_rows(), view.num_columns(), |i, j| {
            view.get(i, j).to_f64()
        }),
        WeightRef::Int8 { values, scales } => {
            Mat::from_fn(values.num_rows(), values.num_columns(), |i, j| {
                f64::from(values.get(i, j)) * f64::from(scales[i])
            })
        }
    }
}

fn widened_rows(data: &[f32], width: usize) -> Mat<f64> {
    widened(WeightRef::F32(Matrix::new(data, width)))
}

fn product(lhs: MatRef<'_, f64>, rhs: MatRef<'_, f64>) -> Mat<f64> {
    let mut out = Mat::zeros(lhs.nrows(), rhs.ncols());
    matmul(&mut out, Accum::Replace, lhs, rhs, 1.0, Par::Seq);
    out
}
