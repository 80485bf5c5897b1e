//! The stable softmax of one query over blocks of keys, with a running maximum and sum.
//!
//! Equation 41 of docs/equations.md.

use super::arithmetic::TileArithmetic;
use super::mask::Mask;
use crate::simd::bits::write;
use crate::simd::{MAX_LANES, Simd};

/// A sliding mask: loaded at `MAX_LANES - n`, it has zeros in the first `n` lanes, which are kept, and `-inf`
/// in the others.
static KEEP_THEN_REMOVE: [f32; 2 * MAX_LANES] = {
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
    /// The larger of `max` and the largest logit of the block; -inf where there is none. Scores become
    /// logits: with the bias, and `-inf` for what this query does not attend to, to whole vectors.
    #[inline(always)]
    pub(super) fn logits<S: Simd>(&self, simd: S, scores: &mut [f32], max: f32) -> f32 {
        let bias = self.mask.bias(self.head, self.query, self.len);
        let bias = bias.map(|bias| &bias[self.first..][..self.count]);
        // Keys of the block that this query attends to; the rest is as if removed.
        let visible = self.mask.visible(self.query, self.len).saturating_sub(self.first);
        let visible = visible.min(self.count);
        let (whole, rest) =
            scores[..self.count.next_multiple_of(S::LANES)].split_at_mut(visible - visible % S::LANES);
        let removed = simd.splat(f32::NEG_INFINITY);
        let mut max = simd.splat(max);
        match bias {
            Some(bias) => {
                for (scores, bias) in whole.chunks_exact_mut(S::LANES).zip(bias.chunks_exact(S::LANES)) {
                    let bias = simd.load(bias);
                    let logits = simd.replace_where(simd.add(simd.load(scores), bias), bias, removed);
                    simd.store(logits, scores);
                    max = simd.max(logits, max);
                }
            }
            None => {
                // Four at a time, so that they need not wait for each other.
                let mut others = [removed; 4];
                let mut groups = whole.chunks_exact(4 * S::LANES);
                for group in &mut groups {
                    for (other, vector) in others.iter_mut().zip(0..) {
                        *other = simd.max(simd.load(&group[vector * S::LANES..]), *other);
                    }
                }
                for scores in groups.remainder().chunks_exact(S::LANES) {
                    max = simd.max(simd.load(scores), max);
                }
                let [a, b, c, d] = others;
                max = simd.max(simd.max(max, simd.max(a, b)), simd.max(c, d));
            }
        }
        for (vector, scores) in rest.chunks_exact_mut(S::LANES).enumerate() {
            let from = whole.len() + vector * S::LANES;
            let kept = visible.saturating_sub(from).min(S::LANES);
            let mut logits = simd.load(scores);
            if let Some(bias) = bias {
                let bias = simd.load_partial(&bias[from..]);
                logits = simd.replace_where(simd.add(logits, bias), bias, removed);
            }
            let beyond = simd.load(&KEEP_THEN_REMOVE[MAX_LANES - kept..]);
            logits = simd.replace_where(logits, beyond, removed);
            simd.store(logits, scores);
            max = simd.max(logits, max);
        }
        simd.reduce_max(max)
    }

    /// Turns the logits of a block, whole pairs of vectors of which those beyond the last key are any
    /// numbers, into probabilities relative to the maximum, as factors in their place, with zeros to whole
    /// pairs of vectors. `max` is what [`Self::logits`] gave. Returns the factor by which sums so far change.
    #[inline(always)]
    pub(super) fn softmax<S: Simd, A: TileArithmetic<S>>(
        &self,
        simd: S,
        logits: &mut [f32],
        max: f32,
        running: &mut Running,
    ) -> f32 {
        // All logits so far are -inf: anything finite makes them zeros.
        let shift = if max == f32::NEG_INFINITY { 0.0 } else { max };
        // Before the first block there is nothing to change.
        let rescale = if self.first == 0 {
            0.0
        } else {
            first_lane(simd, A::exp(simd, simd.splat(running.max - shift)))
        };
        let shift = simd.splat(shift);
        let mut sum = simd.splat(0.0);
        for i in (0..self.count).step_by(2 * S::LANES) {
            let pair = &logits[i..][..2 * S::LANES];
            let first = A::exp(simd, simd.sub(simd.load(pair), shift));
            let second = if i + S::LANES < self.count {
                A::exp(simd, simd.sub(simd.load(&pair[S::LANES..]), shift))
            } else {
                simd.splat(0.0)
            };
            let factors = A::factors(simd, first, second);
            write(factors, &mut logits[i * A::FACTORS / A::STEP..]);
            // Of what the values are multiplied with, so that the weights of a query add up to 1.
            sum = A::add(simd, sum, first, second, factors);
        }
        *running = Running {
            max,
            sum: running.sum * rescale + simd.reduce_add(sum),
        };
        rescale
    }

    /// Keeps the probabilities of a block as they are used, and rescales those of the blocks before.
    /// `factors` are what [`Self::softmax`] left; `weights` has an element for every key.
    #[inline(always)]
    pub(super) fn keep_weights<S: Simd, A: TileArithmetic<S>>(
        &self,
        factors: &[f32],
        rescale: f32,
        weights: &mut [f32],
    ) {
        let (before, weights) = weights.split_at_mut(self.first);
        before.iter_mut().for_each(|weight| *weight *= rescale);
        for (index, weight) in weights[..self.count].iter_mut().enumerate() {
            *weight = A::element(factors, index);
        }
    }
}

#[inline(always)]
fn first_lane<S: Simd>(simd: S, vector: S::F32) -> f32 {
    let mut lane = [0.0];
    simd.store_partial(vector, &mut lane);
    lane[0]
}
