//! The integration of the velocity, from noise at flow time 0 to actions at flow time 1.

use saccade_vla_kernels::Activations;

use crate::alloc::sized;
use crate::error::{Error, Result, problem};

/// The scheme of one integration step of length `dt`, from `x` at flow time `t`, along the velocity `v`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Integrator {
    /// `x + dt v(x, t)`, as the released sampler does.
    #[default]
    Euler,
    /// `x + dt v(x + dt / 2 v(x, t), t + dt / 2)`: two evaluations of the velocity.
    Midpoint,
}

/// A velocity as the head computes it.
pub(crate) struct Velocity<'a> {
    /// `(chunks, action_horizon, action_dim)`.
    pub values: &'a [f32],
    pub action_dim: usize,
    /// Factor of the velocity of each action of a chunk, `(action_horizon,)`.
    pub strength: &'a [f32],
}

impl Integrator {
    /// From its name: `euler` or `midpoint`.
    ///
    /// # Errors
    /// [`Error::Input`] for any other name.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "euler" => Ok(Self::Euler),
            "midpoint" => Ok(Self::Midpoint),
            _ => Err(Error::Input(problem!(
                "integrator"; expected "euler or midpoint"; got "{name}"
            ))),
        }
    }

    /// Evaluations of the velocity in one step.
    pub(crate) fn evaluations(self) -> usize {
        match self {
            Self::Euler => 1,
            Self::Midpoint => 2,
        }
    }

    /// Moves `x (chunks, action_horizon, width)` along the velocity of evaluation number `index` of a step of length
    /// `dt`. Elements beyond `action_dim` stay as they are. `start` holds `x` from the start of a step of two
    /// evaluations.
    pub(crate) fn advance(
        self,
        index: usize,
        dt: f32,
        velocity: &Velocity<'_>,
        x: &mut [f32],
        width: usize,
        start: &mut Activations,
    ) -> Result<()> {
        let dt = match (self, index) {
            (Self::Euler, _) => dt,
            (Self::Midpoint, 0) => {
                sized(start, x.len())?.copy_from_slice(x);
                dt / 2.0
            }
            (Self::Midpoint, _) => {
                x.copy_from_slice(start);
                dt
            }
        };
        let rows = x
            .chunks_exact_mut(width)
            .zip(velocity.values.chunks_exact(velocity.action_dim));
        for ((x, v), strength) in rows.zip(velocity.strength.iter().cycle()) {
            for (x, v) in x.iter_mut().zip(v) {
                *x += dt * v * strength;
            }
        }
        Ok(())
    }
}
