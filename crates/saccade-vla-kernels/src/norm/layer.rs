//! LayerNorm over rows, plain or with a scale and a shift applied in the same pass.

use std::ops::Range;

use super::split;
use crate::isa::Isa;
use crate::parts::part;
use crate::pool::parallel_for;
use crate::rows::{Rows, RowsMut};
use crate::simd::{Kernel, Simd, Vector, load, store};

/// `out = norm(x) * scale + shift`, row by row, with `norm(x) = (x - mean) / sqrt(variance + eps)` over the columns.
///
/// `x` and `out` are `(rows, width)`, row-major with any row stride; `scale` and `shift` have `width` elements and hold for all rows: the
/// learned affine, or `1 + scale` and `shift` of an adaptive norm. The variance is the mean of squared distances from the mean, in a second
/// pass over the row, which also finds what rounding has left of the mean: rows far from zero are as exact as others. A row of zero variance
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
    mut out: RowsMut<'_>,
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
    let call = LayerNorm {
        x: x.as_ptr(),
        x_stride: x.row_stride() as isize,
        out_stride: out.row_stride() as isize,
        out: out.as_mut_ptr(),
        width,
        eps,
        scale_shift,
    };
    let (threads, tasks) = split(threads, rows, width);
    parallel_for(threads, tasks, &|task| {
        isa.run(LayerNormRows {
            call: &call,
            rows: part(rows, task, tasks),
        });
    });
}

struct LayerNorm<'a> {
    x: *const f32,
    x_stride: isize,
    out: *mut f32,
    out_stride: isize,
    width: usize,
    eps: f32,
    scale_shift: Option<(&'a [f32], &'a [f32])>,
}

// SAFETY: tasks read `x` and write different rows of `out`; both views are borrowed for the whole call.
unsafe impl Sync for LayerNorm<'_> {}

struct LayerNormRows<'a> {
    call: &'a LayerNorm<'a>,
    rows: Range<usize>,
}

impl Kernel for LayerNormRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for row in self.rows {
            // SAFETY: rows are within the views; the caller has the instruction set.
            unsafe {
                let x = self.call.x.offset(row as isize * self.call.x_stride);
                let out = self.call.out.offset(row as isize * self.call.out_stride);
                norm_row::<S::Vector>(self.call, x, out);
            }
        }
    }
}

/// # Safety
/// `x` and `out` point to `call.width` elements; the CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn norm_row<V: Vector>(call: &LayerNorm<'_>, x: *const f32, out: *mut f32) {
    let width = call.width;
    let columns = width as f32;
    // SAFETY: vectors are within the first `width` elements, the last one is partial; scale and shift are as long.
    unsafe {
        let (total, _) = sums::<V>(x, width, 0.0);
        let mean = total / columns;
        // What the distances from the mean add up to is the error of the mean, which matters where the mean is large compared with them.
        let (distances, squares) = sums::<V>(x, width, mean);
        let error = distances / columns;
        let variance = (squares - distances * error) / columns;
        let row = Normed {
            mean: V::splat(mean),
            error: V::splat(error),
            factor: V::splat(1.0 / (variance + call.eps).sqrt()),
        };
        for i in (0..width).step_by(V::LANES) {
            let lanes = V::LANES.min(width - i);
            let y = row.of(load::<V>(x.add(i), lanes));
            let y = match call.scale_shift {
                Some((scale, shift)) => {
                    let scale = load::<V>(scale.as_ptr().add(i), lanes);
                    y.fma(scale, load(shift.as_ptr().add(i), lanes))
                }
                None => y,
            };
            store(y, out.add(i), lanes);
        }
    }
}

/// What a row's elements are normed with.
struct Normed<V> {
    mean: V,
    /// To be taken off as well: the part of the mean that it has no digits for.
    error: V,
    factor: V,
}

impl<V: Vector> Normed<V> {
    /// # Safety
    /// The CPU has the instruction set of `V`.
    #[inline(always)]
    unsafe fn of(&self, x: V) -> V {
        // SAFETY: the caller's promise.
        unsafe { x.sub(self.mean).sub(self.error).mul(self.factor) }
    }
}

/// Sums of `x - centre` and of its squares, in four chains: short ones round less, and do not wait for each other.
///
/// # Safety
/// `x` points to `width` elements; the CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn sums<V: Vector>(x: *const f32, width: usize, centre: f32) -> (f32, f32) {
    const CHAINS: usize = 4;
    // SAFETY: the caller's promise.
    unsafe {
        let mut sums = [V::splat(0.0); CHAINS];
        let mut squares = [V::splat(0.0); CHAINS];
        let vectors = width / V::LANES;
        // A loop over chains, so that their sums stay in registers.
        for i in (0..vectors / CHAINS * CHAINS).step_by(CHAINS) {
            for chain in 0..CHAINS {
                let distance = V::load(x.add((i + chain) * V::LANES)).sub(V::splat(centre));
                sums[chain] = sums[chain].add(distance);
                squares[chain] = distance.fma(distance, squares[chain]);
            }
        }
        let mut sum = sums[0].add(sums[1]).add(sums[2].add(sums[3]));
        let mut square = squares[0].add(squares[1]).add(squares[2].add(squares[3]));
        for i in vectors / CHAINS * CHAINS..vectors {
            let distance = V::load(x.add(i * V::LANES)).sub(V::splat(centre));
            sum = sum.add(distance);
            square = distance.fma(distance, square);
        }
        let (mut sum, mut square) = (sum.reduce_add(), square.reduce_add());
        // One by one: lanes beyond the row would count as zeros, whose distance from the centre is not zero.
        for i in vectors * V::LANES..width {
            let distance = *x.add(i) - centre;
            sum += distance;
            square += distance * distance;
        }
        (sum, square)
    }
}
