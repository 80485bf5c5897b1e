//! The thread pool of saccade-vla-kernels, as loom runs it.

#![cfg(test)]
#![allow(dead_code, reason = "models use the core of the pool, and not the functions around it")]
#![allow(clippy::new_without_default, unused_imports)]

#[path = "../../crates/saccade-vla-kernels/src/pool/mod.rs"]
mod pool;
