//! The micro-kernel of NEON, whose instructions take an element of a row by lane, or multiply two rows by two
//! columns.

mod micro_kernel;
mod steps;

pub(crate) use micro_kernel::Lanes;
pub(crate) use steps::{DotprodInt8, I8mmInt8, MatrixBf16, WideningInt8};
