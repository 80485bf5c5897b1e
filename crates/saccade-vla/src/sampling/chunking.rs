//! Real-time chunking (equation 17 of docs/equations.md): a chunk begins with the end of the previous one.

use saccade_vla_kernels::{Rows, RowsMut};

use crate::array::Array;
use crate::config::HeadConfig;
use crate::error::{Error, Result, bail, ensure, show_shape};

/// The chunk before, and how it is taken over. Of its first `horizon` actions the last `overlap` become the first ones of the new chunk, without
/// noise: the first `frozen` of these stay as they are, the rest follow the velocity the more, the later they come.
#[derive(Clone, Copy, Debug)]
pub struct Chunking<'a> {
    /// `(batch, rows, encoder_action_dim)` with at least `horizon` rows, as they left the head; or `action_dim` wide.
    pub previous_chunk: Array<'a>,
    /// Actions that are taken over, up to `horizon`.
    pub overlap: usize,
    /// How many of these do not change: the robot executes them before the new chunk is available.
    pub frozen: usize,
    /// How soon the rest become free: above 0, and 6 in released code.
    pub ramp_rate: f64,
    /// Actions of the chunk before that count; default `action_horizon`.
    pub horizon: Option<usize>,
}

/// The ramp of a smaller rate is the same straight line in float32, and would underflow.
const STRAIGHT: f64 = 1e-9;

/// [`Chunking`], checked.
pub(crate) struct Seam<'a> {
    /// The actions that are taken over, `(batch, overlap, width)`, as parts of a larger array.
    previous: Array<'a>,
    first: usize,
    overlap: usize,
    frozen: usize,
    ramp_rate: f64,
}

impl<'a> Chunking<'a> {
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for numbers or a chunk that do not fit the head.
    pub(crate) fn check(&self, config: &HeadConfig, batch: usize) -> Result<Seam<'a>> {
        let horizon = self.horizon.unwrap_or(config.action_horizon);
        for (name, given, most, of) in [
            ("horizon", horizon, config.action_horizon, "action_horizon"),
            ("overlap", self.overlap, horizon, "horizon"),
            ("frozen", self.frozen, self.overlap, "overlap"),
        ] {
            ensure!(
                given <= most, Input, format_args!("chunking: {name}");
                expected "at most {most} ({of})"; got "{given}"
            );
        }
        ensure!(
            self.ramp_rate.is_finite() && self.ramp_rate > 0.0, Input, "chunking: ramp_rate";
            expected "a finite number above 0"; got "{}", self.ramp_rate
        );
        let widths = [config.encoder_action_dim, config.action_dim];
        match *self.previous_chunk.shape() {
            [given, rows, width]
                if given == batch
                    && (horizon..=config.action_horizon).contains(&rows)
                    && widths.contains(&width) => {}
            _ => {
                let widths = match widths {
                    [encoder, action] if encoder == action => format!("{encoder}"),
                    [encoder, action] => format!("{encoder} or {action}"),
                };
                bail!(
                    Shape, "previous_chunk";
                    expected "(batch, rows, width) with batch {batch}, {horizon} to {} rows and width {widths}",
                    config.action_horizon;
                    got "{}", show_shape(self.previous_chunk.shape())
                );
            }
        }
        Ok(Seam {
            previous: self.previous_chunk.check_finite("previous_chunk")?,
            first: horizon - self.overlap,
            overlap: self.overlap,
            frozen: self.frozen,
            ramp_rate: self.ramp_rate,
        })
    }
}

impl Seam<'_> {
    /// Writes the actions that are taken over into chunks of `horizon` rows of `x`, `samples` for each observation. A
    /// previous chunk that is narrower leaves zeros.
    pub(crate) fn begin(&self, samples: usize, horizon: usize, mut x: RowsMut<'_>) {
        let &[_, rows, width] = self.previous.shape() else {
            return;
        };
        let previous = Rows::new(self.previous.data(), width);
        let both = width.min(x.num_columns());
        for chunk in 0..x.num_rows() / horizon {
            for index in 0..self.overlap {
                let previous = previous.row(chunk / samples * rows + self.first + index);
                let row = x.row_mut(chunk * horizon + index);
                row[..both].copy_from_slice(&previous[..both]);
                row[both..].fill(0.0);
            }
        }
    }

    /// What the velocity of action `index` is multiplied by: 0 while it is frozen, 1 once it is free, and between them
    /// `(1 - exp(-a r)) / (1 - exp(-a))`, where `r` goes from 0 to 1 in equal steps and `a` is the ramp rate.
    pub(crate) fn strength(&self, index: usize) -> f32 {
        if index < self.frozen {
            return 0.0;
        }
        if index >= self.overlap {
            return 1.0;
        }
        let steps = self.overlap - self.frozen + 1;
        let along = (index - self.frozen + 1) as f64 / steps as f64;
        let rate = self.ramp_rate.max(STRAIGHT);
        ((-rate * along).exp_m1() / (-rate).exp_m1()) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strengths(frozen: usize, overlap: usize, ramp_rate: f64) -> Vec<f32> {
        let previous = Array::new(&[], &[0, 0, 0]).unwrap();
        let seam = Seam {
            previous,
            first: 0,
            overlap,
            frozen,
            ramp_rate,
        };
        (0..6).map(|index| seam.strength(index)).collect()
    }

    #[test]
    fn velocities_are_frozen_then_ramped_then_free() {
        let a = 6.0_f64;
        let expected = |r: f64| ((1.0 - (-a * r).exp()) / (1.0 - (-a).exp())) as f32;
        let ramped = [0.0, 0.0, expected(1.0 / 3.0), expected(2.0 / 3.0), 1.0, 1.0];
        for (given, expected) in strengths(2, 4, a).into_iter().zip(ramped) {
            assert!((given - expected).abs() <= f32::EPSILON, "{given}, {expected}");
        }
        assert_eq!(strengths(0, 0, a), [1.0; 6]);
        assert_eq!(strengths(3, 3, a), [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
    }

    #[test]
    fn the_ramp_is_straight_in_the_limit_of_a_small_rate_and_steep_in_that_of_a_large_one() {
        for rate in [5e-324, 1e-300, 1e-9] {
            let straight = [0.2, 0.4, 0.6, 0.8, 1.0, 1.0];
            for (given, expected) in strengths(0, 4, rate).into_iter().zip(straight) {
                assert!((given - expected).abs() < 1e-6, "{rate}: {given}, {expected}");
            }
        }
        assert_eq!(strengths(1, 4, f64::MAX), [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]);
    }
}
