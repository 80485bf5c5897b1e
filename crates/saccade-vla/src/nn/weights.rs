//! Named weights. A model is described once, by the code that builds its layers from [`Weights`]; the result
//! depends on the [`Source`] that the description is run against.

use std::cell::Cell;

use half::bf16;
use saccade_vla_checkpoint::spec::{NONE, TABLE, WEIGHT};
use saccade_vla_checkpoint::{Elements, TensorSpec};
use saccade_vla_kernels::{Matrix, PackedLinear, WeightRef, quantize_rows};

use super::source::{Outline, Request, Source, Stored, Tensor, Weight, weight_view};
use crate::alloc::{collected, filled, product};
use crate::array::{OwnedArray, first_not_finite, first_where, unravel};
use crate::engine::Engine;
use crate::error::{Error, Result, problem, show_shape};
use crate::ops::{check_interrupted, packing_error};
use crate::precision::Role;

/// What all layers of one model are made of, and their bytes so far.
struct Builder<'a> {
    source: &'a dyn Source,
    engine: Engine,
    nbytes: Cell<usize>,
}

/// The layers that `build` makes of a source, and their bytes.
pub(crate) fn build<L>(
    source: &dyn Source,
    engine: Engine,
    build: impl FnOnce(&Weights<'_>) -> Result<L>,
) -> Result<(L, usize)> {
    let builder = &Builder {
        source,
        engine,
        nbytes: Cell::new(0),
    };
    let path = String::new();
    let layers = build(&Weights { builder, path })?;
    Ok((layers, builder.nbytes.get()))
}

/// The weights below one name.
#[derive(Clone)]
pub(crate) struct Weights<'a> {
    builder: &'a Builder<'a>,
    path: String,
}

impl Weights<'_> {
    /// The weights below `name`.
    pub(crate) fn at(&self, name: impl std::fmt::Display) -> Self {
        Self {
            builder: self.builder,
            path: self.name(name),
        }
    }

    /// The name of a tensor.
    pub(crate) fn name(&self, name: impl std::fmt::Display) -> String {
        match self.path.as_str() {
            "" => name.to_string(),
            path => format!("{path}.{name}"),
        }
    }

    pub(crate) fn engine(&self) -> Engine {
        self.builder.engine
    }

    /// The weight of a layer of this role, `(out_features, in_features)` or with several axes in place of the
    /// last one.
    pub(crate) fn weight(&self, role: Role, shape: &[usize]) -> Result<Tensor> {
        let weight = self.read(Request {
            spec: TensorSpec {
                quantized_types: if role.is_given_back() { WEIGHT } else { NONE },
                ..TensorSpec::plain(&self.name("weight"), shape)
            },
            slices: None,
            is_given_back: role.is_given_back(),
        })?;
        weight.held_as(self.engine(), role)
    }

    /// The vector `name`, which will be part of a packed layer. Empty if the source gives an outline.
    pub(crate) fn bias(&self, name: &str, len: usize) -> Result<Vec<f32>> {
        self.read(self.request(name, &[len]))?.into_f32()
    }

    /// The vector `name`, kept as float32. Empty if the source gives an outline.
    pub(crate) fn vector(&self, name: &str, len: usize) -> Result<Vec<f32>> {
        self.count(4 * len);
        self.bias(name, len)
    }

    /// The first `count` rows of the table `weight`, kept as float32. None if the source gives an outline.
    pub(crate) fn table(&self, shape: [usize; 2], count: usize) -> Result<OwnedArray> {
        self.count(4 * count * shape[1]);
        let table = self.read(Request {
            slices: (count != shape[0]).then_some(0..count),
            ..self.request("weight", &shape)
        })?;
        let table = table.into_f32()?;
        let rows = if table.is_empty() { 0 } else { count };
        OwnedArray::new(table, &[rows, shape[1]])
    }

    /// The table `weight`, whose rows are looked up: as int8 with a scale for each row if that is what is
    /// computed in, in bf16 if that is how it is stored or what is computed in, else in float32.
    pub(crate) fn looked_up(&self, shape: [usize; 2]) -> Result<Tensor> {
        let mut request = self.request("weight", &shape);
        request.spec.quantized_types = TABLE;
        let table = self.read(request)?;
        let [rows, width] = shape;
        let is_int8 = self.engine().precision.quantizes_tables();
        let table = match table {
            Tensor::Held(elements @ Elements::Int8 { .. }) if is_int8 => Tensor::Held(elements),
            Tensor::Held(elements) if is_int8 => quantized(&elements, shape)?,
            Tensor::Held(Elements::Int8 { values, scales }) if self.engine().precision.rounds_weights() => {
                let rows = values.chunks_exact(width.max(1)).zip(&scales);
                let rounded = rows.flat_map(|(row, &scale)| {
                    row.iter()
                        .map(move |&value| bf16::from_f32(f32::from(value) * scale))
                });
                Tensor::Held(Elements::Bf16(collected("weights", values.len(), rounded)?))
            }
            Tensor::Held(elements @ Elements::Int8 { .. }) => {
                Tensor::Held(Elements::F32(elements.into_f32()?))
            }
            table => table.rounded(self.engine())?,
        };
        self.count(match &table {
            _ if is_int8 => rows * (size_of::<i8>() * width + size_of::<f32>()),
            Tensor::Held(Elements::Bf16(_)) | Tensor::Outline(Stored::Bf16) => {
                size_of::<bf16>() * rows * width
            }
            _ => size_of::<f32>() * rows * width,
        });
        Ok(table)
    }

    /// Slice `id` of tensor `name`, whose first axis is of embodiments.
    pub(crate) fn slice(&self, name: &str, shape: &[usize], id: usize) -> Result<Tensor> {
        self.read(Request {
            spec: TensorSpec {
                is_stacked: true,
                ..TensorSpec::plain(&self.name(name), shape)
            },
            slices: Some(id..id + 1),
            is_given_back: false,
        })
    }

    /// Packs weights with their biases as one layer: their outputs are concatenated. Biases of outlines are
    /// not looked at.
    pub(crate) fn pack(&self, role: Role, parts: &[(Weight<'_>, Option<&[f32]>)]) -> Result<PackedLinear> {
        let engine = self.engine();
        let arithmetic = engine.precision.arithmetic(role);
        let in_features = parts[0].0.in_features();
        let mut held = Vec::with_capacity(parts.len());
        let mut outline: Option<Outline> = None;
        for (weight, bias) in parts {
            match *weight {
                Weight::Held(weight) => held.push((weight, *bias)),
                Weight::Outline(part) => {
                    outline = Some(outline.map_or(part, |all| Outline {
                        stored: all.stored.min(part.stored),
                        out_features: all.out_features + part.out_features,
                        ..all
                    }));
                }
            }
        }
        if let Some(outline) = outline {
            self.count(self.builder.source.packed_nbytes(role, outline)?);
            // Stands in for the layer: the same inputs and no output.
            held = vec![(WeightRef::F32(Matrix::new(&[], in_features)), None)];
        }
        let packed =
            PackedLinear::pack(engine.isa, arithmetic, engine.threads, &held).map_err(packing_error)?;
        let packed = match role.keeps_outliers() {
            true => packed.keeping_outliers(),
            false => packed,
        };
        if outline.is_none() {
            self.count(packed.nbytes());
        }
        Ok(packed)
    }

    /// Gives the memory of a weight back, for the next one.
    pub(crate) fn give_back(&self, used: Tensor) {
        if let Tensor::Held(elements) = used {
            self.builder.source.give_back(elements);
        }
    }

    /// A request of a whole tensor that is kept.
    fn request(&self, name: &str, shape: &[usize]) -> Request {
        Request {
            spec: TensorSpec::plain(&self.name(name), shape),
            slices: None,
            is_given_back: false,
        }
    }

    fn count(&self, bytes: usize) {
        self.builder.nbytes.set(self.builder.nbytes.get() + bytes);
    }

    /// # Errors
    /// [`Error::Checkpoint`] also for a tensor with an element that is not finite.
    fn read(&self, request: Request) -> Result<Tensor> {
        check_interrupted()?;
        let tensor = self.builder.source.tensor(&request)?;
        if let Tensor::Held(elements) = &tensor {
            check_finite(&request, elements)?;
        }
        Ok(tensor)
    }
}

/// The rows of a table as int8, each with its scale.
fn quantized(table: &Elements, [num_rows, width]: [usize; 2]) -> Result<Tensor> {
    /// Rows between two looks at whether the call is to stop.
    const TOGETHER: usize = 4096;
    let mut values = filled("weights", product("weights", &[num_rows, width])?, 0_i8)?;
    let mut scales = filled("weights", num_rows, 0.0)?;
    let view = weight_view(table, num_rows, width);
    for first in (0..num_rows).step_by(TOGETHER) {
        check_interrupted()?;
        let rows = first..num_rows.min(first + TOGETHER);
        let values = &mut values[rows.start * width..rows.end * width];
        quantize_rows(view.rows(rows.clone()), values, &mut scales[rows]);
    }
    Ok(Tensor::Held(Elements::Int8 { values, scales }))
}

/// Checks that nothing follows the last weight of a row of int4, where their number is odd: it would be multiplied.
fn check_padding(request: &Request, values: &[u8]) -> Result<()> {
    let spec = &request.spec;
    let in_features: usize = spec.shape[1..].iter().product();
    let is_padded = |row: &[u8]| row.last().is_none_or(|last| last >> 4 == 0);
    let bad = values
        .chunks_exact(in_features.div_ceil(2).max(1))
        .position(|row| in_features % 2 == 1 && !is_padded(row));
    match bad {
        None => Ok(()),
        Some(row) => Err(Error::Checkpoint(problem!(
            &spec.name; "row {row} has {in_features} weights of four bits, expected zero in the high half of its last byte"
        ))),
    }
}

/// Checks that weights are finite. One that is not spoils every action, without a sign of where it comes
/// from.
fn check_finite(request: &Request, elements: &Elements) -> Result<()> {
    let (position, value) = match elements {
        Elements::F32(values) => match first_not_finite(values) {
            None => return Ok(()),
            Some(position) => (position, values[position]),
        },
        Elements::Bf16(values) => match first_where(values, |value| !value.is_finite()) {
            None => return Ok(()),
            Some(position) => (position, values[position].to_f32()),
        },
        // Values and scales are checked where they are read.
        Elements::Int8 { .. } => return Ok(()),
        Elements::Int4 { values, .. } => return check_padding(request, values),
    };
    let spec = &request.spec;
    let first = request.slices.as_ref().map_or(0, |slices| slices.start);
    let slice: usize = spec.shape[1..].iter().product();
    Err(Error::Checkpoint(problem!(
        &spec.name; expected "finite weights";
        got "{value} at index {}", show_shape(&unravel(first * slice + position, &spec.shape))
    )))
}
