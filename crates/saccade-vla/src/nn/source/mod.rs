//! The back ends that a model's description is run against: the list of its tensors (planner), its size in memory
//! (sizer), or its layers (a file, or tensors in memory).

pub(crate) mod file;
pub(crate) mod memory;
pub(crate) mod planner;
pub(crate) mod sizer;

use std::ops::Range;

use half::bf16;
use saccade_vla_checkpoint::{Elements, TensorSpec};
use saccade_vla_kernels::{Matrix, WeightRef};

use crate::alloc::collected;
use crate::engine::Engine;
use crate::error::Result;
use crate::precision::Role;

/// A tensor that a layer asks for.
pub(crate) struct Request {
    pub spec: TensorSpec,
    /// Slices of the first axis; none asks for the whole tensor.
    pub slices: Option<Range<usize>>,
    /// True if its memory comes back to be read into again: only a tensor that is not kept may be read into
    /// larger memory than it needs.
    pub is_given_back: bool,
}

/// One of the back ends that a model's description is run against.
pub(crate) trait Source {
    /// The tensor, or its outline where nothing but names and sizes is wanted. One without elements need not
    /// be there.
    ///
    /// # Errors
    /// As the source has them: a tensor that is missing or cannot be read.
    fn tensor(&self, request: &Request) -> Result<Tensor>;

    /// Takes back a tensor that is not needed any more.
    fn give_back(&self, _used: Elements) {}

    /// Bytes of a layer packed from outlines.
    fn packed_nbytes(&self, _role: Role, _outline: Outline) -> Result<usize> {
        Ok(0)
    }
}

/// The elements of a tensor, or what is known without them.
pub(crate) enum Tensor {
    Held(Elements),
    Outline(Stored),
}

/// The type that a weight is packed from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Stored {
    F32,
    Bf16,
}

/// A weight without its elements.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Outline {
    pub stored: Stored,
    pub out_features: usize,
    pub in_features: usize,
}

/// A weight to pack, `(out_features, in_features)`.
#[derive(Clone, Copy)]
pub(crate) enum Weight<'a> {
    Held(WeightRef<'a>),
    Outline(Outline),
}

impl Tensor {
    /// The elements as float32; none of an outline.
    pub(crate) fn into_f32(self) -> Result<Vec<f32>> {
        Ok(match self {
            Self::Held(elements) => elements.into_f32()?,
            Self::Outline(_) => Vec::new(),
        })
    }

    /// As `(out_features, in_features)`, which is how it is stored.
    pub(crate) fn weight(&self, out_features: usize, in_features: usize) -> Weight<'_> {
        match self {
            Self::Held(elements) => Weight::Held(weight_view(elements, out_features, in_features)),
            Self::Outline(stored) => Weight::Outline(Outline {
                stored: *stored,
                out_features,
                in_features,
            }),
        }
    }

    /// As `(out_features, in_features)` of a tensor stored as `(in_features, out_features)`, as the
    /// category-specific layers are.
    pub(crate) fn transposed(&self, out_features: usize, in_features: usize) -> Weight<'_> {
        let Self::Held(elements) = self else {
            return self.weight(out_features, in_features);
        };
        Weight::Held(match weight_view(elements, in_features, out_features) {
            WeightRef::F32(view) => WeightRef::F32(view.transpose()),
            WeightRef::Bf16(view) => WeightRef::Bf16(view.transpose()),
            WeightRef::Int8 { .. } | WeightRef::Int4 { .. } => {
                unreachable!("category-specific weights are checked to be floating point")
            }
        })
    }

    /// The tensor rounded to bf16 where a layer of this role computes in float32 but is to be held in bf16.
    pub(crate) fn held_as(self, engine: Engine, role: Role) -> Result<Self> {
        match role {
            Role::Time => self.rounded(engine),
            _ => Ok(self),
        }
    }

    /// The tensor rounded to bf16 unless it is to be held as it is stored.
    pub(crate) fn rounded(self, engine: Engine) -> Result<Self> {
        let is_rounded = engine.precision.rounds_weights();
        Ok(match self {
            Self::Held(Elements::F32(values)) if is_rounded => {
                let rounded = values.iter().copied().map(bf16::from_f32);
                Self::Held(Elements::Bf16(collected("weights", values.len(), rounded)?))
            }
            Self::Outline(Stored::F32) if is_rounded => Self::Outline(Stored::Bf16),
            as_it_is => as_it_is,
        })
    }
}

impl Weight<'_> {
    /// The inputs `first .. first + count`.
    pub(crate) fn inputs(self, first: usize, count: usize) -> Self {
        match self {
            Self::Held(WeightRef::F32(view)) => {
                Self::Held(WeightRef::F32(view.columns(first..first + count)))
            }
            Self::Held(WeightRef::Bf16(view)) => {
                Self::Held(WeightRef::Bf16(view.columns(first..first + count)))
            }
            Self::Held(WeightRef::Int8 { values, scales }) => Self::Held(WeightRef::Int8 {
                values: values.columns(first..first + count),
                scales,
            }),
            Self::Held(WeightRef::Int4 { .. }) => {
                unreachable!("category-specific weights are checked to be floating point")
            }
            Self::Outline(outline) => Self::Outline(Outline {
                in_features: count,
                ..outline
            }),
        }
    }

    pub(crate) fn in_features(&self) -> usize {
        match self {
            Self::Held(weight) => weight.shape().1,
            Self::Outline(outline) => outline.in_features,
        }
    }
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
        Elements::Int4 { values, scales } => WeightRef::Int4 {
            values: Matrix::new(values, in_features.div_ceil(2)),
            in_features,
            scales,
        },
    };
    debug_assert_eq!(weight.shape(), (out_features, in_features));
    weight
}
