//! The integration of the velocity, from noise at flow time 0 to actions at flow time 1.
//!
//! Equations 15 and 16 of docs/equations.md.

use saccade_vla_kernels::{Rows, RowsMut};

use crate::alloc::Scratch;
use crate::error::{Error, Result, bail};

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

impl Integrator {
    /// From its name: `euler` or `midpoint`.
    ///
    /// # Errors
    /// [`Error::Input`] for any other name.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "euler" => Ok(Self::Euler),
            "midpoint" => Ok(Self::Midpoint),
            _ => bail!(Input, "integrator"; expected "euler or midpoint"; got "{name}"),
        }
    }

    /// Evaluations of the velocity in one step.
    pub(crate) fn evaluations(self) -> usize {
        match self {
            Self::Euler => 1,
            Self::Midpoint => 2,
        }
    }

    /// Moves `x (actions, width)` along the velocity `v (actions, action_dim)` of evaluation number `index` of a step of
    /// length `dt`. Elements beyond `action_dim` stay as they are. `strength` multiplies the velocity of each action of a
    /// chunk; `start` holds `x` from the start of a step of two evaluations.
    pub(crate) fn advance(
        self,
        index: usize,
        dt: f32,
        v: Rows<'_>,
        strength: &[f32],
        mut x: RowsMut<'_>,
        start: &mut Scratch,
    ) -> Result<()> {
        let dt = match (self, index) {
            (Self::Euler, _) => dt,
            (Self::Midpoint, 0) => {
                start.rows(x.num_rows(), x.num_columns())?.copy_from(x.as_rows());
                dt / 2.0
            }
            (Self::Midpoint, _) => {
                x.copy_from(start.as_rows());
                dt
            }
        };
        for ((x, v), strength) in x.iter_mut().zip(v.iter()).zip(strength.iter().cycle()) {
            for (x, v) in x.iter_mut().zip(v) {
                *x += dt * v * strength;
            }
        }
        Ok(())
    }
}
