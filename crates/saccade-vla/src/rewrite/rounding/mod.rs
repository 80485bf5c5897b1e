//! Weights to four bits, rounded for the inputs that a layer is given (GPTQ).

mod factor;
mod gptq;

pub use gptq::{Rounded, gptq};
