//! Weights to four bits, rounded for the inputs that a layer is given (GPTQ).

mod factor;
mod gptq;
mod layer;

pub use gptq::{Rounded, RoundingErrors, gptq};
pub(crate) use layer::RoundedWeights;
pub use layer::{RoundedLayer, round_layer};
