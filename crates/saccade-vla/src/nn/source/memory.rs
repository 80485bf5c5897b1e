//! Tensors in the caller's memory, taken like those of a file.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::Range;

use half::slice::HalfBitsSliceExt;
use half::{bf16, f16};
use safetensors::Dtype;

use super::{Request, Source, Tensor};
use crate::alloc::reserve;
use crate::array::check_length;
use crate::error::{Error, Problem, Result, bail, problem, show_shape};
use crate::ops::check_interrupted;
use saccade_vla_checkpoint::spec::{self, TensorProblem};
use saccade_vla_checkpoint::{Elements, TensorSpec};

/// The elements of a tensor that someone else holds, row-major.
#[derive(Clone, Copy, Debug)]
pub enum ElementsRef<'a> {
    /// float32.
    F32(&'a [f32]),
    /// The bits of bfloat16.
    Bf16(&'a [u16]),
    /// The bits of float16.
    F16(&'a [u16]),
}

impl<'a> ElementsRef<'a> {
    fn len(&self) -> usize {
        match self {
            Self::F32(values) => values.len(),
            Self::Bf16(bits) | Self::F16(bits) => bits.len(),
        }
    }

    fn dtype(&self) -> Dtype {
        match self {
            Self::F32(_) => Dtype::F32,
            Self::Bf16(_) => Dtype::BF16,
            Self::F16(_) => Dtype::F16,
        }
    }

    fn range(self, range: Range<usize>) -> ElementsRef<'a> {
        match self {
            Self::F32(values) => Self::F32(&values[range]),
            Self::Bf16(bits) => Self::Bf16(&bits[range]),
            Self::F16(bits) => Self::F16(&bits[range]),
        }
    }

    /// A copy, in the memory of `spare` if that has its type.
    fn to_elements(self, spare: Option<Elements>) -> Result<Elements> {
        let (floats, halves) = match spare {
            Some(Elements::F32(floats)) => (floats, Vec::new()),
            Some(Elements::Bf16(halves)) => (Vec::new(), halves),
            _ => (Vec::new(), Vec::new()),
        };
        Ok(match self {
            Self::F32(values) => Elements::F32(copied(floats, values, |value| *value)?),
            Self::Bf16(bits) => {
                let values: &[bf16] = bits.reinterpret_cast();
                Elements::Bf16(copied(halves, values, |value| *value)?)
            }
            Self::F16(bits) => {
                let values: &[f16] = bits.reinterpret_cast();
                Elements::F32(copied(floats, values, |value| value.to_f32())?)
            }
        })
    }
}

/// Elements between two looks at whether the call is to stop.
const TOGETHER: usize = 1 << 20;

/// `values`, converted, in `memory`.
fn copied<S, T>(mut memory: Vec<T>, values: &[S], convert: impl Fn(&S) -> T) -> Result<Vec<T>> {
    memory.clear();
    reserve("weights", &mut memory, values.len())?;
    for values in values.chunks(TOGETHER) {
        check_interrupted()?;
        memory.extend(values.iter().map(&convert));
    }
    Ok(memory)
}

/// A tensor that someone else holds.
#[derive(Clone, Debug)]
pub struct TensorView<'a> {
    shape: Vec<usize>,
    elements: ElementsRef<'a>,
}

impl<'a> TensorView<'a> {
    /// `elements` of this shape.
    ///
    /// # Errors
    /// [`Error::Shape`] if there are more or fewer than the shape says.
    pub fn new(shape: &[usize], elements: ElementsRef<'a>) -> Result<Self> {
        check_length("tensors", elements.len(), shape)?;
        Ok(Self {
            shape: shape.to_vec(),
            elements,
        })
    }
}

/// Tensors by name.
pub type TensorViews<'a> = BTreeMap<String, TensorView<'a>>;

/// The shape of tensor `name`, if it is there.
pub(crate) fn shape_of<'a>(tensors: &'a TensorViews<'_>, name: &str) -> Option<&'a [usize]> {
    tensors.get(name).map(|tensor| tensor.shape.as_slice())
}

/// All problems of `tensors`: exactly the `expected` ones must be there, and those that `is_unused` knows
/// may.
pub(crate) fn problems(
    tensors: &TensorViews<'_>,
    expected: &[TensorSpec],
    is_unused: impl Fn(&str, &[usize]) -> bool,
) -> Vec<TensorProblem> {
    let describe = |name: &str| {
        let tensor = tensors.get(name)?;
        Some((tensor.elements.dtype(), tensor.shape.as_slice()))
    };
    let names = tensors.keys().map(String::as_str);
    spec::problems(names, describe, "", expected, is_unused)
}

/// Checks that there are none; `list` shows them.
///
/// # Errors
/// [`Error::Shape`] if shapes alone are wrong, else [`Error::Checkpoint`].
pub(crate) fn check(problems: &[TensorProblem], list: impl Fn(&[TensorProblem]) -> String) -> Result<()> {
    if problems.is_empty() {
        return Ok(());
    }
    let problem = Problem::new("tensors", list(problems));
    let is_shape = |problem: &TensorProblem| matches!(problem, TensorProblem::Shape(_));
    Err(match problems.iter().all(is_shape) {
        true => Error::Shape(problem),
        false => Error::Checkpoint(problem),
    })
}

/// Tensors in memory as layers take them: each is copied when it is asked for, and the memory of the last
/// copy is used again.
pub(crate) struct MemorySource<'a> {
    tensors: &'a TensorViews<'a>,
    spare: RefCell<Option<Elements>>,
}

impl<'a> MemorySource<'a> {
    pub(crate) fn new(tensors: &'a TensorViews<'a>) -> Self {
        Self {
            tensors,
            spare: RefCell::new(None),
        }
    }

    fn tensor_view(&self, name: &str) -> Result<&TensorView<'a>> {
        let tensor = self.tensors.get(name);
        tensor.ok_or_else(|| Error::Checkpoint(problem!("tensors"; "{name} is missing")))
    }
}

impl Source for MemorySource<'_> {
    fn tensor(&self, request: &Request) -> Result<Tensor> {
        let Request { spec, slices, .. } = request;
        if spec.shape.contains(&0) {
            return Ok(Tensor::Held(Elements::F32(Vec::new())));
        }
        let TensorView { shape, elements } = self.tensor_view(&spec.name)?;
        let elements = match (slices, shape.split_first()) {
            (None, _) => elements.to_elements(self.spare.take())?,
            (Some(slices), Some((&size, rest))) if slices.start <= slices.end && slices.end <= size => {
                let width: usize = rest.iter().product();
                let range = slices.start * width..slices.end * width;
                elements.range(range).to_elements(None)?
            }
            (Some(slices), _) => {
                bail!(
                    Checkpoint, "tensors";
                    "{} has shape {} and no slices {slices:?}", spec.name, show_shape(shape)
                );
            }
        };
        Ok(Tensor::Held(elements))
    }

    fn give_back(&self, used: Elements) {
        self.spare.replace(Some(used));
    }
}
