//! Interleaved measurements: contenders and the CPU's peak take turns in one run, so that a disturbance affects all of them.

pub mod measure;
pub mod options;
pub mod random;
pub mod report;
