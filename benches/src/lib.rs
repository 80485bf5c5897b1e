//! Interleaved measurements: contenders take turns in one run, beside the CPU's own peak, so that what disturbs one disturbs all.

pub mod measure;
pub mod options;
pub mod random;
pub mod report;
