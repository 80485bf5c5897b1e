//! One panel of a packed linear layer over a block of rows, tile by tile.

use faer::{MatMut, MatRef};

use super::{Epilogue, ROW_BLOCK};
use crate::activation::{gelu_tanh_vector, silu_vector};
use crate::isa::Isa;
use crate::simd::{Kernel, Vector};

/// Vectors of a panel's row, and rows of the largest tile: `ROWS x VECTORS` accumulators, `VECTORS` weights and one broadcast fit the registers.
const PORTABLE: (usize, usize) = (1, 4);
const AVX2: (usize, usize) = (2, 6);
const AVX512: (usize, usize) = (3, 8);

pub(super) const PORTABLE_COLUMNS: usize = 8 * PORTABLE.0;
pub(super) const AVX2_COLUMNS: usize = 8 * AVX2.0;
pub(super) const AVX512_COLUMNS: usize = 16 * AVX512.0;
const MAX_COLUMNS: usize = AVX512_COLUMNS;

/// The summed dimension is cut at multiples of this. A tile's sums over one part begin at zero and are added to those of the parts before:
/// one running float32 sum over the 8192 inputs of a feed-forward loses five times as much as parts of 512 do (measured on the
/// full head).
const SUM_PART: usize = 512;

/// Steps over the summed dimension after which the next tile takes the same block of the panel, which is then still in the cache: whole
/// parts. Each block begins the rows' streams anew; with two parts, together with huge pages for the weights, AVX2 went from 0.85 to 0.89
/// of the FMA peak at 49 x 1536 x 6144 on Zen 4, AVX-512 from 0.94 to 0.95.
const K_BLOCK: usize = 2 * SUM_PART;

/// Elements, of four bytes, in a cache line.
const LINE: usize = 16;

/// The activations and results of one call, as raw parts that tasks write to side by side.
pub(super) struct Job {
    x: *const f32,
    x_stride: isize,
    out: *mut f32,
    out_stride: isize,
    in_features: usize,
    epilogue: Epilogue,
}

// SAFETY: tasks read `x` and write disjoint parts of `out`: no two have a row block and a panel in common.
unsafe impl Sync for Job {}

impl Job {
    /// The views must outlive the job's use; `PackedLinear::apply` keeps them borrowed.
    pub(super) fn new(x: MatRef<'_, f32>, out: MatMut<'_, f32>, epilogue: Epilogue) -> Self {
        Self {
            x: x.as_ptr(),
            x_stride: x.row_stride(),
            in_features: x.ncols(),
            out_stride: out.row_stride(),
            out: out.as_ptr_mut(),
            epilogue,
        }
    }
}

/// A block of rows, at most [`ROW_BLOCK`].
#[derive(Clone, Copy)]
pub(super) struct Rows {
    pub first: usize,
    pub end: usize,
}

/// One panel and the columns of `out` that it makes.
pub(super) struct Panel<'a, E> {
    pub weights: &'a [E],
    pub bias: &'a [f32],
    pub first: usize,
    pub width: usize,
    /// How many panels further the one lies that should be on its way to the cache.
    pub ahead: usize,
}

/// An element of a panel: `STEP` consecutive `k` of one column.
pub(super) trait Stored: Copy {
    const STEP: usize;

    /// # Safety
    /// A vector of elements at `pointer`; the caller runs with `V`'s instruction set.
    unsafe fn widen<V: Vector>(pointer: *const Self, part: usize) -> V;
}

impl Stored for f32 {
    const STEP: usize = 1;

    #[inline(always)]
    unsafe fn widen<V: Vector>(pointer: *const Self, _: usize) -> V {
        // SAFETY: as promised by the caller.
        unsafe { V::load(pointer) }
    }
}

impl Stored for u32 {
    const STEP: usize = 2;

    #[inline(always)]
    unsafe fn widen<V: Vector>(pointer: *const Self, part: usize) -> V {
        // SAFETY: as promised by the caller.
        unsafe {
            if part == 0 {
                V::load_low_halves(pointer)
            } else {
                V::load_high_halves(pointer)
            }
        }
    }
}

/// Runs a block of rows through one panel: columns `first .. first + width` of `out`.
pub(super) struct PanelRun<'a, E> {
    pub job: &'a Job,
    pub rows: Rows,
    pub panel: Panel<'a, E>,
}

impl<E: Stored> Kernel for PanelRun<'_, E> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<V: Vector>(self) {
        let Self { job, rows, panel } = self;
        assert!(rows.end - rows.first <= ROW_BLOCK);
        // Widening takes registers: 8 rows of bf16 weights spill (0.77 of the FMA peak at 296 x 2048 x 1536), 7 do not (0.94).
        // SAFETY: the caller has the instruction set; the panel was packed for it, and the job's views cover rows and columns.
        unsafe {
            match V::ISA {
                Isa::Portable => panel_rows::<V, E, { PORTABLE.0 }>(job, rows, &panel, PORTABLE.1),
                Isa::Avx2 => panel_rows::<V, E, { AVX2.0 }>(job, rows, &panel, AVX2.1),
                Isa::Avx512 => panel_rows::<V, E, { AVX512.0 }>(job, rows, &panel, AVX512.1 + 1 - E::STEP),
            }
        }
    }
}

/// # Safety
/// The caller runs with `V`'s instruction set. `panel` holds `in_features` steps of `NV` vectors, `job` the rows and the panel's columns.
#[inline(always)]
unsafe fn panel_rows<V: Vector, E: Stored, const NV: usize>(
    job: &Job,
    rows: Rows,
    panel: &Panel<'_, E>,
    max_rows: usize,
) {
    let count = rows.end - rows.first;
    let tiles = count.div_ceil(max_rows);
    let steps = job.in_features.div_ceil(E::STEP);
    let block_steps = K_BLOCK / E::STEP;
    let blocks = steps.div_ceil(block_steps).max(1);
    let mut sums = Sums([const { std::mem::MaybeUninit::uninit() }; ROW_BLOCK * MAX_COLUMNS]);
    for block in 0..blocks {
        let part = Part {
            first: block * block_steps,
            end: steps.min((block + 1) * block_steps),
        };
        for tile in 0..tiles {
            // Rows are dealt evenly: 49 are 7 tiles of 7, not 6 of 8 and one of 1.
            let (first, end) = (count * tile / tiles, count * (tile + 1) / tiles);
            let place = Place {
                row: rows.first + first,
                sums: sums.0[first * NV * V::LANES..].as_mut_ptr().cast::<f32>(),
                tile,
                tiles,
            };
            // SAFETY: the caller's promise; the tile lies within the rows, and its sums within the block's.
            unsafe {
                match end - first {
                    1 => tile_part::<V, E, NV, 1>(job, panel, &part, &place),
                    2 => tile_part::<V, E, NV, 2>(job, panel, &part, &place),
                    3 => tile_part::<V, E, NV, 3>(job, panel, &part, &place),
                    4 => tile_part::<V, E, NV, 4>(job, panel, &part, &place),
                    5 => tile_part::<V, E, NV, 5>(job, panel, &part, &place),
                    6 => tile_part::<V, E, NV, 6>(job, panel, &part, &place),
                    7 => tile_part::<V, E, NV, 7>(job, panel, &part, &place),
                    8 => tile_part::<V, E, NV, 8>(job, panel, &part, &place),
                    _ => unreachable!("a tile has 1 to 8 rows"),
                }
            }
        }
    }
}

#[repr(align(64))]
struct Sums([std::mem::MaybeUninit<f32>; ROW_BLOCK * MAX_COLUMNS]);

/// A part of the steps over `k`.
struct Part {
    first: usize,
    end: usize,
}

/// Where a tile begins: its first row, and its unfinished sums.
struct Place {
    row: usize,
    sums: *mut f32,
    tile: usize,
    tiles: usize,
}

/// `MR` rows by `NV` vectors over one part of `k`.
///
/// # Safety
/// As [`panel_rows`]; rows `place.row .. place.row + MR` are in the job, and `place.sums` has room for the tile.
#[inline(always)]
unsafe fn tile_part<V: Vector, E: Stored, const NV: usize, const MR: usize>(
    job: &Job,
    panel: &Panel<'_, E>,
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
        let steps = job.in_features.div_ceil(E::STEP);
        let mut first = part.first;
        loop {
            let end = part.end.min(first + SUM_PART / E::STEP);
            let mut acc = [[V::splat(0.0); NV]; MR];
            // An odd `in_features` leaves the last step of a two-element panel half filled: `x` ends there.
            let whole = end.min(job.in_features / E::STEP);
            // Few rows leave little time: a step's share is then longer than a cache line. The loops are apart because one register more
            // for the general case makes the common one spill.
            if place.tiles < NV {
                for step in first..whole {
                    for line in 0..NV {
                        V::prefetch(next.wrapping_add(step * stride + line * LINE).cast());
                    }
                    multiply_add::<V, E, NV, MR>(
                        &mut acc,
                        &x,
                        weights.add(step * row_elements),
                        step * E::STEP,
                        E::STEP,
                    );
                }
            } else {
                for step in first..whole {
                    V::prefetch(next.wrapping_add(step * stride).cast());
                    multiply_add::<V, E, NV, MR>(
                        &mut acc,
                        &x,
                        weights.add(step * row_elements),
                        step * E::STEP,
                        E::STEP,
                    );
                }
            }
            if whole < end {
                multiply_add::<V, E, NV, MR>(
                    &mut acc,
                    &x,
                    weights.add(whole * row_elements),
                    whole * E::STEP,
                    1,
                );
            }
            if first != 0 {
                for (r, row) in acc.iter_mut().enumerate() {
                    for (v, sum) in row.iter_mut().enumerate() {
                        *sum = V::load(place.sums.add((r * NV + v) * V::LANES)).add(*sum);
                    }
                }
            }
            if end == steps {
                for (r, sums) in acc.iter().enumerate() {
                    finish(job, panel, place.row + r, sums);
                }
            } else {
                for (r, row) in acc.iter().enumerate() {
                    for (v, sum) in row.iter().enumerate() {
                        sum.store(place.sums.add((r * NV + v) * V::LANES));
                    }
                }
            }
            first = end;
            if first >= part.end {
                return;
            }
        }
    }
}

/// `acc += x[k .. k + count]` times the weights of one step.
///
/// # Safety
/// `weights` are `NV` vectors, `x` has `k + count` elements in each row; the caller runs with `V`'s instruction set.
#[inline(always)]
unsafe fn multiply_add<V: Vector, E: Stored, const NV: usize, const MR: usize>(
    acc: &mut [[V; NV]; MR],
    x: &[*const f32; MR],
    weights: *const E,
    k: usize,
    count: usize,
) {
    for part in 0..count {
        // SAFETY: the caller's promise.
        unsafe {
            // Loops, not closures: a closure is a function without `V`'s features until it is inlined.
            let mut w = [V::splat(0.0); NV];
            for (v, w) in w.iter_mut().enumerate() {
                *w = E::widen(weights.add(v * V::LANES), part);
            }
            for r in 0..MR {
                let x = V::splat(*x[r].add(k + part));
                for v in 0..NV {
                    acc[r][v] = x.fma(w[v], acc[r][v]);
                }
            }
        }
    }
}

/// Bias, activation and residual of one row of a tile, and its way to `out`.
///
/// # Safety
/// The caller runs with `V`'s instruction set; `row` and the panel's columns are in the job.
#[inline(always)]
unsafe fn finish<V: Vector, E: Stored, const NV: usize>(
    job: &Job,
    panel: &Panel<'_, E>,
    row: usize,
    sums: &[V; NV],
) {
    // SAFETY: the caller's promise; partial vectors stay within the panel's columns.
    unsafe {
        let out = job.out.offset(row as isize * job.out_stride).add(panel.first);
        for (v, &sum) in sums.iter().enumerate() {
            let column = v * V::LANES;
            if column >= panel.width {
                break;
            }
            let lanes = V::LANES.min(panel.width - column);
            let out = out.add(column);
            let value = sum.add(V::load(panel.bias.as_ptr().add(column)));
            let value = match job.epilogue {
                Epilogue::Store => value,
                Epilogue::GeluTanh => gelu_tanh_vector(value),
                // The second operand where they do not compare: NaN stays.
                Epilogue::Relu => V::splat(0.0).max(value),
                Epilogue::Silu => silu_vector(value),
                Epilogue::Add if lanes == V::LANES => V::load(out).add(value),
                Epilogue::Add => V::load_partial(out, lanes).add(value),
            };
            if lanes == V::LANES {
                value.store(out)
            } else {
                value.store_partial(out, lanes)
            }
        }
    }
}
