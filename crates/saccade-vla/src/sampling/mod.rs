//! From noise to actions: integration of the velocity, timesteps and their embeddings, real-time chunking.

pub(crate) mod chunking;
pub(crate) mod integrator;
pub(crate) mod timestep;
pub(crate) mod timestep_embedding;
