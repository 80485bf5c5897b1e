//! The floating-point types that weights are stored in.

use half::{bf16, f16};
use saccade_vla_checkpoint::Dtype;

use crate::error::{Error, Result, bail};

/// A type that weights are stored in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Float {
    /// float32.
    F32,
    /// bfloat16.
    Bf16,
    /// float16.
    F16,
}

impl std::str::FromStr for Float {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "float32" => Ok(Self::F32),
            "bfloat16" => Ok(Self::Bf16),
            "float16" => Ok(Self::F16),
            _ => bail!(Input, "dtype"; expected "float32, bfloat16 or float16"; got "{name}"),
        }
    }
}

impl Float {
    /// The type with this name in safetensors, if it is one of these.
    pub(crate) fn of(dtype: Dtype) -> Option<Self> {
        match dtype {
            Dtype::F32 => Some(Self::F32),
            Dtype::BF16 => Some(Self::Bf16),
            Dtype::F16 => Some(Self::F16),
            _ => None,
        }
    }

    /// Its name in safetensors.
    pub(crate) fn dtype(self) -> Dtype {
        match self {
            Self::F32 => Dtype::F32,
            Self::Bf16 => Dtype::BF16,
            Self::F16 => Dtype::F16,
        }
    }

    /// Bytes of a number.
    pub(crate) fn size(self) -> u64 {
        match self {
            Self::F32 => 4,
            Self::Bf16 | Self::F16 => 2,
        }
    }

    /// The numbers with these bytes.
    pub(crate) fn read(self, bytes: &[u8], values: &mut Vec<f32>) {
        let pairs = || {
            bytes
                .as_chunks::<2>()
                .0
                .iter()
                .map(|&pair| u16::from_le_bytes(pair))
        };
        values.clear();
        match self {
            Self::F32 => {
                let fours = bytes.as_chunks::<4>().0.iter();
                values.extend(fours.map(|&four| f32::from_le_bytes(four)));
            }
            Self::Bf16 => values.extend(pairs().map(|bits| bf16::from_bits(bits).to_f32())),
            Self::F16 => values.extend(pairs().map(|bits| f16::from_bits(bits).to_f32())),
        }
    }

    /// The bytes of these numbers, each the nearest of this type.
    pub(crate) fn write(self, values: &[f32], bytes: &mut Vec<u8>) {
        bytes.clear();
        match self {
            Self::F32 => bytes.extend(values.iter().flat_map(|value| value.to_le_bytes())),
            Self::Bf16 => bytes.extend(
                values
                    .iter()
                    .flat_map(|&value| bf16::from_f32(value).to_le_bytes()),
            ),
            Self::F16 => bytes.extend(
                values
                    .iter()
                    .flat_map(|&value| f16::from_f32(value).to_le_bytes()),
            ),
        }
    }

    /// A number as this type holds it.
    pub(crate) fn round(self, value: f32) -> f32 {
        match self {
            Self::F32 => value,
            Self::Bf16 => bf16::from_f32(value).to_f32(),
            Self::F16 => f16::from_f32(value).to_f32(),
        }
    }
}
