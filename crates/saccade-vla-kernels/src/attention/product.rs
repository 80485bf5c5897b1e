//! The product of a tile: a few rows of factors by vectors of keys or values, in registers.

use std::marker::PhantomData;

use super::arithmetic::{Float32, Pairs, Stored, TileArithmetic};
use super::mask::Mask;
use crate::simd::{Kernel, Simd, Vector};
use crate::tiles::{Ahead, MAX_COLUMN_TILES, Operation, Product, Session, TILE, TileUnit};

/// `out[r][v] (+)= sum over k of a[r][k] b[k][v]`: few rows, and vectors for columns.
pub(super) struct TileProduct {
    pub rows: usize,
    /// `a`, as factors.
    pub factors: *const f32,
    pub factors_stride: usize,
    pub b: *const u32,
    /// Words from one step over `k` to the next.
    pub b_step: usize,
    /// Words from one vector to the next.
    pub b_vector: usize,
    /// Elements over which is summed.
    pub depth: usize,
    pub out: *mut f32,
    pub out_stride: usize,
    /// Columns, in whole vectors.
    pub vectors: usize,
    /// Whether to add to what `out` holds.
    pub add: bool,
}

/// What makes the products of a tile whose factors are `A`'s.
pub(super) trait Multiply<S: Simd, A> {
    /// Blocks of keys begin at multiples of so many.
    const KEYS: usize;

    /// # Safety
    /// As [`TileProduct::run`].
    unsafe fn multiply(&mut self, simd: S, product: &TileProduct);
}

/// Vectors. Their products are a piece of code of their own for each arithmetic: their tiles are many, and compilers take minutes over them.
pub(super) struct InVectors;

impl<S: Simd, H: Stored> Multiply<S, Float32<H>> for InVectors {
    const KEYS: usize = S::Vector::LANES;

    #[inline(always)]
    unsafe fn multiply(&mut self, simd: S, product: &TileProduct) {
        let held = PhantomData::<H>;
        simd.run(FloatProduct { product, held });
    }
}

impl<S: Simd> Multiply<S, Pairs> for InVectors {
    const KEYS: usize = S::Vector::LANES;

    #[inline(always)]
    unsafe fn multiply(&mut self, simd: S, product: &TileProduct) {
        simd.run(PairProduct(product));
    }
}

/// Tiles, where vectors have as many lanes. Factors and what they multiply hold zeros to whole steps.
impl<S: Simd, U: TileUnit> Multiply<S, Pairs> for Session<U> {
    const KEYS: usize = TILE * Operation::Bf16.per_word();

    #[inline(always)]
    unsafe fn multiply(&mut self, _: S, product: &TileProduct) {
        const { assert!(S::Vector::LANES == TILE) }
        let mut first = 0;
        while first < product.vectors {
            let columns = columns_at_once(product, product.vectors - first);
            // SAFETY: the caller's promise.
            unsafe {
                self.multiply(&Product {
                    operation: Operation::Bf16,
                    rows: product.rows,
                    x: product.factors.cast(),
                    x_stride: product.factors_stride,
                    w: product.b.add(first * product.b_vector),
                    w_stride: product.b_step,
                    w_column: product.b_vector,
                    w_step: TILE * product.b_step,
                    columns,
                    steps: product.depth.div_ceil(<Self as Multiply<S, Pairs>>::KEYS),
                    sums: product.out.add(first * TILE).cast(),
                    sums_stride: product.out_stride,
                    add: product.add,
                    ahead: Ahead::NOTHING,
                });
            }
            first += columns;
        }
    }
}

/// How many of the `left` tiles of columns a unit takes at once: as many products in flight as its tiles of sums allow.
fn columns_at_once(product: &TileProduct, left: usize) -> usize {
    match left {
        _ if product.rows <= TILE => left.div_ceil(left.div_ceil(MAX_COLUMN_TILES)),
        // Not 3 and 1: a single column waits for each of its products.
        3 | 5.. if product.b_vector == TILE => 3,
        _ => left.min(2),
    }
}

struct FloatProduct<'a, H> {
    product: &'a TileProduct,
    held: PhantomData<H>,
}

impl<H: Stored> Kernel for FloatProduct<'_, H> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the promise to `Multiply::multiply`.
        unsafe { self.product.run::<S, Float32<H>>() }
    }
}

struct PairProduct<'a>(&'a TileProduct);

impl Kernel for PairProduct<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // SAFETY: the promise to `Multiply::multiply`.
        unsafe { self.0.run::<S, Pairs>() }
    }
}

impl TileProduct {
    /// All of it.
    ///
    /// # Safety
    /// The pointers are valid for all rows, at most `TILE_ROWS`, for `depth` elements in whole steps and for all vectors; called within
    /// [`Simd::run`] of `S`.
    #[inline(always)]
    unsafe fn run<S: Simd, A: TileArithmetic<S>>(&self) {
        // SAFETY: the caller's promise.
        unsafe {
            match self.rows {
                1 => self.all::<S, A, 1>(),
                2 => self.all::<S, A, 2>(),
                3 => self.all::<S, A, 3>(),
                4 => self.all::<S, A, 4>(),
                5 if S::Vector::TILE_ROWS >= 5 => self.all::<S, A, 5>(),
                6 if S::Vector::TILE_ROWS >= 6 => self.all::<S, A, 6>(),
                7 if S::Vector::TILE_ROWS >= 7 => self.all::<S, A, 7>(),
                8 if S::Vector::TILE_ROWS >= 8 => self.all::<S, A, 8>(),
                rows => unreachable!("a tile of {rows} rows"),
            }
        }
    }

    /// All columns of `MR` rows, a few at a time.
    ///
    /// # Safety
    /// As [`Self::run`].
    #[inline(always)]
    unsafe fn all<S: Simd, A: TileArithmetic<S>, const MR: usize>(&self) {
        let most = S::Vector::TILE_VECTORS;
        let groups = self.vectors.div_ceil(most);
        for group in 0..groups {
            let first = self.vectors * group / groups;
            let end = self.vectors * (group + 1) / groups;
            // SAFETY: the caller's promise.
            unsafe {
                match end - first {
                    1 => self.tile::<S, S::Vector, A, MR, 1>(first),
                    2 if most >= 2 => self.tile::<S, S::Vector, A, MR, 2>(first),
                    3 if most >= 3 => self.tile::<S, S::Vector, A, MR, 3>(first),
                    4 if most >= 4 => self.tile::<S, S::Vector, A, MR, 4>(first),
                    vectors => unreachable!("a tile of {vectors} vectors"),
                }
            }
        }
    }

    /// `NV` vectors from `first` on.
    ///
    /// # Safety
    /// As [`Self::run`].
    #[inline(always)]
    unsafe fn tile<S: Simd<Vector = V>, V: Vector, A: TileArithmetic<S>, const MR: usize, const NV: usize>(
        &self,
        first: usize,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let out = self.out.add(first * V::LANES);
            let mut acc = [[V::splat(0.0); NV]; MR];
            if self.add {
                for (r, row) in acc.iter_mut().enumerate() {
                    for (v, sum) in row.iter_mut().enumerate() {
                        *sum = V::load(out.add(r * self.out_stride + v * V::LANES));
                    }
                }
            }
            let mut b = self.b.add(first * self.b_vector);
            let mut factors = self.factors;
            let mut steps = self.depth.div_ceil(A::STEP);
            if V::BY_LANE {
                for _ in 0..steps * A::FACTORS / 4 {
                    let mut rows = [A::four(factors); MR];
                    for (r, row) in rows.iter_mut().enumerate().skip(1) {
                        *row = A::four(factors.add(r * self.factors_stride));
                    }
                    self.lane::<S, A, MR, NV, 0>(&mut acc, &rows, b);
                    self.lane::<S, A, MR, NV, 1>(&mut acc, &rows, b);
                    self.lane::<S, A, MR, NV, 2>(&mut acc, &rows, b);
                    self.lane::<S, A, MR, NV, 3>(&mut acc, &rows, b);
                    b = b.wrapping_add(4 / A::FACTORS * self.b_step);
                    factors = factors.wrapping_add(4);
                }
                steps %= 4 / A::FACTORS;
            }
            for _ in 0..steps {
                for part in 0..A::FACTORS {
                    let mut columns = [A::column(b, part); NV];
                    for (v, column) in columns.iter_mut().enumerate().skip(1) {
                        *column = A::column(b.add(v * self.b_vector), part);
                    }
                    for (r, row) in acc.iter_mut().enumerate() {
                        let factor = A::broadcast(factors.add(r * self.factors_stride + part));
                        for (sum, &column) in row.iter_mut().zip(&columns) {
                            *sum = A::multiply_add(factor, column, *sum);
                        }
                    }
                }
                b = b.wrapping_add(self.b_step);
                factors = factors.wrapping_add(A::FACTORS);
            }
            for (r, row) in acc.iter().enumerate() {
                for (v, sum) in row.iter().enumerate() {
                    sum.store(out.add(r * self.out_stride + v * V::LANES));
                }
            }
        }
    }

    /// Adds the products of factor number `LANE` of four of each row and what it meets from `b` on.
    ///
    /// # Safety
    /// As [`Self::run`], for the steps of four factors from `b` on.
    #[inline(always)]
    unsafe fn lane<S: Simd, A: TileArithmetic<S>, const MR: usize, const NV: usize, const LANE: i32>(
        &self,
        acc: &mut [[S::Vector; NV]; MR],
        rows: &[A::Operand; MR],
        b: *const u32,
    ) {
        let (step, part) = (LANE as usize / A::FACTORS, LANE as usize % A::FACTORS);
        // SAFETY: the caller's promise.
        unsafe {
            let b = b.add(step * self.b_step);
            for v in 0..NV {
                let column = A::column(b.add(v * self.b_vector), part);
                for (row, &factors) in acc.iter_mut().zip(rows) {
                    row[v] = A::multiply_add_lane::<LANE>(factors, column, row[v]);
                }
            }
        }
    }

    /// Adds as [`Self::run`] does, where values are not all finite: keys that the mask removes are passed over, because zero times infinity
    /// is not zero.
    ///
    /// # Safety
    /// As [`Self::run`].
    #[inline(always)]
    pub(super) unsafe fn without_removed<S: Simd<Vector = V>, V: Vector, A: TileArithmetic<S>>(
        &self,
        removed: &Removed<'_>,
    ) {
        for r in 0..self.rows {
            let query = removed.first_query + r;
            let bias = removed.mask.bias(removed.head, query, removed.len);
            let seen = removed.mask.visible(query, removed.len);
            for k in 0..self.depth.min(seen.saturating_sub(removed.first_key)) {
                if bias.is_some_and(|bias| bias[removed.first_key + k] == f32::NEG_INFINITY) {
                    continue;
                }
                // SAFETY: the caller's promise.
                unsafe {
                    let factor = V::splat(A::element(self.factors.add(r * self.factors_stride), k));
                    for v in 0..self.vectors {
                        let value = A::widen(
                            self.b.add(k / A::STEP * self.b_step + v * self.b_vector),
                            k % A::STEP,
                        );
                        let at = self.out.add(r * self.out_stride + v * V::LANES);
                        factor.fma(value, V::load(at)).store(at);
                    }
                }
            }
        }
    }
}

/// Which keys the rows of a product are without.
pub(super) struct Removed<'a> {
    pub mask: &'a Mask<'a>,
    pub head: usize,
    /// The first row's.
    pub first_query: usize,
    /// The first of the summed elements.
    pub first_key: usize,
    /// All keys.
    pub len: usize,
}
