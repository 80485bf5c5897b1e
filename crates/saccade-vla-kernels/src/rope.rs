//! Rotary position embedding, with the two halves of a head as the parts of the complex numbers that are rotated.

use std::ops::Range;

use crate::isa::Isa;
use crate::parts::part;
use crate::pool::parallel_for;
use crate::rows::{Rows, RowsMut};
use crate::simd::{Kernel, Simd, Vector, load, store};

/// Elements from which a second thread pays.
const ELEMENTS_FOR_THREADS: usize = 1 << 16;

/// Elements of one task.
const ELEMENTS_PER_TASK: usize = 1 << 13;

/// Rotates each head of each row in place, as Llama and Qwen do: `(a, b)` becomes `(a cos - b sin, b cos + a sin)`.
///
/// `x` is `(rows, num_heads * head_dim)`. `cos` and `sin` are `(rows, pairs)`, the angles of each row's position, for all of its heads. With
/// `pairs = head_dim / 2`, element `i` of a head is `a` and element `pairs + i` is `b` of pair `i`; with fewer, only the first `2 * pairs`
/// elements of a head are rotated. An element's bits depend on its pair and its angle alone.
///
/// # Panics
/// If a shape does not fit, or this CPU lacks `isa`.
///
/// ```
/// use saccade_vla_kernels::{Isa, Rows, RowsMut, rotary_embedding};
/// let mut x = [1.0, 2.0, 3.0, 4.0]; // two heads of width 2
/// let (cos, sin) = ([0.0], [1.0]); // a quarter of a turn
/// rotary_embedding(Isa::best(), 1, RowsMut::new(&mut x, 4), 2, Rows::new(&cos, 1), Rows::new(&sin, 1));
/// assert_eq!(x, [-2.0, 1.0, -4.0, 3.0]);
/// ```
pub fn rotary_embedding(
    isa: Isa,
    threads: usize,
    mut x: RowsMut<'_>,
    head_dim: usize,
    cos: Rows<'_>,
    sin: Rows<'_>,
) {
    isa.check();
    let (rows, width, pairs) = (x.num_rows(), x.num_columns(), cos.num_columns());
    assert!(
        head_dim > 0 && width.is_multiple_of(head_dim),
        "head_dim: expected a divisor of the {width} columns of x, got {head_dim}"
    );
    assert!(
        cos.num_rows() == rows && pairs <= head_dim / 2,
        "cos: expected ({rows}, at most {}), got ({}, {pairs})",
        head_dim / 2,
        cos.num_rows()
    );
    assert_eq!(
        (sin.num_rows(), sin.num_columns()),
        (rows, pairs),
        "sin: expected the shape of cos"
    );
    if rows == 0 || width == 0 || pairs == 0 {
        return;
    }
    let call = Rotation {
        x_stride: x.row_stride(),
        x: x.as_mut_ptr(),
        width,
        head_dim,
        cos,
        sin,
    };
    let elements = rows.saturating_mul(width);
    let tasks = elements.div_ceil(ELEMENTS_PER_TASK).min(rows);
    let threads = if elements < ELEMENTS_FOR_THREADS {
        1
    } else {
        threads
    };
    parallel_for(threads, tasks, &|task| {
        isa.run(RotationRows {
            call: &call,
            rows: part(rows, task, tasks),
        });
    });
}

struct Rotation<'a> {
    x: *mut f32,
    x_stride: usize,
    width: usize,
    head_dim: usize,
    cos: Rows<'a>,
    sin: Rows<'a>,
}

// SAFETY: tasks read and write different rows of `x`, which is borrowed for the whole call.
unsafe impl Sync for Rotation<'_> {}

struct RotationRows<'a> {
    call: &'a Rotation<'a>,
    rows: Range<usize>,
}

impl Kernel for RotationRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let call = self.call;
        for row in self.rows {
            let (cos, sin) = (call.cos.row(row), call.sin.row(row));
            for head in (0..call.width).step_by(call.head_dim) {
                // SAFETY: rows are within the view, heads within rows, and pairs within heads.
                unsafe { rotate::<S::Vector>(call.x.add(row * call.x_stride + head), cos, sin) };
            }
        }
    }
}

/// # Safety
/// Called within [`Simd::run`] with the vectors of `V`. `x` points to twice as many elements as `cos` and `sin` have.
#[inline(always)]
unsafe fn rotate<V: Vector>(x: *mut f32, cos: &[f32], sin: &[f32]) {
    let pairs = cos.len();
    for i in (0..pairs).step_by(V::LANES) {
        let lanes = V::LANES.min(pairs - i);
        // SAFETY: the caller's promise; the last vector is partial.
        unsafe {
            let (first, second) = (x.add(i), x.add(pairs + i));
            let (a, b) = (load::<V>(first, lanes), load::<V>(second, lanes));
            let (cos, sin) = (
                load::<V>(cos.as_ptr().add(i), lanes),
                load::<V>(sin.as_ptr().add(i), lanes),
            );
            // The first product of each is rounded, the second not where there is FMA.
            store(a.fma(cos, V::splat(0.0).sub(b.mul(sin))), first, lanes);
            store(b.fma(cos, a.mul(sin)), second, lanes);
        }
    }
}
