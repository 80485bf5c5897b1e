//! The elements of a tensor, by the type they are stored in.

use half::bf16;

use crate::error::{Result, reserve};

/// The elements of one tensor, in the type they are stored in; float16 is widened to float32, which is exact.
#[derive(Clone, Debug, PartialEq)]
pub enum Elements {
    /// float32.
    F32(Vec<f32>),
    /// bfloat16, kept as it is.
    Bf16(Vec<bf16>),
    /// int8 from -127 to 127, and what each row, an index of the first axis, is multiplied by.
    Int8 {
        /// The integers.
        values: Vec<i8>,
        /// One for each row: not negative, zero only for a row of zeros, 127 times it finite.
        scales: Vec<f32>,
    },
}

impl Elements {
    /// The elements as float32: exactly, except that int8 times its scale is rounded.
    ///
    /// # Panics
    /// If there is no memory for them; [`Elements::try_into_f32`] says so instead.
    #[must_use]
    pub fn into_f32(self) -> Vec<f32> {
        self.try_into_f32().expect("there is memory for a tensor")
    }

    /// The elements as float32, as [`Elements::into_f32`] gives them.
    ///
    /// # Errors
    /// [`Error::Memory`](crate::Error::Memory) if there is no memory for them.
    pub fn try_into_f32(self) -> Result<Vec<f32>> {
        let mut wide = Vec::new();
        match self {
            Self::F32(values) => return Ok(values),
            Self::Bf16(values) => {
                reserve("source", &mut wide, values.len())?;
                wide.extend(values.into_iter().map(bf16::to_f32));
            }
            Self::Int8 { values, scales } => {
                reserve("source", &mut wide, values.len())?;
                let row = (values.len() / scales.len().max(1)).max(1);
                for (values, scale) in values.chunks(row).zip(&scales) {
                    wide.extend(values.iter().map(|&value| f32::from(value) * scale));
                }
            }
        }
        Ok(wide)
    }
}
