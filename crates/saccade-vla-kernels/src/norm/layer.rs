//! LayerNorm over rows, plain or with a scale and a shift applied in the same pass.
//!
//! Equation 32 of docs/equations.md.

use crate::isa::Isa;
use crate::parts::parallel_rows;
use crate::rows::{Rows, RowsMut};
use crate::simd::slices::update;
use crate::simd::{Kernel, Simd};

/// `out = norm(x) * scale + shift`, row by row, with `norm(x) = (x - mean) / sqrt(variance + eps)` over the
/// columns.
///
/// `x` and `out` are `(rows, width)`, row-major with any row stride; `scale` and `shift` have `width`
/// elements and hold for all rows: the learned affine, or `1 + scale` and `shift` of an adaptive norm. The
/// variance is the mean of squared distances from the mean, in a second pass over the row, which also finds
/// what rounding has left of the mean: rows far from zero are as exact as others. A row of zero variance
/// gives `shift`; one with NaN or infinity gives NaN.
///
/// # Panics
/// If a shape does not fit, or this CPU lacks `isa`.
///
/// ```
/// use saccade_vla_kernels::{Isa, Rows, RowsMut, layer_norm};
/// let mut out = [0.0; 2];
/// let x = Rows::new(&[1.0, 3.0], 2);
/// layer_norm(Isa::best(), 1, x, 0.0, Some((&[2.0, 2.0], &[0.5, 0.5])), RowsMut::new(&mut out, 2));
/// assert_eq!(out, [-1.5, 2.5]);
/// ```
pub fn layer_norm(
    isa: Isa,
    threads: usize,
    x: Rows<'_>,
    eps: f32,
    scale_shift: Option<(&[f32], &[f32])>,
    out: RowsMut<'_>,
) {
    let (rows, width) = (x.num_rows(), x.num_columns());
    assert_eq!(
        (out.num_rows(), out.num_columns()),
        (rows, width),
        "out: expected the shape of x"
    );
    if let Some((scale, shift)) = scale_shift {
        assert_eq!(
            (scale.len(), shift.len()),
            (width, width),
            "scale and shift: expected one element per column"
        );
    }
    if rows == 0 || width == 0 {
        return;
    }
    parallel_rows(threads, out, |rows, out| {
        let x = x.rows(rows);
        isa.run(&mut LayerNorm {
            x,
            eps,
            scale_shift,
            out,
        });
    });
}

struct LayerNorm<'a> {
    x: Rows<'a>,
    eps: f32,
    scale_shift: Option<(&'a [f32], &'a [f32])>,
    out: RowsMut<'a>,
}

impl Kernel for LayerNorm<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        for (out, x) in self.out.iter_mut().zip(self.x.iter()) {
            let norm = Norm::of(simd, x, self.eps);
            match self.scale_shift {
                Some((scale, shift)) => update(simd, out, [x, scale, shift], |_, [x, scale, shift]| {
                    simd.fma(norm.apply(simd, x), scale, shift)
                }),
                None => update(simd, out, [x], |_, [x]| norm.apply(simd, x)),
            }
        }
    }
}

/// The norm of one row.
struct Norm<S: Simd> {
    mean: S::F32,
    /// The part of the mean that it has no digits for.
    error: S::F32,
    /// One over the standard deviation.
    factor: S::F32,
}

impl<S: Simd> Norm<S> {
    #[inline(always)]
    fn of(simd: S, x: &[f32], eps: f32) -> Self {
        let columns = x.len() as f32;
        let (total, _) = sums(simd, x, 0.0);
        let mean = total / columns;
        // What the distances from the mean add up to is the error of the mean, which matters where the mean
        // is large compared with them.
        let (distances, squares) = sums(simd, x, mean);
        let error = distances / columns;
        let variance = (squares - distances * error) / columns;
        Self {
            mean: simd.splat(mean),
            error: simd.splat(error),
            factor: simd.splat(1.0 / (variance + eps).sqrt()),
        }
    }

    #[inline(always)]
    fn apply(&self, simd: S, x: S::F32) -> S::F32 {
        simd.mul(simd.sub(simd.sub(x, self.mean), self.error), self.factor)
    }
}

/// Sums of `x - centre` and of its squares, in four chains: short ones round less, and do not wait for each
/// other.
#[inline(always)]
fn sums<S: Simd>(simd: S, x: &[f32], centre: f32) -> (f32, f32) {
    const CHAINS: usize = 4;
    let centres = simd.splat(centre);
    let mut sums = [simd.splat(0.0); CHAINS];
    let mut squares = [simd.splat(0.0); CHAINS];
    let vectors = x.len() / S::LANES;
    let grouped = vectors - vectors % CHAINS;
    for first in (0..grouped).step_by(CHAINS) {
        // A loop over chains, so that their sums stay in registers.
        for chain in 0..CHAINS {
            let distance = simd.sub(simd.load(&x[(first + chain) * S::LANES..]), centres);
            sums[chain] = simd.add(sums[chain], distance);
            squares[chain] = simd.fma(distance, distance, squares[chain]);
        }
    }
    let mut sum = simd.add(simd.add(sums[0], sums[1]), simd.add(sums[2], sums[3]));
    let mut square = simd.add(simd.add(squares[0], squares[1]), simd.add(squares[2], squares[3]));
    for vector in grouped..vectors {
        let distance = simd.sub(simd.load(&x[vector * S::LANES..]), centres);
        sum = simd.add(sum, distance);
        square = simd.fma(distance, distance, square);
    }
    let (mut sum, mut square) = (simd.reduce_add(sum), simd.reduce_add(square));
    // One by one: lanes beyond the row would count as zeros, whose distance from the centre is not zero.
    for x in &x[vectors * S::LANES..] {
        let distance = x - centre;
        sum += distance;
        square += distance * distance;
    }
    (sum, square)
}
