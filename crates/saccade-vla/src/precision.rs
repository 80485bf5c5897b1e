//! Precisions, and the arithmetic of each kind of layer.

use std::fmt;
use std::str::FromStr;

use saccade_vla_kernels::{Arithmetic, Element};

use crate::error::{Error, Result, problem};

/// A layer's share of the cost, which decides how precisely it is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    /// Attention and feed-forward of the blocks: nearly all of the work.
    Block,
    /// The same of a backbone, whose activations have outliers.
    BackboneBlock,
    /// A function of the time alone, so computed once for each bucket.
    Time,
    /// Encoders, decoder and output: under one percent.
    Other,
}

impl Role {
    /// True for large weights: they may be stored as int8 or int4, and the memory that they are read into is used
    /// again.
    pub(crate) fn is_given_back(self) -> bool {
        matches!(self, Self::Block | Self::BackboneBlock)
    }

    /// True if in int8 and int4 the elements of a row that are far larger than the others are multiplied in float32.
    /// Vision towers and language models have such channels: in the residual stream, and most of all before
    /// the second layer of a feed-forward. The action head has none, and keeps its bits.
    pub(crate) fn keeps_outliers(self) -> bool {
        self == Self::BackboneBlock
    }
}

/// The types of weights and of the inputs of linear layers. The residual stream, norms, softmax and all sums
/// of floating-point products are float32 in each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Precision {
    /// Weights as they are stored, bf16 or float32, and float32 arithmetic.
    #[default]
    Float32,
    /// Weights, inputs of linear layers, keys and values in bf16.
    Bfloat16,
    /// The linear layers of the blocks in int8: weights with one scale for each output, inputs with one for
    /// each row. The rest as in [`Precision::Bfloat16`].
    Int8,
    /// The same with weights of four bits.
    Int4,
}

const ALL: [Precision; 4] = [
    Precision::Float32,
    Precision::Bfloat16,
    Precision::Int8,
    Precision::Int4,
];

impl Precision {
    /// The arithmetic of a linear layer.
    pub(crate) fn arithmetic(self, role: Role) -> Arithmetic {
        match (self, role) {
            (Self::Float32, _) | (_, Role::Time) => Arithmetic::Float32,
            (Self::Int8, Role::Block | Role::BackboneBlock) => Arithmetic::Int8,
            (Self::Int4, Role::Block | Role::BackboneBlock) => Arithmetic::Int4,
            (Self::Bfloat16, _) | (_, Role::Other) => Arithmetic::Bfloat16,
        }
    }

    /// True if weights that are stored as float32 are rounded to bf16.
    pub(crate) fn rounds_weights(self) -> bool {
        self != Self::Float32
    }

    /// True if tables whose rows are looked up are held as int8, with a scale for each row. That of N1.5 then
    /// takes 0.31 GB, not 0.62, and its rows have a relative error of 0.8 %, where the features of int8 have
    /// one of 3 %.
    pub(crate) fn quantizes_tables(self) -> bool {
        self.quantizes()
    }

    /// True if weights of the blocks are whole numbers times a scale of each output.
    pub(crate) fn quantizes(self) -> bool {
        matches!(self, Self::Int8 | Self::Int4)
    }

    /// The type of KV caches.
    pub(crate) fn keys_values(self) -> Element {
        match self {
            Self::Float32 => Element::F32,
            Self::Bfloat16 | Self::Int8 | Self::Int4 => Element::Bf16,
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Float32 => "float32",
            Self::Bfloat16 => "bfloat16",
            Self::Int8 => "int8",
            Self::Int4 => "int4",
        })
    }
}

impl FromStr for Precision {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let known = ALL.into_iter().find(|precision| precision.to_string() == name);
        known.ok_or_else(|| {
            let names = ALL.map(|precision| format!("'{precision}'")).join(", ");
            Error::Input(problem!("precision"; expected "one of {names}"; got "'{name}'"))
        })
    }
}
