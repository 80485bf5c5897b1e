//! The stable softmax of one query over blocks of keys, with a running maximum and sum.

use super::arithmetic::TileArithmetic;
use super::mask::Mask;
use crate::simd::{Simd, Vector, load};

/// The running softmax of one query.
#[derive(Clone, Copy)]
pub(super) struct Running {
    /// Largest logit so far.
    pub max: f32,
    /// Sum of `exp(logit - max)` so far.
    pub sum: f32,
}

/// One query and a block of keys.
pub(super) struct Row<'a> {
    pub mask: &'a Mask<'a>,
    pub head: usize,
    pub query: usize,
    /// All keys.
    pub len: usize,
    /// Keys of the block: `count` from number `first` on.
    pub first: usize,
    pub count: usize,
}

impl Row<'_> {
    /// Turns the scores of a block into probabilities relative to the running maximum, kept as factors in their place, with zeros to whole
    /// pairs of vectors. Returns the factor by which sums so far change.
    ///
    /// # Safety
    /// `scores` points to the block's scores in whole pairs of vectors, the last of which may be missing; called within [`Simd::run`] of `S`.
    #[inline(always)]
    pub(super) unsafe fn softmax<S: Simd<Vector = V>, V: Vector, A: TileArithmetic<S>>(
        &self,
        scores: *mut f32,
        running: &mut Running,
    ) -> f32 {
        let bias = self.mask.bias(self.head, self.query, self.len);
        let bias = bias.map(|bias| bias[self.first..].as_ptr());
        // Those of the block that this query sees; the rest is as if removed.
        let seen = self.mask.visible(self.query, self.len).saturating_sub(self.first);
        let seen = seen.min(self.count);
        // SAFETY: the caller's promise; the bias has `count` elements from here on.
        unsafe {
            let removed = V::splat(f32::NEG_INFINITY);
            let mut max = V::splat(running.max);
            for i in (0..self.count).step_by(V::LANES) {
                let lanes = V::LANES.min(self.count - i);
                let mut logits = V::load(scores.add(i));
                if let Some(bias) = bias {
                    let bias = load::<V>(bias.add(i), lanes);
                    logits = logits.add(bias).replace_where(bias, removed);
                    logits.store(scores.add(i));
                }
                if i + V::LANES > seen {
                    // Lanes beyond the last key: as if removed.
                    let from = i.max(seen);
                    removed.store_partial(scores.add(from), i + V::LANES - from);
                    logits = V::load(scores.add(i));
                }
                max = logits.max(max);
            }
            let max = max.reduce_max();
            // All logits so far are -inf: anything finite makes them zeros.
            let shift = if max == f32::NEG_INFINITY { 0.0 } else { max };
            let rescale = first_lane(A::exp(V::splat(running.max - shift)));
            let shift = V::splat(shift);
            let mut sum = V::splat(0.0);
            for i in (0..self.count).step_by(2 * V::LANES) {
                let first = A::exp(V::load(scores.add(i)).sub(shift));
                let second = if i + V::LANES < self.count {
                    A::exp(V::load(scores.add(i + V::LANES)).sub(shift))
                } else {
                    V::splat(0.0)
                };
                let kept = scores.add(i * A::FACTORS / A::STEP);
                A::store_factors(first, second, kept);
                // Of what the values are multiplied with, so that the weights of a query add up to 1.
                sum = A::add_factors(sum, first, second, kept);
            }
            *running = Running {
                max,
                sum: running.sum * rescale + sum.reduce_add(),
            };
            rescale
        }
    }

    /// Keeps the probabilities of a block as they are used, and rescales those of the blocks before.
    ///
    /// # Safety
    /// `factors` are what [`Self::softmax`] left; `weights` points to an element for every key; called within [`Simd::run`] of `S`.
    #[inline(always)]
    pub(super) unsafe fn keep_weights<S: Simd, A: TileArithmetic<S>>(
        &self,
        factors: *const f32,
        rescale: f32,
        weights: *mut f32,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            for key in 0..self.first {
                *weights.add(key) *= rescale;
            }
            for index in 0..self.count {
                *weights.add(self.first + index) = A::element(factors, index);
            }
        }
    }
}

/// # Safety
/// Called within [`Simd::run`] with the vectors of `V`.
#[inline(always)]
unsafe fn first_lane<V: Vector>(vector: V) -> f32 {
    let mut lane = 0.0;
    // SAFETY: one lane, one element.
    unsafe { vector.store_partial(&raw mut lane, 1) };
    lane
}
