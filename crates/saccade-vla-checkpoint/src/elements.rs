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
    /// int4 from -7 to 7, two in a byte, and what each row is multiplied by.
    Int4 {
        /// The integers in two's complement, the first one in the low half of its byte. Rows are whole bytes.
        values: Vec<u8>,
        /// As those of int8, 7 times them finite.
        scales: Vec<f32>,
    },
}

impl Elements {
    /// The elements as float32: exactly, except that int8 and int4 times their scales are rounded. Of int4 there is an element for each
    /// half of a byte, also for one after an odd number of inputs.
    ///
    /// # Errors
    /// [`Error::Memory`](crate::Error::Memory) if there is no memory for them.
    pub fn into_f32(self) -> Result<Vec<f32>> {
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
            Self::Int4 { values, scales } => {
                reserve("source", &mut wide, values.len().saturating_mul(2))?;
                let row = (values.len() / scales.len().max(1)).max(1);
                for (values, scale) in values.chunks(row).zip(&scales) {
                    let halves = values.iter().flat_map(|&pair| [pair << 4, pair & 0xf0]);
                    wide.extend(halves.map(|half| f32::from(half.cast_signed() >> 4) * scale));
                }
            }
        }
        Ok(wide)
    }
}

/// What is wrong with the int8 or int4 tensor `name` of these bytes, whose rows are multiplied by `scales`, the tensor `scale`.
pub(crate) fn check_quantized(
    name: &str,
    bytes: &[u8],
    is_int4: bool,
    scale: &str,
    scales: &[f32],
) -> std::result::Result<(), String> {
    let most = if is_int4 { 7.0 } else { 127.0 };
    let is_good = |scale: &f32| (most * scale).is_finite() && *scale >= 0.0;
    if let Some(row) = scales.iter().position(|scale| !is_good(scale)) {
        return Err(format!(
            "{scale} is {} at index {row}, expected finite scales that are not negative, and {most} times them finite",
            scales[row]
        ));
    }
    if !is_int4 && bytes.contains(&0x80) {
        return Err(format!("{name} holds -128, expected -127 to 127"));
    }
    // In pieces without a branch for each byte, which compilers make vectors of.
    let holds_least = |piece: &[u8]| {
        piece
            .iter()
            .fold(false, |found, &pair| found | (pair & 15 == 8) | (pair >> 4 == 8))
    };
    if is_int4 && bytes.chunks(1 << 12).any(holds_least) {
        return Err(format!("{name} holds -8 in four bits, expected -7 to 7"));
    }
    let width = bytes.len() / scales.len().max(1);
    let is_zero = |row: usize| {
        let row = &bytes[row * width..(row + 1) * width];
        row.iter().all(|&value| value == 0)
    };
    match (0..scales.len()).find(|&row| scales[row] == 0.0 && !is_zero(row)) {
        Some(row) => Err(format!(
            "{scale} is 0 at index {row}, whose row of {name} is not zero"
        )),
        None => Ok(()),
    }
}
