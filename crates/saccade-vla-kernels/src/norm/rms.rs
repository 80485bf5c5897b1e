//! RMSNorm over rows, or over each head of a row.

use std::ops::Range;

use super::split;
use crate::isa::Isa;
use crate::parts::part;
use crate::pool::parallel_for;
use crate::rows::{Rows, RowsMut};
use crate::simd::{Kernel, Simd, Vector, load, store};

/// `out = x / sqrt(mean(x^2) + eps) * weight`, the mean over `weight.len()` consecutive columns.
///
/// `x` and `out` are `(rows, width)`. A weight of `width` elements norms whole rows; one of `head_dim` elements norms each of the
/// `width / head_dim` heads of a row by itself, as query and key norms do. An element's bits depend on its head alone. A head of zeros gives
/// zeros if `eps` is positive; NaN and infinity give NaN in their head.
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
pub fn rms_norm(isa: Isa, threads: usize, x: Rows<'_>, eps: f32, weight: &[f32], mut out: RowsMut<'_>) {
    assert_eq!(
        (out.num_rows(), out.num_columns()),
        (x.num_rows(), x.num_columns()),
        "out: expected the shape of x"
    );
    let call = RmsNorm {
        x: x.as_ptr(),
        x_stride: x.row_stride(),
        out_stride: out.row_stride(),
        out: out.as_mut_ptr(),
        width: x.num_columns(),
        eps,
        weight,
    };
    run(isa, threads, x.num_rows(), &call);
}

/// [`rms_norm`] where the results replace the rows.
///
/// # Panics
/// As [`rms_norm`].
pub fn rms_norm_in_place(isa: Isa, threads: usize, mut x: RowsMut<'_>, eps: f32, weight: &[f32]) {
    let to = x.as_mut_ptr();
    let call = RmsNorm {
        x: to,
        x_stride: x.row_stride(),
        out_stride: x.row_stride(),
        out: to,
        width: x.num_columns(),
        eps,
        weight,
    };
    run(isa, threads, x.num_rows(), &call);
}

struct RmsNorm<'a> {
    /// May be `out`.
    x: *const f32,
    x_stride: usize,
    out: *mut f32,
    out_stride: usize,
    width: usize,
    eps: f32,
    /// Not empty, and its length divides `width`.
    weight: &'a [f32],
}

// SAFETY: tasks read and write different rows; the views are borrowed for the whole call.
unsafe impl Sync for RmsNorm<'_> {}

fn run(isa: Isa, threads: usize, rows: usize, call: &RmsNorm<'_>) {
    isa.check();
    if rows == 0 || call.width == 0 {
        return;
    }
    assert!(
        call.width.is_multiple_of(call.weight.len()),
        "weight: expected {} elements, or a divisor of that, got {}",
        call.width,
        call.weight.len()
    );
    let (threads, tasks) = split(threads, rows, call.width);
    parallel_for(threads, tasks, &|task| {
        isa.run(RmsNormRows {
            call,
            rows: part(rows, task, tasks),
        });
    });
}

struct RmsNormRows<'a> {
    call: &'a RmsNorm<'a>,
    rows: Range<usize>,
}

impl Kernel for RmsNormRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let call = self.call;
        for row in self.rows {
            for head in (0..call.width).step_by(call.weight.len()) {
                // SAFETY: rows are within the views, heads within rows.
                unsafe {
                    let x = call.x.add(row * call.x_stride + head);
                    let out = call.out.add(row * call.out_stride + head);
                    norm_head::<S::Vector>(call, x, out);
                }
            }
        }
    }
}

/// # Safety
/// Called within [`Simd::run`] with the vectors of `V`. `x` and `out` point to as many elements as the weight has; they are the same, or do
/// not overlap.
#[inline(always)]
unsafe fn norm_head<V: Vector>(call: &RmsNorm<'_>, x: *const f32, out: *mut f32) {
    let width = call.weight.len();
    let weight = call.weight.as_ptr();
    // SAFETY: vectors are within the first `width` elements, the last one is partial. Each is read before it is written.
    unsafe {
        let mean = squares::<V>(x, width) / width as f32;
        let factor = V::splat(1.0 / (mean + call.eps).sqrt());
        for i in (0..width).step_by(V::LANES) {
            let lanes = V::LANES.min(width - i);
            let y = load::<V>(x.add(i), lanes).mul(factor);
            store(y.mul(load(weight.add(i), lanes)), out.add(i), lanes);
        }
    }
}

/// The sum of the squares, in four chains: short ones round less, and do not wait for each other.
///
/// # Safety
/// Called within [`Simd::run`] with the vectors of `V`. `x` points to `width` elements.
#[inline(always)]
unsafe fn squares<V: Vector>(x: *const f32, width: usize) -> f32 {
    const CHAINS: usize = 4;
    // SAFETY: the caller's promise.
    unsafe {
        let mut squares = [V::splat(0.0); CHAINS];
        let vectors = width / V::LANES;
        for i in (0..vectors / CHAINS * CHAINS).step_by(CHAINS) {
            for (chain, square) in squares.iter_mut().enumerate() {
                let x = V::load(x.add((i + chain) * V::LANES));
                *square = x.fma(x, *square);
            }
        }
        let mut sum = squares[0].add(squares[1]).add(squares[2].add(squares[3]));
        for i in vectors / CHAINS * CHAINS..width.div_ceil(V::LANES) {
            let first = i * V::LANES;
            let x = load::<V>(x.add(first), V::LANES.min(width - first));
            sum = x.fma(x, sum);
        }
        sum.reduce_add()
    }
}
