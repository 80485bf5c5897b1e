//! The timestep of a flow time.
//!
//! Equation 14 of docs/equations.md.

/// The timestep of evaluation number `index` of `count` at equal flow times: `floor(index / count *
/// num_timesteps)` in float64, as the released sampler does.
pub(crate) fn timestep(index: usize, count: usize, num_timesteps: usize) -> usize {
    (index as f64 / count as f64 * num_timesteps as f64) as usize
}
