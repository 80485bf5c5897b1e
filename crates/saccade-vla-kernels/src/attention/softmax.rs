//! The stable softmax of one query over blocks of keys, with a running maximum and sum.

use super::arithmetic::TileArithmetic;
use super::mask::Mask;
use crate::simd::{MAX_LANES, Simd, Vector, load};

/// Zeros, then -inf: loaded `n` before the middle, `n` lanes stay as they are.
static SEEN_THEN_REMOVED: [f32; 2 * MAX_LANES] = {
    let mut lanes = [0.0; 2 * MAX_LANES];
    let mut lane = MAX_LANES;
    while lane < lanes.len() {
        lanes[lane] = f32::NEG_INFINITY;
        lane += 1;
    }
    lanes
};

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
    /// The larger of `max` and the largest logit of the block; -inf where there is none. Scores become logits: with the bias, and `-inf` for
    /// what this query does not see, to whole vectors.
    ///
    /// # Safety
    /// `scores` points to the block's scores in whole vectors; called within [`Simd::run`] with the vectors of `V`.
    #[inline(always)]
    pub(super) unsafe fn logits<V: Vector>(&self, scores: *mut f32, max: f32) -> f32 {
        let bias = self.mask.bias(self.head, self.query, self.len);
        let bias = bias.map(|bias| bias[self.first..].as_ptr());
        // Those of the block that this query sees; the rest is as if removed.
        let seen = self.mask.visible(self.query, self.len).saturating_sub(self.first);
        let seen = seen.min(self.count);
        let whole = seen - seen % V::LANES;
        // SAFETY: the caller's promise; the bias has `count` elements from here on.
        unsafe {
            let removed = V::splat(f32::NEG_INFINITY);
            let mut max = V::splat(max);
            match bias {
                Some(bias) => {
                    for i in (0..whole).step_by(V::LANES) {
                        let bias = V::load(bias.add(i));
                        let logits = V::load(scores.add(i)).add(bias).replace_where(bias, removed);
                        logits.store(scores.add(i));
                        max = logits.max(max);
                    }
                }
                None => {
                    // Four at a time, so that they need not wait for each other.
                    let mut others = [removed; 4];
                    let fours = whole - whole % (4 * V::LANES);
                    for i in (0..fours).step_by(4 * V::LANES) {
                        for (other, vector) in others.iter_mut().zip(0..) {
                            *other = V::load(scores.add(i + vector * V::LANES)).max(*other);
                        }
                    }
                    for i in (fours..whole).step_by(V::LANES) {
                        max = V::load(scores.add(i)).max(max);
                    }
                    let [a, b, c, d] = others;
                    max = max.max(a.max(b)).max(c.max(d));
                }
            }
            for i in (whole..self.count).step_by(V::LANES) {
                let seen = seen.saturating_sub(i).min(V::LANES);
                let mut logits = V::load(scores.add(i));
                if let Some(bias) = bias {
                    let bias = load::<V>(bias.add(i), V::LANES.min(self.count - i));
                    logits = logits.add(bias).replace_where(bias, removed);
                }
                let beyond = V::load(SEEN_THEN_REMOVED.as_ptr().add(MAX_LANES - seen));
                logits = logits.replace_where(beyond, removed);
                logits.store(scores.add(i));
                max = logits.max(max);
            }
            max.reduce_max()
        }
    }

    /// Turns the logits of a block into probabilities relative to the maximum, kept as factors in their place, with zeros to whole pairs of
    /// vectors. `max` is what [`Self::logits`] gave. Returns the factor by which sums so far change.
    ///
    /// # Safety
    /// `logits` points to the block's logits in whole pairs of vectors, the last of which may be missing; called within [`Simd::run`] of `S`.
    #[inline(always)]
    pub(super) unsafe fn softmax<S: Simd<Vector = V>, V: Vector, A: TileArithmetic<S>>(
        &self,
        logits: *mut f32,
        max: f32,
        running: &mut Running,
    ) -> f32 {
        // SAFETY: the caller's promise.
        unsafe {
            // All logits so far are -inf: anything finite makes them zeros.
            let shift = if max == f32::NEG_INFINITY { 0.0 } else { max };
            // Before the first block there is nothing to change.
            let rescale = if self.first == 0 {
                0.0
            } else {
                first_lane(A::exp(V::splat(running.max - shift)))
            };
            let shift = V::splat(shift);
            let mut sum = V::splat(0.0);
            let vectors = self.count.div_ceil(V::LANES);
            for vector in (0..vectors).step_by(2) {
                let i = vector * V::LANES;
                let first = A::exp(V::load(logits.add(i)).sub(shift));
                let second = if vector + 1 < vectors {
                    A::exp(V::load(logits.add(i + V::LANES)).sub(shift))
                } else {
                    V::splat(0.0)
                };
                let kept = logits.add(i * A::FACTORS / A::STEP);
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
