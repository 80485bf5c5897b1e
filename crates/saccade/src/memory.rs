//! Tensors in the caller's memory, taken like those of a file.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::Range;

use half::slice::HalfBitsSliceExt;
use half::{bf16, f16};
use safetensors::Dtype;

use crate::error::{Error, Result, show_shape};
use crate::layers::TensorSource;
use saccade_checkpoint::spec::{self, Problem};
use saccade_checkpoint::{Elements, TensorSpec};

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
    fn to_elements(self, spare: Option<Elements>) -> Elements {
        fn fill<T>(memory: Option<Vec<T>>, values: impl Iterator<Item = T>) -> Vec<T> {
            let mut memory = memory.unwrap_or_default();
            memory.clear();
            memory.extend(values);
            memory
        }
        let (floats, halves) = match spare {
            Some(Elements::F32(floats)) => (Some(floats), None),
            Some(Elements::Bf16(halves)) => (None, Some(halves)),
            _ => (None, None),
        };
        match self {
            Self::F32(values) => Elements::F32(fill(floats, values.iter().copied())),
            Self::Bf16(bits) => Elements::Bf16(fill(halves, bits.reinterpret_cast::<bf16>().iter().copied())),
            Self::F16(bits) => {
                let values = bits.reinterpret_cast::<f16>().iter();
                Elements::F32(fill(floats, values.map(|value| value.to_f32())))
            }
        }
    }
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
    /// # Panics
    /// If there are more or fewer than the shape says.
    #[must_use]
    pub fn new(shape: &[usize], elements: ElementsRef<'a>) -> Self {
        assert_eq!(
            shape.iter().product::<usize>(),
            elements.len(),
            "as many elements as the shape says"
        );
        Self {
            shape: shape.to_vec(),
            elements,
        }
    }
}

/// Tensors by name.
pub type TensorViews<'a> = BTreeMap<String, TensorView<'a>>;

/// The shape of tensor `name`, if it is there.
pub(crate) fn shape_of<'a>(tensors: &'a TensorViews<'_>, name: &str) -> Option<&'a [usize]> {
    tensors.get(name).map(|tensor| tensor.shape.as_slice())
}

/// All that is wrong with `tensors`: exactly the `expected` ones must be there, and those that `is_unused` knows may.
pub(crate) fn problems(
    tensors: &TensorViews<'_>,
    expected: &[TensorSpec],
    is_unused: impl Fn(&str, &[usize]) -> bool,
) -> Vec<Problem> {
    let describe = |name: &str| {
        let tensor = tensors.get(name)?;
        Some((tensor.elements.dtype(), tensor.shape.as_slice()))
    };
    let names = tensors.keys().map(String::as_str);
    spec::problems(names, describe, "", expected, is_unused)
}

/// Tensors in memory as layers take them: each is copied when it is asked for, and the memory of the last copy is used again.
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
        tensor.ok_or_else(|| Error::Checkpoint(format!("tensors: {name} is missing")))
    }
}

impl TensorSource for MemorySource<'_> {
    fn tensor(&self, name: &str) -> Result<Elements> {
        let elements = self.tensor_view(name)?.elements;
        Ok(elements.to_elements(self.spare.take()))
    }

    fn slices(&self, name: &str, slices: Range<usize>) -> Result<Elements> {
        let TensorView { shape, elements } = self.tensor_view(name)?;
        match shape.split_first() {
            Some((&size, rest)) if slices.start <= slices.end && slices.end <= size => {
                let width: usize = rest.iter().product();
                let range = slices.start * width..slices.end * width;
                Ok(elements.range(range).to_elements(None))
            }
            _ => Err(Error::Checkpoint(format!(
                "tensors: {name} has shape {} and no slices {slices:?}",
                show_shape(shape)
            ))),
        }
    }

    fn give_back(&self, used: Elements) {
        self.spare.replace(Some(used));
    }
}
