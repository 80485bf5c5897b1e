//! The products of attention: a few rows of factors by vectors of keys or values, in registers.

use std::marker::PhantomData;

use super::arithmetic::{Bf16Products, Float32Products, Stored, TileArithmetic};
use super::mask::Mask;
use crate::simd::bits::cast;
use crate::simd::{Kernel, Simd};
use crate::tiles::{Ahead, MAX_COLUMN_TILES, Operation, Product, Session, TILE, TileUnit};

/// The operands of `out[r][v] (+)= sum over k of a[r][k] b[k][v]`: few rows, and vectors for columns.
pub(super) struct Operands {
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

/// A product whose operands exist, as the arithmetic `A` reads them.
pub(super) struct AttentionProduct<A> {
    operands: Operands,
    arithmetic: PhantomData<A>,
}

/// What makes the products of queries or probabilities that are `A`'s factors.
pub(super) trait Multiply<S: Simd, A> {
    /// Blocks of keys begin at multiples of so many, and operands are in whole steps of so many elements.
    const KEYS: usize;

    fn multiply(&mut self, simd: S, product: &AttentionProduct<A>);
}

/// Vectors. Their products are a piece of code of their own for each arithmetic: their tiles are many, and
/// compilers take minutes over them.
pub(super) struct VectorProducts;

impl<S: Simd, T: Stored> Multiply<S, Float32Products<T>> for VectorProducts {
    const KEYS: usize = S::LANES;

    #[inline(always)]
    fn multiply(&mut self, simd: S, product: &AttentionProduct<Float32Products<T>>) {
        simd.run(&mut InVectors(product));
    }
}

impl<S: Simd> Multiply<S, Bf16Products> for VectorProducts {
    const KEYS: usize = S::LANES;

    #[inline(always)]
    fn multiply(&mut self, simd: S, product: &AttentionProduct<Bf16Products>) {
        simd.run(&mut InVectors(product));
    }
}

/// Tiles, where vectors have as many lanes.
impl<S: Simd, U: TileUnit> Multiply<S, Bf16Products> for Session<U> {
    const KEYS: usize = TILE * Operation::Bf16.per_word();

    #[inline(always)]
    fn multiply(&mut self, _: S, product: &AttentionProduct<Bf16Products>) {
        const { assert!(S::LANES == TILE) }
        let product = &product.operands;
        let mut first = 0;
        while first < product.vectors {
            let columns = columns_at_once(product, product.vectors - first);
            // SAFETY: `AttentionProduct::new` was promised that the operands exist, in whole steps.
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
                    steps: product.depth.div_ceil(<Self as Multiply<S, Bf16Products>>::KEYS),
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

/// How many of the `left` tiles of columns a unit takes at once: as many products in flight as its tiles of
/// sums allow.
fn columns_at_once(product: &Operands, left: usize) -> usize {
    match left {
        _ if product.rows <= TILE => left.div_ceil(left.div_ceil(MAX_COLUMN_TILES)),
        // Not 3 and 1: a single column waits for each of its products.
        3 | 5.. if product.b_vector == TILE => 3,
        _ => left.min(2),
    }
}

/// A product in registers.
struct InVectors<'a, A>(&'a AttentionProduct<A>);

impl<T: Stored> Kernel for InVectors<'_, Float32Products<T>> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        self.0.run(simd);
    }
}

impl Kernel for InVectors<'_, Bf16Products> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        self.0.run(simd);
    }
}

impl<A> AttentionProduct<A> {
    /// # Safety
    /// For as long as the product is used, with the multiplier that it is used with:
    /// - `factors` points to `rows` rows, `factors_stride` apart, of the factors of `depth` elements;
    /// - `b` points to `vectors` vectors of words, `b_vector` apart, for each step over `depth` elements,
    ///   `b_step` apart;
    /// - both are initialised to whole steps of [`Multiply::KEYS`] elements where tiles multiply, with zeros
    ///   beyond `depth`;
    /// - `out` points to `rows` rows, `out_stride` apart, of `vectors` vectors, which nothing else reads or
    ///   writes; they are initialised if `add` is set.
    pub(super) unsafe fn new(operands: Operands) -> Self {
        let arithmetic = PhantomData;
        Self { operands, arithmetic }
    }

    /// All of it, for at most `TILE_ROWS` rows.
    #[inline(always)]
    fn run<S: Simd>(&self, simd: S)
    where
        A: TileArithmetic<S>,
    {
        match self.operands.rows {
            1 => self.all::<S, 1>(simd),
            2 => self.all::<S, 2>(simd),
            3 => self.all::<S, 3>(simd),
            4 => self.all::<S, 4>(simd),
            5 if S::TILE_ROWS >= 5 => self.all::<S, 5>(simd),
            6 if S::TILE_ROWS >= 6 => self.all::<S, 6>(simd),
            7 if S::TILE_ROWS >= 7 => self.all::<S, 7>(simd),
            8 if S::TILE_ROWS >= 8 => self.all::<S, 8>(simd),
            rows => unreachable!("a tile of {rows} rows"),
        }
    }

    /// All columns of `MR` rows, a few at a time.
    #[inline(always)]
    fn all<S: Simd, const MR: usize>(&self, simd: S)
    where
        A: TileArithmetic<S>,
    {
        let vectors = self.operands.vectors;
        let groups = vectors.div_ceil(S::TILE_VECTORS);
        for group in 0..groups {
            let first = vectors * group / groups;
            let end = vectors * (group + 1) / groups;
            match end - first {
                1 => self.tile::<S, MR, 1>(simd, first),
                2 if S::TILE_VECTORS >= 2 => self.tile::<S, MR, 2>(simd, first),
                3 if S::TILE_VECTORS >= 3 => self.tile::<S, MR, 3>(simd, first),
                4 if S::TILE_VECTORS >= 4 => self.tile::<S, MR, 4>(simd, first),
                vectors => unreachable!("a tile of {vectors} vectors"),
            }
        }
    }

    /// The micro-kernel: `MR` rows by `NV` vectors from `first` on.
    #[inline(always)]
    fn tile<S: Simd, const MR: usize, const NV: usize>(&self, simd: S, first: usize)
    where
        A: TileArithmetic<S>,
    {
        let product = &self.operands;
        // SAFETY: `new` was promised that the rows, the vectors and the steps over `depth` exist.
        unsafe {
            let out = product.out.add(first * S::LANES).cast::<u32>();
            let mut sums = [[simd.splat(0.0); NV]; MR];
            if product.add {
                for (r, row) in sums.iter_mut().enumerate() {
                    for (v, sum) in row.iter_mut().enumerate() {
                        let at = out.add(r * product.out_stride + v * S::LANES);
                        *sum = simd.bits_to_f32(simd.load_words_ptr(at));
                    }
                }
            }
            let mut b = product.b.add(first * product.b_vector);
            let mut factors = product.factors.cast::<u32>();
            let mut steps = product.depth.div_ceil(A::STEP);
            if S::BY_LANE {
                for _ in 0..steps * A::FACTORS / 4 {
                    let mut rows = [A::operand(simd, simd.load_words_ptr(factors)); MR];
                    for (r, row) in rows.iter_mut().enumerate().skip(1) {
                        *row = A::operand(simd, simd.load_words_ptr(factors.add(r * product.factors_stride)));
                    }
                    self.lane::<S, MR, NV, 0>(simd, &mut sums, &rows, b);
                    self.lane::<S, MR, NV, 1>(simd, &mut sums, &rows, b);
                    self.lane::<S, MR, NV, 2>(simd, &mut sums, &rows, b);
                    self.lane::<S, MR, NV, 3>(simd, &mut sums, &rows, b);
                    b = b.wrapping_add(4 / A::FACTORS * product.b_step);
                    factors = factors.wrapping_add(4);
                }
                steps %= 4 / A::FACTORS;
            }
            for _ in 0..steps {
                for part in 0..A::FACTORS {
                    // AVX2 has sixteen registers. Words kept for the second part would take that of a sum, and a
                    // third more time than words that are read again.
                    let again = part > 0 && S::LANES < 16;
                    let b = if again { std::hint::black_box(b) } else { b };
                    let mut columns = [A::column(simd, simd.load_words_ptr(b), part); NV];
                    for (v, column) in columns.iter_mut().enumerate().skip(1) {
                        *column = A::column(simd, simd.load_words_ptr(b.add(v * product.b_vector)), part);
                    }
                    for (r, row) in sums.iter_mut().enumerate() {
                        let factor = A::broadcast(simd, *factors.add(r * product.factors_stride + part));
                        for (sum, &column) in row.iter_mut().zip(&columns) {
                            *sum = A::multiply_add(simd, factor, column, *sum);
                        }
                    }
                }
                b = b.wrapping_add(product.b_step);
                factors = factors.wrapping_add(A::FACTORS);
            }
            for (r, row) in sums.iter().enumerate() {
                for (v, sum) in row.iter().enumerate() {
                    simd.store_words_ptr(cast(*sum), out.add(r * product.out_stride + v * S::LANES));
                }
            }
        }
    }

    /// Adds the products of factor number `LANE` of four of each row and what it meets from `b` on.
    ///
    /// # Safety
    /// `b` points to the steps of these four factors.
    #[inline(always)]
    unsafe fn lane<S: Simd, const MR: usize, const NV: usize, const LANE: i32>(
        &self,
        simd: S,
        sums: &mut [[S::F32; NV]; MR],
        rows: &[A::Operand; MR],
        b: *const u32,
    ) where
        A: TileArithmetic<S>,
    {
        let (step, part) = (LANE as usize / A::FACTORS, LANE as usize % A::FACTORS);
        for v in 0..NV {
            // SAFETY: the step exists, and `new` was promised that the vectors do.
            let words = unsafe {
                simd.load_words_ptr(b.add(step * self.operands.b_step + v * self.operands.b_vector))
            };
            let column = A::column(simd, words, part);
            for (row, &factors) in sums.iter_mut().zip(rows) {
                row[v] = A::multiply_add_lane::<LANE>(simd, factors, column, row[v]);
            }
        }
    }

    /// Adds the product where values are not all finite: keys that the mask removes are passed over, because
    /// zero times infinity is not zero.
    #[inline(always)]
    pub(super) fn add_without_removed<S: Simd>(&self, simd: S, removed: &Removed<'_>)
    where
        A: TileArithmetic<S>,
    {
        let product = &self.operands;
        let words = product.depth.div_ceil(A::STEP) * A::FACTORS;
        for r in 0..product.rows {
            let query = removed.first_query + r;
            let bias = removed.mask.bias(removed.head, query, removed.len);
            let visible = removed.mask.visible(query, removed.len);
            // SAFETY: `new` was promised that each row has the factors of `depth` elements.
            let factors =
                unsafe { std::slice::from_raw_parts(product.factors.add(r * product.factors_stride), words) };
            for k in 0..product.depth.min(visible.saturating_sub(removed.first_key)) {
                if bias.is_some_and(|bias| bias[removed.first_key + k] == f32::NEG_INFINITY) {
                    continue;
                }
                let factor = simd.splat(A::element(factors, k));
                for v in 0..product.vectors {
                    // SAFETY: `new` was promised that the steps, the rows and the vectors exist, and the sums
                    // so far.
                    unsafe {
                        let words = product.b.add(k / A::STEP * product.b_step + v * product.b_vector);
                        let value = A::widen(simd, simd.load_words_ptr(words), k % A::STEP);
                        let at = product.out.add(r * product.out_stride + v * S::LANES).cast();
                        let sum = simd.bits_to_f32(simd.load_words_ptr(at));
                        simd.store_words_ptr(cast(simd.fma(factor, value, sum)), at);
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
