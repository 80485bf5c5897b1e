//! Epilogues: from the sums of a block to results, by dequantisation, outliers, bias, activation, and what is
//! done with what `out` holds.
//!
//! Equations 35 and 40 of docs/equations.md.

use std::marker::PhantomData;

use crate::gemm::Quantized;
use crate::gemm::outliers::Outliers;
use crate::rows::{Rows, RowsMut};
use crate::simd::math::{self, Activation};
use crate::simd::{Kernel, Simd};

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

/// Makes results of the sums of some rows and one panel.
pub(super) struct Finish<'a> {
    pub epilogue: Epilogue,
    /// The sums, in whole vectors: the bits of float32, or int32.
    pub sums: Rows<'a, u32>,
    /// Of each column of the panel.
    pub bias: &'a [f32],
    /// How int32 sums become float32; None for sums that are float32 already.
    pub quantized: Option<Dequantization<'a>>,
    /// The columns of the panel that the layer has.
    pub out: RowsMut<'a>,
}

/// Dequantisation: the scale of each column's weights and the sum of them, and how each row was quantised.
#[derive(Clone, Copy)]
pub(super) struct Dequantization<'a> {
    pub scales: &'a [f32],
    pub weight_sums: &'a [i32],
    pub quantized: &'a [Quantized],
    /// The outliers of each row, if any row has some; otherwise empty.
    pub outliers: &'a [Outliers],
    /// The products of outliers with the whole numbers that weights are, for rows that have outliers.
    pub apart: Rows<'a>,
}

impl<'a> Dequantization<'a> {
    /// What the outliers of a row add to it, if it has any.
    #[inline(always)]
    fn apart(&self, row: usize) -> Option<&'a [f32]> {
        let has_outliers = self
            .outliers
            .get(row)
            .is_some_and(|outliers| !outliers.is_empty());
        has_outliers.then(|| self.apart.row(row))
    }
}

impl Kernel for Finish<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        match self.epilogue {
            Epilogue::Store => self.rows::<S, Store>(simd),
            Epilogue::GeluTanh => self.rows::<S, Activated<math::GeluTanh>>(simd),
            Epilogue::GeluErf => self.rows::<S, Activated<math::GeluErf>>(simd),
            Epilogue::Relu => self.rows::<S, Activated<math::Relu>>(simd),
            Epilogue::Silu => self.rows::<S, Activated<math::Silu>>(simd),
            Epilogue::Add => self.rows::<S, Add>(simd),
            Epilogue::Mul => self.rows::<S, Mul>(simd),
        }
    }
}

impl Finish<'_> {
    /// After the tiles and not in them: a sum's way through the first-level cache is nothing next to its
    /// making, and the code is there once, not in each tile.
    #[inline(always)]
    fn rows<S: Simd, R: Finishing>(&mut self, simd: S) {
        for (row, (out, sums)) in self.out.iter_mut().zip(self.sums.iter()).enumerate() {
            match &self.quantized {
                None => float_row::<S, R>(simd, sums, self.bias, out),
                Some(how) => integer_row::<S, R>(simd, sums, how, row, self.bias, out),
            }
        }
    }
}

/// A row of float32 sums.
#[inline(always)]
fn float_row<S: Simd, R: Finishing>(simd: S, sums: &[u32], bias: &[f32], out: &mut [f32]) {
    let sums = sums.chunks_exact(S::LANES).zip(bias.chunks_exact(S::LANES));
    for (out, (sums, bias)) in out.chunks_mut(S::LANES).zip(sums) {
        let value = simd.bits_to_f32(simd.load_words(sums));
        let value = simd.add(value, simd.load(bias));
        simd.store_partial(R::of(simd, value, out), out);
    }
}

/// A row of int32 sums.
#[inline(always)]
fn integer_row<S: Simd, R: Finishing>(
    simd: S,
    sums: &[u32],
    how: &Dequantization<'_>,
    row: usize,
    bias: &[f32],
    out: &mut [f32],
) {
    let Quantized { scale, zero } = how.quantized[row];
    let (scale, zero) = (simd.splat(scale), simd.splat_i32(zero));
    let mut apart = how.apart(row).map(|apart| apart.chunks_exact(S::LANES));
    let columns = how
        .scales
        .chunks_exact(S::LANES)
        .zip(how.weight_sums.chunks_exact(S::LANES));
    let sums = sums.chunks_exact(S::LANES).zip(bias.chunks_exact(S::LANES));
    for (out, ((sums, bias), (scales, weight_sums))) in out.chunks_mut(S::LANES).zip(sums.zip(columns)) {
        let scales = simd.load(scales);
        // Every byte of the row is its zero point too large.
        let too_much = simd.mul_i32(zero, simd.load_i32(weight_sums));
        let sum = simd.sub_i32(simd.load_words(sums), too_much);
        // The weights' scale first: a row of huge values would overflow before weights make it small again.
        let mut value = simd.mul(simd.mul(simd.to_f32(sum), scales), scale);
        if let Some(apart) = apart.as_mut().and_then(Iterator::next) {
            value = simd.fma(simd.load(apart), scales, value);
        }
        let value = simd.add(value, simd.load(bias));
        simd.store_partial(R::of(simd, value, out), out);
    }
}

/// What an [`Epilogue`] makes of a vector of sums with their bias.
trait Finishing {
    /// `out` is where the result goes.
    fn of<S: Simd>(simd: S, value: S::F32, out: &[f32]) -> S::F32;
}

struct Store;
struct Activated<A>(PhantomData<A>);
struct Add;
struct Mul;

impl Finishing for Store {
    #[inline(always)]
    fn of<S: Simd>(_: S, value: S::F32, _: &[f32]) -> S::F32 {
        value
    }
}

impl<A: Activation> Finishing for Activated<A> {
    #[inline(always)]
    fn of<S: Simd>(simd: S, value: S::F32, _: &[f32]) -> S::F32 {
        A::of(simd, value)
    }
}

impl Finishing for Add {
    #[inline(always)]
    fn of<S: Simd>(simd: S, value: S::F32, out: &[f32]) -> S::F32 {
        simd.add(simd.load_partial(out), value)
    }
}

impl Finishing for Mul {
    #[inline(always)]
    fn of<S: Simd>(simd: S, value: S::F32, out: &[f32]) -> S::F32 {
        simd.mul(simd.load_partial(out), value)
    }
}
