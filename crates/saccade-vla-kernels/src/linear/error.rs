//! Why a layer was not packed.

use crate::aligned::AllocError;
use crate::pool::Interrupted;

/// In int8 and int4, so that no sum overflows: 255 * 127 times this is less than 2^31.
pub(super) const MAX_QUANTIZED_INPUTS: usize = 1 << 16;

/// Why a layer was not packed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KernelError {
    /// There is nothing to pack.
    #[error("a packed linear layer needs at least one part")]
    NoParts,
    /// Parts differ in their inputs.
    #[error("parts of one linear layer must have equal in_features: {expected} and {given}")]
    InFeatures {
        /// Of the first part.
        expected: usize,
        /// Of another.
        given: usize,
    },
    /// A bias does not have one element for each output.
    #[error("a bias of {given} elements does not fit {expected} out_features")]
    Bias {
        /// Outputs of the part.
        expected: usize,
        /// Elements of its bias.
        given: usize,
    },
    /// int8 or int4 weights do not have one scale for each output.
    #[error("quantised weights of {expected} out_features need as many scales, got {given}")]
    Scales {
        /// Outputs of the part.
        expected: usize,
        /// Its scales.
        given: usize,
    },
    /// A row of int4 weights has another number of bytes than two weights each fill.
    #[error("int4 weights of {in_features} in_features have rows of {expected} bytes, got {given}")]
    Int4Bytes {
        /// Inputs of the part.
        in_features: usize,
        /// Bytes that they fill.
        expected: usize,
        /// Bytes of a row.
        given: usize,
    },
    /// The half of a byte after an odd number of int4 weights is not zero.
    #[error(
        "row {row} of int4 weights has {in_features} in_features, expected zero in the high half of its last byte"
    )]
    Int4Padding {
        /// The first such row.
        row: usize,
        /// Inputs of the part.
        in_features: usize,
    },
    /// A sum of that many products could overflow.
    #[error("int8 and int4 arithmetic take at most {MAX_QUANTIZED_INPUTS} in_features, got {given}")]
    TooManyInputs {
        /// Of the parts.
        given: usize,
    },
    /// There is not enough memory.
    #[error(transparent)]
    Alloc(#[from] AllocError),
    /// Packing was interrupted; see [`interruptible`](crate::interruptible).
    #[error(transparent)]
    Interrupted(#[from] Interrupted),
}
