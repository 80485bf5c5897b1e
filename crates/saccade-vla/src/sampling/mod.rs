//! From noise to actions: integrators, real-time chunking, the tables of time.

pub(crate) mod chunking;
pub(crate) mod integrator;
pub(crate) mod tables;
