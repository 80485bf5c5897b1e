//! From the sums of a block to results: scales, bias, activation, and what is done with what `out` holds.

use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::ops::Range;

use crate::gemm::Quantized;
use crate::gemm::outliers::Outliers;
use crate::simd::old::math::{self, Activation};
use crate::simd::{Kernel, Simd, Vector, load, store};

/// What is done with `x W^T + bias`, element by element.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Epilogue {
    /// Stored as it is.
    Store,
    /// `0.5 x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3)))`.
    GeluTanh,
    /// `0.5 x (1 + erf(x / sqrt(2)))`.
    GeluErf,
    /// `max(x, 0)`.
    Relu,
    /// `x / (1 + exp(-x))`.
    Silu,
    /// Added to what `out` holds: the residual stream.
    Add,
    /// Multiplied by what `out` holds: the activated gate of a gated layer.
    Mul,
}

/// The sums of some rows and one panel, and where the results go.
pub(super) struct Finish<'a> {
    pub epilogue: Epilogue,
    /// Rows of `columns` words, from the first of `rows` on. Those of `width` columns are written, up to whole vectors.
    pub sums: *const u32,
    pub columns: usize,
    pub rows: Range<usize>,
    /// Columns of the panel that the layer has.
    pub width: usize,
    /// Of each column of the panel.
    pub bias: &'a [f32],
    /// For int8; otherwise empty.
    pub int8: Int8<'a>,
    /// Row 0 of the results of this panel.
    pub out: *mut f32,
    pub out_stride: isize,
}

/// How int8 sums become float32: what one step of a column's weights is worth and their sum, and how each row was quantised.
#[derive(Clone, Copy)]
pub(super) struct Int8<'a> {
    pub scales: &'a [f32],
    pub sums: &'a [i32],
    pub quantized: &'a [Quantized],
    /// Of each of the rows, if any row has some.
    pub outliers: &'a [Outliers],
    /// Their products with the whole numbers that weights are, in rows of the panel's columns, written for rows that have outliers; none if
    /// no row has.
    pub apart: Option<&'a [MaybeUninit<f32>]>,
}

// By reference: by value it would be copied in vectors just after it was stored in words, and store forwarding would fail. A float32 layer of 3
// rows, 8 inputs and 32 outputs took 247 instead of 201 ns, one of 16, 128 and 128 3.56 instead of 3.38 us (AVX-512, Emerald Rapids).
impl Kernel for &Finish<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the views of the call have the rows and columns; the sums of their columns have been written, in whole vectors.
        unsafe {
            if self.int8.scales.is_empty() {
                self.of::<S::Vector, FloatSums>();
            } else {
                self.of::<S::Vector, Int8Sums>();
            }
        }
    }
}

impl Finish<'_> {
    /// # Safety
    /// Called within [`Simd::run`]. The rows and the panel's columns are in `out`; `sums` holds the rows, as `M` reads them.
    #[inline(always)]
    unsafe fn of<V: Vector, M: Sums>(&self) {
        // SAFETY: the caller's promise.
        unsafe {
            match self.epilogue {
                Epilogue::Store => self.each::<V, M, Store>(),
                Epilogue::GeluTanh => self.each::<V, M, Activated<math::GeluTanh>>(),
                Epilogue::GeluErf => self.each::<V, M, Activated<math::GeluErf>>(),
                Epilogue::Relu => self.each::<V, M, Activated<math::Relu>>(),
                Epilogue::Silu => self.each::<V, M, Activated<math::Silu>>(),
                Epilogue::Add => self.each::<V, M, Add>(),
                Epilogue::Mul => self.each::<V, M, Mul>(),
            }
        }
    }

    /// After the tiles and not in them: a sum's way through the first-level cache is nothing next to its making, and the code is there
    /// once, not in each tile.
    ///
    /// # Safety
    /// As [`Self::of`].
    #[inline(always)]
    unsafe fn each<V: Vector, M: Sums, R: Finishing>(&self) {
        for vector in 0..self.width.div_ceil(V::LANES) {
            let column = vector * V::LANES;
            let lanes = V::LANES.min(self.width - column);
            // SAFETY: the caller's promise; partial vectors stay within the panel's columns, and their sums were written as whole vectors.
            unsafe {
                let bias = V::load(self.bias.as_ptr().add(column));
                let columns = M::columns::<V>(&self.int8, column);
                let mut out = self
                    .out
                    .offset(self.rows.start as isize * self.out_stride)
                    .add(column);
                let mut sums = self.sums.add(column);
                for row in self.rows.clone() {
                    let mut value = M::value(sums, columns, &self.int8, row);
                    if let Some(apart) = self.apart(row - self.rows.start) {
                        value = M::with_outliers(value, columns, apart.add(column));
                    }
                    let value = value.add(bias);
                    store(R::of(value, out, lanes), out, lanes);
                    out = out.wrapping_offset(self.out_stride);
                    sums = sums.wrapping_add(self.columns);
                }
            }
        }
    }
}

impl Finish<'_> {
    /// What the outliers of a row add to it, if it has any. Rows count from the first one.
    #[inline(always)]
    fn apart(&self, row: usize) -> Option<*const f32> {
        let apart = self.int8.apart?;
        let has_some = !self.int8.outliers[row].is_empty();
        has_some.then(|| apart[row * self.columns..][..self.columns].as_ptr().cast())
    }
}

/// How the words of a sum become float32.
trait Sums {
    /// What the columns of a vector have in common for all rows.
    type Columns<V: Vector>: Copy;

    /// # Safety
    /// Here and below: called within [`Simd::run`] with the vectors of `V`. The columns are in the panel.
    unsafe fn columns<V: Vector>(int8: &Int8<'_>, column: usize) -> Self::Columns<V>;

    /// # Safety
    /// `sums` points to a vector of words; the row was quantised, if sums are those of quantised rows.
    unsafe fn value<V: Vector>(sums: *const u32, columns: Self::Columns<V>, int8: &Int8<'_>, row: usize)
    -> V;

    /// `value` and what outliers add to it.
    ///
    /// # Safety
    /// `apart` points to a vector of products.
    unsafe fn with_outliers<V: Vector>(value: V, columns: Self::Columns<V>, apart: *const f32) -> V;
}

/// Sums that are float32 already.
struct FloatSums;

/// int32 sums, to be multiplied by the scales of their row and column.
struct Int8Sums;

impl Sums for FloatSums {
    type Columns<V: Vector> = ();

    #[inline(always)]
    unsafe fn columns<V: Vector>(_: &Int8<'_>, _: usize) {}

    #[inline(always)]
    unsafe fn value<V: Vector>(sums: *const u32, (): (), _: &Int8<'_>, _: usize) -> V {
        // SAFETY: the caller gives a vector of words.
        unsafe { V::load(sums.cast()) }
    }

    #[inline(always)]
    unsafe fn with_outliers<V: Vector>(value: V, (): (), _: *const f32) -> V {
        value
    }
}

impl Sums for Int8Sums {
    /// Scales, and the sums of the weights.
    type Columns<V: Vector> = (V, V::Ints);

    #[inline(always)]
    unsafe fn columns<V: Vector>(int8: &Int8<'_>, column: usize) -> (V, V::Ints) {
        // SAFETY: the caller's promise.
        unsafe {
            (
                V::load(int8.scales.as_ptr().add(column)),
                V::load_ints(int8.sums.as_ptr().add(column)),
            )
        }
    }

    #[inline(always)]
    unsafe fn value<V: Vector>(
        sums: *const u32,
        (scales, weights): (V, V::Ints),
        int8: &Int8<'_>,
        row: usize,
    ) -> V {
        let Quantized { scale, zero } = int8.quantized[row];
        // SAFETY: the caller's promise.
        unsafe {
            // Every byte of the row is `zero` too large.
            let sum = V::sub_ints(
                V::load_ints(sums.cast()),
                V::mul_ints(V::splat_int(zero), weights),
            );
            // The weights' scale first: a row of huge values would overflow before weights make it small again.
            V::from_ints(sum).mul(scales).mul(V::splat(scale))
        }
    }

    #[inline(always)]
    unsafe fn with_outliers<V: Vector>(value: V, (scales, _): (V, V::Ints), apart: *const f32) -> V {
        // SAFETY: the caller's promise.
        unsafe { V::load(apart).fma(scales, value) }
    }
}

/// What an [`Epilogue`] makes of a vector of sums with their bias.
trait Finishing {
    /// # Safety
    /// Called within [`Simd::run`] with the vectors of `V`; `out` points to `lanes` elements.
    unsafe fn of<V: Vector>(value: V, out: *const f32, lanes: usize) -> V;
}

struct Store;
struct Activated<A>(PhantomData<A>);
struct Add;
struct Mul;

impl Finishing for Store {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, _: *const f32, _: usize) -> V {
        value
    }
}

impl<A: Activation> Finishing for Activated<A> {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, _: *const f32, _: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { A::of(value) }
    }
}

impl Finishing for Add {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, out: *const f32, lanes: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { load::<V>(out, lanes).add(value) }
    }
}

impl Finishing for Mul {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, out: *const f32, lanes: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { load::<V>(out, lanes).mul(value) }
    }
}
