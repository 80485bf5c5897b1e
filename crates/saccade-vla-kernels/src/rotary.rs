//! Rotary position embedding, with the two halves of a head as the parts of the complex numbers that are
//! rotated.
//!
//! Equation 24 of docs/equations.md.

use crate::isa::Isa;
use crate::parts::parallel_rows;
use crate::rows::{Rows, RowsMut};
use crate::simd::{Kernel, Simd};

/// Rotates each head of each row in place, as Llama and Qwen do: `(a, b)` becomes
/// `(a cos - b sin, b cos + a sin)`.
///
/// `x` is `(rows, num_heads * head_dim)`. `cos` and `sin` are `(rows, pairs)`, the angles of each row's
/// position, for all of its heads. With `pairs = head_dim / 2`, element `i` of a head is `a` and element
/// `pairs + i` is `b` of pair `i`; with fewer, only the first `2 * pairs` elements of a head are rotated. An
/// element's bits depend on its pair and its angle alone.
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
    x: RowsMut<'_>,
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
    parallel_rows(threads, x, |rows, x| {
        let (cos, sin) = (cos.rows(rows.clone()), sin.rows(rows));
        isa.run(&mut Rotary {
            x,
            head_dim,
            cos,
            sin,
        });
    });
}

struct Rotary<'a> {
    x: RowsMut<'a>,
    head_dim: usize,
    cos: Rows<'a>,
    sin: Rows<'a>,
}

impl Kernel for Rotary<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        let angles = self.cos.iter().zip(self.sin.iter());
        for (row, (cos, sin)) in self.x.iter_mut().zip(angles) {
            for head in row.chunks_exact_mut(self.head_dim) {
                rotate(simd, head, cos, sin);
            }
        }
    }
}

/// Rotates the pairs of one head by their angles.
#[inline(always)]
fn rotate<S: Simd>(simd: S, head: &mut [f32], cos: &[f32], sin: &[f32]) {
    let (first, second) = head[..2 * cos.len()].split_at_mut(cos.len());
    let pairs = first.chunks_mut(S::LANES).zip(second.chunks_mut(S::LANES));
    let angles = cos.chunks(S::LANES).zip(sin.chunks(S::LANES));
    for ((first, second), (cos, sin)) in pairs.zip(angles) {
        let (a, b) = (simd.load_partial(first), simd.load_partial(second));
        let (cos, sin) = (simd.load_partial(cos), simd.load_partial(sin));
        // The first product of each is rounded, the second not where there is FMA.
        let minus_b_sin = simd.sub(simd.splat(0.0), simd.mul(b, sin));
        simd.store_partial(simd.fma(a, cos, minus_b_sin), first);
        simd.store_partial(simd.fma(b, cos, simd.mul(a, sin)), second);
    }
}
