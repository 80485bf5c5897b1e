//! Which tensors a model needs, and whether those of a checkpoint fit, by their names, shapes and types alone.

use std::collections::BTreeSet;

use safetensors::Dtype;

use crate::error::show_shape;

/// What the name of a tensor's scales adds to its own: `X.weight` of int8 or int4 has `X.weight_scale`.
pub const SCALE_SUFFIX: &str = "_scale";

/// Types of a tensor that is stored as floating point alone.
pub const NONE: &[Dtype] = &[];
/// Types of a table whose rows are looked up: int8.
pub const TABLE: &[Dtype] = &[Dtype::I8];
/// Types of a linear layer's weight: int8, and int4, two elements of a row in a byte.
pub const WEIGHT: &[Dtype] = &[Dtype::I8, Dtype::U8];

/// A tensor that a checkpoint must hold.
#[derive(Clone, Debug)]
pub struct TensorSpec {
    /// Its name, without the prefix of the model in the checkpoint.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// The types of whole numbers that it may be stored as, with a scale for each row: [`NONE`], [`TABLE`] or [`WEIGHT`].
    pub quantized_types: &'static [Dtype],
    /// Whether its first axis counts equal layers, of which a row of a batch uses one.
    pub is_stacked: bool,
}

impl TensorSpec {
    /// A floating-point tensor of one layer.
    #[must_use]
    pub fn plain(name: &str, shape: &[usize]) -> Self {
        Self {
            name: name.to_owned(),
            shape: shape.to_vec(),
            quantized_types: NONE,
            is_stacked: false,
        }
    }

    /// The shape that it has in a file of this type: of int4, rows of half as many bytes, rounded up.
    #[must_use]
    pub fn shape_as(&self, dtype: Dtype) -> Vec<usize> {
        match self.shape.split_first() {
            Some((&rows, rest)) if dtype == Dtype::U8 && self.quantized_types.contains(&dtype) => {
                vec![rows, rest.iter().product::<usize>().div_ceil(2)]
            }
            _ => self.shape.clone(),
        }
    }
}

/// Whether elements of this type are whole numbers that a scale for each row multiplies.
#[must_use]
pub fn is_quantized(dtype: Dtype) -> bool {
    matches!(dtype, Dtype::I8 | Dtype::U8)
}

/// One thing that is wrong.
#[derive(Clone, Debug)]
pub enum TensorProblem {
    /// A tensor of another shape.
    Shape(String),
    /// A tensor that is missing, unknown or of another type.
    Other(String),
}

impl TensorProblem {
    /// The tensor, what it is and what was expected.
    #[must_use]
    pub fn text(&self) -> &str {
        match self {
            Self::Shape(text) | Self::Other(text) => text,
        }
    }
}

/// All that is wrong with the tensors `names`, whose type and shape `describe` gives. Under `prefix` there must be the `expected` ones, and
/// there may be those for which `is_unused(name without the prefix, shape)` is true.
pub fn problems<'a>(
    names: impl Iterator<Item = &'a str>,
    describe: impl Fn(&str) -> Option<(Dtype, &'a [usize])>,
    prefix: &str,
    expected: &[TensorSpec],
    is_unused: impl Fn(&str, &[usize]) -> bool,
) -> Vec<TensorProblem> {
    let mut problems = Vec::new();
    let mut known = BTreeSet::new();
    for spec in expected {
        let name = format!("{prefix}{}", spec.name);
        let scale = format!("{name}{SCALE_SUFFIX}");
        match describe(&name) {
            // A tensor without elements carries nothing, and some writers leave it out.
            None if spec.shape.contains(&0) => {}
            None => problems.push(TensorProblem::Other(format!(
                "{name} is missing, expected {}",
                show_shape(&spec.shape)
            ))),
            Some((dtype, shape)) if shape != spec.shape_as(dtype) => {
                problems.push(TensorProblem::Shape(format!(
                    "{name} has shape {}, expected {}",
                    show_shape(shape),
                    show_shape(&spec.shape_as(dtype))
                )));
            }
            Some((dtype, _)) if spec.quantized_types.contains(&dtype) => {
                problems.extend(scale_problem(
                    &describe,
                    &name,
                    dtype,
                    &scale,
                    spec.shape.first().copied().unwrap_or(1),
                ));
                known.insert(scale);
            }
            Some((dtype, _)) if !is_readable(dtype) => {
                let quantized = match listed(spec.quantized_types) {
                    types if types.is_empty() => types,
                    types => format!(", or {types} with its scale"),
                };
                problems.push(TensorProblem::Other(format!(
                    "{name} is {dtype:?}, expected F32, BF16 or F16{quantized}"
                )));
            }
            Some((dtype, _)) if !spec.quantized_types.is_empty() && describe(&scale).is_some() => {
                problems.push(TensorProblem::Other(format!(
                    "{scale} is there, but {name} is {dtype:?}, expected {}",
                    listed(spec.quantized_types)
                )));
                known.insert(scale);
            }
            Some(_) => {}
        }
        known.insert(name);
    }
    for name in names.filter(|name| name.starts_with(prefix) && !known.contains(*name)) {
        let shape = describe(name).map_or(&[] as &[usize], |(_, shape)| shape);
        if !is_unused(&name[prefix.len()..], shape) {
            problems.push(TensorProblem::Other(format!("{name} is unknown")));
        }
    }
    problems
}

/// What is wrong with the tensor `scale`, the scales of the tensor `name` of this type and of `rows` rows.
pub(crate) fn scale_problem<'a>(
    describe: impl Fn(&str) -> Option<(Dtype, &'a [usize])>,
    name: &str,
    dtype: Dtype,
    scale: &str,
    rows: usize,
) -> Option<TensorProblem> {
    match describe(scale) {
        None => Some(TensorProblem::Other(format!(
            "{name} is {dtype:?} and {scale} is missing, expected ({rows},)"
        ))),
        Some((_, shape)) if shape != [rows] => Some(TensorProblem::Shape(format!(
            "{scale} has shape {}, expected ({rows},)",
            show_shape(shape)
        ))),
        Some((of_scale, _)) if of_scale != Dtype::F32 => Some(TensorProblem::Other(format!(
            "{scale} is {of_scale:?}, expected F32"
        ))),
        Some(_) => None,
    }
}

fn listed(types: &[Dtype]) -> String {
    let names: Vec<_> = types.iter().map(|dtype| format!("{dtype:?}")).collect();
    names.join(" or ")
}

/// Whether a tensor of this type holds floating-point numbers that can be read.
fn is_readable(dtype: Dtype) -> bool {
    matches!(dtype, Dtype::F32 | Dtype::BF16 | Dtype::F16)
}

/// The problems, one on a line, of tensors that should fit `what`.
#[must_use]
pub fn list(problems: &[TensorProblem], what: &str) -> String {
    let lines: Vec<&str> = problems.iter().map(TensorProblem::text).collect();
    let noun = if problems.len() == 1 {
        "tensor does"
    } else {
        "tensors do"
    };
    format!(
        "{} {noun} not fit {what}:\n  {}",
        problems.len(),
        lines.join("\n  ")
    )
}
