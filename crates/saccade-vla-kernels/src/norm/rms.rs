//! RMSNorm over rows, or over each head of a row.
//!
//! Equation 27 of docs/equations.md.

use crate::isa::Isa;
use crate::parts::parallel_rows;
use crate::rows::{Rows, RowsMut};
use crate::simd::slices::update;
use crate::simd::{Kernel, Simd};

/// `out = x / sqrt(mean(x^2) + eps) * weight`, the mean over `weight.len()` consecutive columns.
///
/// `x` and `out` are `(rows, width)`. A weight of `width` elements norms whole rows; one of `head_dim`
/// elements norms each of the `width / head_dim` heads of a row by itself, as query and key norms do. An
/// element's bits depend on its head alone. A head of zeros gives zeros if `eps` is positive; NaN and
/// infinity give NaN in their head.
///
/// # Panics
/// If a shape does not fit, or this CPU lacks `isa`.
///
/// ```
/// use saccade_vla_kernels::{Isa, Rows, RowsMut, rms_norm};
/// let mut out = [0.0; 4];
/// let x = Rows::new(&[3.0, 3.0, 0.0, -2.0], 4); // two heads of width 2
/// rms_norm(Isa::best(), 1, x, 2.0, &[1.0, 10.0], RowsMut::new(&mut out, 4));
/// assert!((out[1] - 30.0 / 11f32.sqrt()).abs() < 1e-5);
/// assert_eq!(out[2..], [0.0, -10.0]);
/// ```
pub fn rms_norm(isa: Isa, threads: usize, x: Rows<'_>, eps: f32, weight: &[f32], out: RowsMut<'_>) {
    assert_eq!(
        (out.num_rows(), out.num_columns()),
        (x.num_rows(), x.num_columns()),
        "out: expected the shape of x"
    );
    norm(isa, threads, Some(x), eps, weight, out);
}

/// [`rms_norm`] where the results replace the rows.
///
/// # Panics
/// As [`rms_norm`].
pub fn rms_norm_in_place(isa: Isa, threads: usize, x: RowsMut<'_>, eps: f32, weight: &[f32]) {
    norm(isa, threads, None, eps, weight, x);
}

/// Norms the rows of `x`, or those of `out` where there is no `x`.
fn norm(isa: Isa, threads: usize, x: Option<Rows<'_>>, eps: f32, weight: &[f32], out: RowsMut<'_>) {
    isa.check();
    let width = out.num_columns();
    if out.num_rows() == 0 || width == 0 {
        return;
    }
    assert!(
        width.is_multiple_of(weight.len()),
        "weight: expected {width} elements, or a divisor of that, got {}",
        weight.len()
    );
    parallel_rows(threads, out, |rows, out| {
        let x = x.map(|x| x.rows(rows));
        isa.run(&mut RmsNorm { x, eps, weight, out });
    });
}

struct RmsNorm<'a> {
    /// None where the results replace the rows of `out`.
    x: Option<Rows<'a>>,
    eps: f32,
    /// Not empty, and its length divides the number of columns.
    weight: &'a [f32],
    out: RowsMut<'a>,
}

impl Kernel for RmsNorm<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        let (weight, eps) = (self.weight, self.eps);
        for (row, out) in self.out.iter_mut().enumerate() {
            let heads = out.chunks_exact_mut(weight.len());
            match self.x {
                Some(x) => {
                    for (out, x) in heads.zip(x.row(row).chunks_exact(weight.len())) {
                        let factor = factor(simd, x, eps);
                        update(simd, out, [x, weight], |_, [x, weight]| {
                            simd.mul(simd.mul(x, factor), weight)
                        });
                    }
                }
                None => {
                    for x in heads {
                        let factor = factor(simd, x, eps);
                        update(simd, x, [weight], |x, [weight]| {
                            simd.mul(simd.mul(x, factor), weight)
                        });
                    }
                }
            }
        }
    }
}

/// `1 / sqrt(mean(x^2) + eps)` in all lanes.
#[inline(always)]
fn factor<S: Simd>(simd: S, x: &[f32], eps: f32) -> S::F32 {
    let mean = sum_of_squares(simd, x) / x.len() as f32;
    simd.splat(1.0 / (mean + eps).sqrt())
}

/// The sum of the squares, in four chains: short ones round less, and do not wait for each other.
#[inline(always)]
fn sum_of_squares<S: Simd>(simd: S, x: &[f32]) -> f32 {
    const CHAINS: usize = 4;
    let mut squares = [simd.splat(0.0); CHAINS];
    let mut groups = x.chunks_exact(CHAINS * S::LANES);
    for group in &mut groups {
        for (chain, square) in squares.iter_mut().enumerate() {
            let x = simd.load(&group[chain * S::LANES..]);
            *square = simd.fma(x, x, *square);
        }
    }
    let [a, b, c, d] = squares;
    let mut sum = simd.add(simd.add(a, b), simd.add(c, d));
    for x in groups.remainder().chunks(S::LANES) {
        let x = simd.load_partial(x);
        sum = simd.fma(x, x, sum);
    }
    simd.reduce_add(sum)
}
