//! How the velocity is followed from noise to actions.

use saccade_vla_kernels::Activations;

use crate::alloc::sized;
use crate::error::{Error, Result};

/// How the velocity is followed from noise to actions in one step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Integrator {
    /// `x + dt v(x, t)`, as the released sampler does.
    #[default]
    Euler,
    /// `x + dt v(x + dt / 2 v(x, t), t + dt / 2)`: two evaluations of the velocity.
    Midpoint,
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
            _ => Err(Error::Input(format!(
                "integrator: expected euler or midpoint, got {name}"
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

    /// Prepares `x` for adding the velocity of evaluation number `index` of a step of length `dt`, and gives what the velocity is multiplied
    /// by. `start` holds `x` as it was at the start of a step of two evaluations.
    pub(crate) fn advance(
        self,
        index: usize,
        dt: f32,
        x: &mut [f32],
        start: &mut Activations,
    ) -> Result<f32> {
        Ok(match (self, index) {
            (Self::Euler, _) => dt,
            (Self::Midpoint, 0) => {
                sized(start, x.len())?.copy_from_slice(x);
                dt / 2.0
            }
            (Self::Midpoint, _) => {
                x.copy_from_slice(start);
                dt
            }
        })
    }
}

/// The bucket of evaluation number `index` of `count` at equal times: float64, truncated, as the released sampler does.
pub(crate) fn bucket(index: usize, count: usize, num_buckets: usize) -> usize {
    (index as f64 / count as f64 * num_buckets as f64) as usize
}
