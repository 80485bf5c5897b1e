//! One panel of a packed linear layer over a block of rows, tile by tile.

use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::ops::Range;

use super::Epilogue;
use super::product::{Bf16Pairs, F32, Int8Quads, Product, WidenedBf16, With};
use super::rows::Quantized;
use crate::activation::{gelu_tanh_vector, silu_vector};
use crate::isa::Isa;
use crate::simd::{Dot, DotKernel, Dots, Kernel, Vector, lanes, load, store};

/// Vectors of a panel's row, and rows of the largest tile: `ROWS x VECTORS` accumulators, `VECTORS` weights and one broadcast fit the registers.
const PORTABLE: (usize, usize) = (1, 4);
const AVX2: (usize, usize) = (2, 6);
const AVX512: (usize, usize) = (3, 8);

const MAX_COLUMNS: usize = 16 * AVX512.0;

/// Rows that go through a panel together: their activations should stay in the second-level cache while the panel streams past. 96 rows
/// of 2048 are 768 kB, three quarters of a 1 MB cache.
pub(super) const ROW_BLOCK: usize = 96;

/// Blocks are whole tiles, so that one may be larger.
const MAX_ROWS: usize = ROW_BLOCK + AVX512.1;

/// Output columns of a panel, and rows of the largest tile, where bf16 weights are widened or not.
pub(super) fn shape(isa: Isa, widens: bool) -> (usize, usize) {
    let (vectors, rows) = match isa {
        Isa::Portable => PORTABLE,
        Isa::Avx2 | Isa::Avx2Vnni => AVX2,
        Isa::Avx512f | Isa::Avx512 => AVX512,
    };
    // Widening takes registers: one row less does not spill. Shares of the FMA peak at 296 x 2048 x 1536 on Zen 4: 8 and 7 rows of AVX-512
    // 0.77 and 0.97, 6 and 5 rows of AVX2 0.70 and 0.88.
    (vectors * lanes(isa), rows - usize::from(widens))
}

/// Steps over the summed dimension after which the next tile takes the same block of the panel, which is then still in the cache: whole
/// parts. Each block begins the rows' streams anew; with two parts of float32, together with huge pages for the weights, AVX2 went from 0.85
/// to 0.89 of the FMA peak at 49 x 1536 x 6144 on Zen 4, AVX-512 from 0.94 to 0.95.
const BLOCK_STEPS: usize = 1024;

/// Elements, of four bytes, in a cache line.
const LINE: usize = 16;

/// The activations and results of one call, as raw parts that tasks write to side by side.
pub(super) struct Job<'a> {
    /// Rows of 4-byte words: float32, pairs of bf16 or quads of bytes, as the product reads them.
    pub x: *const u32,
    /// In words.
    pub x_stride: isize,
    pub tiles: Tiles,
    pub in_features: usize,
    /// How each row was quantised, for int8.
    pub quantized: &'a [Quantized],
    pub out: *mut f32,
    pub out_stride: isize,
    pub epilogue: Epilogue,
}

// SAFETY: tasks read `x` and write disjoint parts of `out`: no two have a row block and a panel in common.
unsafe impl Sync for Job<'_> {}

/// How the rows of a call are dealt: evenly, so that 49 are 7 tiles of 7, not 6 of 8 and one of 1.
#[derive(Clone, Copy)]
pub(super) struct Tiles {
    pub rows: usize,
    pub count: usize,
}

impl Tiles {
    /// The first row of tile number `tile`.
    pub(super) fn first_row(&self, tile: usize) -> usize {
        self.rows * tile / self.count
    }
}

/// Tiles `first .. end`, of at most [`MAX_ROWS`] rows together.
#[derive(Clone, Copy)]
pub(super) struct Block {
    pub first: usize,
    pub end: usize,
}

/// One panel and the columns of `out` that it makes.
pub(super) struct Panel<'a> {
    pub weights: &'a [u32],
    pub bias: &'a [f32],
    /// Of each column, for int8: what one step of its weights is worth, and their sum.
    pub scales: &'a [f32],
    pub sums: &'a [i32],
    pub first: usize,
    pub width: usize,
    /// How many panels further the one lies that should be on its way to the cache.
    pub ahead: usize,
}

/// Runs a block of rows through one panel: columns `first .. first + width` of `out`.
pub(super) struct PanelRun<'a, P> {
    pub job: &'a Job<'a>,
    pub block: Block,
    pub panel: Panel<'a>,
    product: PhantomData<P>,
}

impl<'a, P> PanelRun<'a, P> {
    pub(super) fn new(job: &'a Job<'a>, block: Block, panel: Panel<'a>) -> Self {
        Self {
            job,
            block,
            panel,
            product: PhantomData,
        }
    }

    /// # Safety
    /// The caller runs with `V`'s instruction set and what `Q` needs; the panel was packed for `Q`.
    #[inline(always)]
    unsafe fn all<V: Vector, Q: Product<V>>(self) {
        let Self {
            job, block, panel, ..
        } = self;
        // SAFETY: the caller's promise; the job's views cover rows and columns.
        unsafe {
            match V::REGISTERS {
                8 => panel_rows::<V, Q, { PORTABLE.0 }>(job, block, &panel),
                16 => panel_rows::<V, Q, { AVX2.0 }>(job, block, &panel),
                _ => panel_rows::<V, Q, { AVX512.0 }>(job, block, &panel),
            }
        }
    }
}

impl Kernel for PanelRun<'_, F32> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<V: Vector>(self) {
        // SAFETY: the caller's promise.
        unsafe { self.all::<V, F32>() }
    }
}

impl Kernel for PanelRun<'_, WidenedBf16> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<V: Vector>(self) {
        // SAFETY: the caller's promise.
        unsafe { self.all::<V, WidenedBf16>() }
    }
}

impl DotKernel for PanelRun<'_, Bf16Pairs> {
    type Output = ();
    const DOT: Dot = Dot::Bf16;

    #[inline(always)]
    unsafe fn run<V: Vector, D: Dots<V>>(self) {
        // Elsewhere the layer widens: rows that are float32 already need no widening.
        if D::HAS_BF16 {
            // SAFETY: the caller's promise.
            unsafe { self.all::<V, With<Bf16Pairs, D>>() }
        } else {
            unreachable!("only where there is a product of bf16")
        }
    }
}

impl DotKernel for PanelRun<'_, Int8Quads> {
    type Output = ();
    const DOT: Dot = Dot::Int8;

    #[inline(always)]
    unsafe fn run<V: Vector, D: Dots<V>>(self) {
        // SAFETY: the caller's promise.
        unsafe { self.all::<V, With<Int8Quads, D>>() }
    }
}

/// # Safety
/// The caller runs with `V`'s instruction set. `panel` holds `in_features` steps of `NV` vectors, `job` the rows and the panel's columns.
#[inline(always)]
unsafe fn panel_rows<V: Vector, P: Product<V>, const NV: usize>(
    job: &Job<'_>,
    tiles: Block,
    panel: &Panel<'_>,
) {
    let first_row = job.tiles.first_row(tiles.first);
    let rows = first_row..job.tiles.first_row(tiles.end);
    assert!(rows.len() <= MAX_ROWS);
    let steps = job.in_features.div_ceil(P::STEP);
    let blocks = steps.div_ceil(BLOCK_STEPS).max(1);
    let mut sums = Sums([const { MaybeUninit::uninit() }; MAX_ROWS * MAX_COLUMNS]);
    for block in 0..blocks {
        let part = Part {
            first: block * BLOCK_STEPS,
            end: steps.min((block + 1) * BLOCK_STEPS),
        };
        for tile in tiles.first..tiles.end {
            let (first, end) = (job.tiles.first_row(tile), job.tiles.first_row(tile + 1));
            let place = Place {
                row: first,
                sums: sums.0[(first - first_row) * NV * V::LANES..]
                    .as_mut_ptr()
                    .cast::<u32>(),
                tile: tile - tiles.first,
                tiles: tiles.end - tiles.first,
            };
            // SAFETY: the caller's promise; the tile lies within the rows, and its sums within the block's.
            unsafe {
                match end - first {
                    1 => tile_part::<V, P, NV, 1>(job, panel, &part, &place),
                    2 => tile_part::<V, P, NV, 2>(job, panel, &part, &place),
                    3 => tile_part::<V, P, NV, 3>(job, panel, &part, &place),
                    4 => tile_part::<V, P, NV, 4>(job, panel, &part, &place),
                    // Only where there are registers for them.
                    5 if V::REGISTERS > 8 => tile_part::<V, P, NV, 5>(job, panel, &part, &place),
                    6 if V::REGISTERS > 8 => tile_part::<V, P, NV, 6>(job, panel, &part, &place),
                    7 if V::REGISTERS > 16 => tile_part::<V, P, NV, 7>(job, panel, &part, &place),
                    8 if V::REGISTERS > 16 => tile_part::<V, P, NV, 8>(job, panel, &part, &place),
                    rows => unreachable!("a tile of {rows} rows"),
                }
            }
        }
    }
    let sums = sums.0.as_ptr().cast::<u32>();
    // SAFETY: the caller's promise; all tiles have stored their sums.
    unsafe {
        match job.epilogue {
            Epilogue::Store => finish::<V, P, Store, NV>(job, rows, panel, sums),
            Epilogue::GeluTanh => finish::<V, P, GeluTanh, NV>(job, rows, panel, sums),
            Epilogue::Relu => finish::<V, P, Relu, NV>(job, rows, panel, sums),
            Epilogue::Silu => finish::<V, P, Silu, NV>(job, rows, panel, sums),
            Epilogue::Add => finish::<V, P, Add, NV>(job, rows, panel, sums),
        }
    }
}

#[repr(align(64))]
struct Sums([MaybeUninit<u32>; MAX_ROWS * MAX_COLUMNS]);

/// A part of the steps over `k`.
struct Part {
    first: usize,
    end: usize,
}

/// Where a tile begins: its first row, and its unfinished sums.
struct Place {
    row: usize,
    sums: *mut u32,
    tile: usize,
    tiles: usize,
}

/// `MR` rows by `NV` vectors over one part of `k`.
///
/// # Safety
/// As [`panel_rows`]; rows `place.row .. place.row + MR` are in the job, and `place.sums` has room for the tile.
#[inline(always)]
unsafe fn tile_part<V: Vector, P: Product<V>, const NV: usize, const MR: usize>(
    job: &Job<'_>,
    panel: &Panel<'_>,
    part: &Part,
    place: &Place,
) {
    // SAFETY: the caller's promise for all pointers below; prefetching is allowed at any address.
    unsafe {
        let row_elements = NV * V::LANES;
        let mut x = [job.x; MR];
        for (r, x) in x.iter_mut().enumerate() {
            *x = job.x.offset((place.row + r) as isize * job.x_stride);
        }
        let weights = panel.weights.as_ptr();
        // Each tile asks for its share of a later panel, spread over its steps: memory then works while the sums are made.
        // Measured at 49 x 1536 x 6144 on Zen 4, share of the FMA peak without and with it: 0.89 and 0.95 (AVX-512), 0.69 and 0.85 (AVX2).
        let next = weights
            .wrapping_add(panel.ahead * panel.weights.len() + panel.weights.len() * place.tile / place.tiles);
        let stride = row_elements.div_ceil(place.tiles);
        if part.first == 0 {
            // The rows of `out` are written after the tiles: by then they are here.
            for r in 0..MR {
                let out = job.out.offset((place.row + r) as isize * job.out_stride);
                for v in 0..NV {
                    V::prefetch(out.wrapping_add(panel.first + v * V::LANES).cast());
                }
            }
        }
        let mut first = part.first;
        loop {
            let end = part.end.min(first + P::PART_STEPS);
            let mut acc = [[P::zero(); NV]; MR];
            // Rows that are read where they lie may end within the last step.
            let whole = end.min(job.in_features / P::STEP);
            // Few rows leave little time: a step's share is then longer than a cache line. The loops are apart because one register more
            // for the general case makes the common one spill.
            if place.tiles < NV {
                for step in first..whole {
                    for line in 0..NV {
                        V::prefetch(next.wrapping_add(step * stride + line * LINE).cast());
                    }
                    P::multiply_add(&mut acc, &x, weights.add(step * row_elements), step, P::STEP);
                }
            } else {
                for step in first..whole {
                    V::prefetch(next.wrapping_add(step * stride).cast());
                    P::multiply_add(&mut acc, &x, weights.add(step * row_elements), step, P::STEP);
                }
            }
            if whole < end {
                let rest = job.in_features - whole * P::STEP;
                P::multiply_add(&mut acc, &x, weights.add(whole * row_elements), whole, rest);
            }
            if first != 0 {
                for (r, row) in acc.iter_mut().enumerate() {
                    for (v, sum) in row.iter_mut().enumerate() {
                        *sum = P::add(P::load(place.sums.add((r * NV + v) * V::LANES)), *sum);
                    }
                }
            }
            for (r, row) in acc.iter().enumerate() {
                for (v, sum) in row.iter().enumerate() {
                    P::store(*sum, place.sums.add((r * NV + v) * V::LANES));
                }
            }
            first = end;
            if first >= part.end {
                return;
            }
        }
    }
}

/// What an [`Epilogue`] makes of a vector of sums with their bias.
trait Finish {
    /// # Safety
    /// The caller runs with `V`'s instruction set; `out` points to `lanes` elements.
    unsafe fn of<V: Vector>(value: V, out: *const f32, lanes: usize) -> V;
}

struct Store;
struct GeluTanh;
struct Relu;
struct Silu;
struct Add;

impl Finish for Store {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, _: *const f32, _: usize) -> V {
        value
    }
}

impl Finish for GeluTanh {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, _: *const f32, _: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { gelu_tanh_vector(value) }
    }
}

impl Finish for Relu {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, _: *const f32, _: usize) -> V {
        // SAFETY: the caller's promise. The second operand where they do not compare: NaN stays.
        unsafe { V::splat(0.0).max(value) }
    }
}

impl Finish for Silu {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, _: *const f32, _: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { silu_vector(value) }
    }
}

impl Finish for Add {
    #[inline(always)]
    unsafe fn of<V: Vector>(value: V, out: *const f32, lanes: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { load::<V>(out, lanes).add(value) }
    }
}

/// Bias, activation and residual of a block of rows, and their way to `out`. After the tiles and not in them: a sum's way through the
/// first-level cache is nothing beside its making, and the code is there once, not in each tile.
///
/// # Safety
/// The caller runs with `V`'s instruction set; `rows` and the panel's columns are in the job, `sums` holds `NV` vectors for each row.
#[inline(always)]
unsafe fn finish<V: Vector, P: Product<V>, F: Finish, const NV: usize>(
    job: &Job<'_>,
    rows: Range<usize>,
    panel: &Panel<'_>,
    sums: *const u32,
) {
    for vector in 0..panel.width.div_ceil(V::LANES) {
        let column = vector * V::LANES;
        let lanes = V::LANES.min(panel.width - column);
        // SAFETY: the caller's promise; partial vectors stay within the panel's columns.
        unsafe {
            let bias = V::load(panel.bias.as_ptr().add(column));
            let columns = P::columns(panel, column);
            let mut out = job
                .out
                .offset(rows.start as isize * job.out_stride)
                .add(panel.first + column);
            let mut sums = sums.add(column);
            for row in rows.clone() {
                let value = P::value(P::load(sums), columns, job.quantized, row).add(bias);
                store(F::of(value, out, lanes), out, lanes);
                out = out.wrapping_offset(job.out_stride);
                sums = sums.add(NV * V::LANES);
            }
        }
    }
}
