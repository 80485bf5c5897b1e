//! Products in tiles: a unit that multiplies tiles of 16 rows and 16 words, in hardware (AMX) or in software,
//! and how products are dealt to it.
//!
//! What drives a unit is written once for both, so that all of it but the instructions themselves runs on
//! every machine.

#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
pub(crate) mod amx;
#[cfg(feature = "software-tiles")]
mod software;
#[cfg(test)]
mod tests;

use std::marker::PhantomData;
use std::mem::size_of;

use crate::simd::Simd;
#[cfg(feature = "software-tiles")]
pub(crate) use software::Software;

/// Rows of a tile, and words in a row of it.
pub(crate) const TILE: usize = 16;

/// Rows of a product at most: two tiles.
pub(crate) const MAX_ROWS: usize = 2 * TILE;

/// Tiles of columns of a product with one tile of rows at most: as many as there are tiles for sums.
pub(crate) const MAX_COLUMN_TILES: usize = 6;

/// What is multiplied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Operation {
    /// Pairs of bfloat16, summed in float32: TDPBF16PS.
    Bf16,
    /// Quads of unsigned and signed bytes, summed in int32: TDPBUSD.
    Int8,
}

impl Operation {
    /// Elements of a word.
    pub(crate) const fn per_word(self) -> usize {
        match self {
            Self::Bf16 => 2,
            Self::Int8 => 4,
        }
    }
}

/// What a product prefetches: after each product of tiles `lines` cache lines, `pitch` bytes apart, from `at`
/// on in the first step and from `advance` bytes further on in each later one. Any address will do.
#[derive(Clone, Copy)]
pub(crate) struct Ahead {
    pub at: *const u8,
    pub pitch: usize,
    pub advance: usize,
    pub lines: usize,
}

impl Ahead {
    pub(crate) const NOTHING: Self = Self {
        at: std::ptr::null(),
        pitch: 0,
        advance: 0,
        lines: 0,
    };
}

/// `sums (+)= x w`: rows of words by tiles of `w`.
#[derive(Clone, Copy)]
pub(crate) struct Product {
    pub operation: Operation,
    /// `1 ..= MAX_ROWS`.
    pub rows: usize,
    pub x: *const u32,
    /// Words from one row to the next, of each operand.
    pub x_stride: usize,
    /// Rows of 16 words: elements of the summed dimension below each other.
    pub w: *const u32,
    pub w_stride: usize,
    /// Words from a tile to the one of the next column.
    pub w_column: usize,
    /// Words from one step to the next.
    pub w_step: usize,
    /// Tiles next to each other in the sums: `1 ..= MAX_COLUMN_TILES` where there are at most [`TILE`] rows,
    /// else 1, 2, or 3 that are next to each other in `w` too. Always 3 of int8.
    pub columns: usize,
    /// Steps of [`TILE`] words over which is summed, at least one.
    pub steps: usize,
    pub sums: *mut u32,
    pub sums_stride: usize,
    /// Whether to add to what `sums` holds.
    pub add: bool,
    pub ahead: Ahead,
}

/// What a unit does at once: a [`Product`] with its rows dealt to one or two tiles, strides in bytes.
#[repr(C)]
pub(crate) struct Job {
    /// The first rows, and the second where there are two tiles of them.
    pub x: [*const u32; 2],
    pub x_stride: usize,
    pub w: *const u32,
    pub w_stride: usize,
    pub w_column: usize,
    pub w_step: usize,
    pub sums: [*mut u32; 2],
    pub sums_stride: usize,
    pub steps: usize,
    /// Zero if sums begin at zero.
    pub add: usize,
    pub ahead: *const u8,
    pub ahead_pitch: usize,
    pub ahead_advance: usize,
    pub ahead_lines: usize,
}

/// Tiles of rows and of columns of a [`Job`]: what units have kernels for; of int8 only those with three of
/// columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Shape {
    /// One by `1 ..= MAX_COLUMN_TILES`, anywhere.
    Row(usize),
    /// Two by one or two, anywhere.
    TwoRows(usize),
    /// Two by three, next to each other.
    Block,
}

/// The sizes of all tiles, as LDTILECFG reads them. Tiles 0 to 5 hold sums, 6 rows, 7 weights; with
/// [`Shape::TwoRows`], which has at most four tiles of sums, 5 holds the second rows.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug)]
pub(crate) struct Config {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    /// Bytes of a row.
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

const _: () = assert!(size_of::<Config>() == 64);

/// The tile of rows, and that of weights.
#[cfg(any(test, feature = "software-tiles"))]
const X: usize = 6;
const W: usize = 7;

impl Config {
    /// For tiles of so many rows, `1 ..= TILE`.
    pub(crate) fn of_rows(rows: usize) -> Self {
        assert!((1..=TILE).contains(&rows), "a tile of {rows} rows");
        let mut config = Self {
            palette: 1,
            start_row: 0,
            reserved: [0; 14],
            row_bytes: [0; 16],
            rows: [0; 16],
        };
        for tile in 0..=W {
            config.row_bytes[tile] = (size_of::<u32>() * TILE) as u16;
            config.rows[tile] = if tile == W { TILE as u8 } else { rows as u8 };
        }
        config
    }
}

/// A unit that multiplies tiles.
///
/// Each element of the sums is computed from its row of `x`, its column of `w` and what it was, in the same
/// order whatever the number of rows, columns and steps of a job.
///
/// # Safety
/// A value exists only where the instructions may be used. The methods read and write only what their
/// contracts name.
pub(crate) unsafe trait TileUnit: Copy + Send + Sync + 'static {
    /// Vectors of 16 lanes that work beside it. They quantise to whole bytes.
    type Simd: Simd;

    /// Where tiles are, if not in the CPU.
    type Registers;

    /// Its part of a kernel's name.
    const NAME: &'static str;

    /// The proof that it may be used.
    fn new() -> Option<Self>;

    /// Its vectors.
    fn simd(self) -> Self::Simd;

    /// Registers without sizes.
    fn registers(self) -> Self::Registers;

    /// Gives tiles their sizes.
    ///
    /// # Safety
    /// Nothing else on this thread uses tiles until [`Self::release`].
    unsafe fn configure(self, registers: &mut Self::Registers, config: &Config);

    /// Takes the sizes away, so that a switch of threads has no tiles to save.
    ///
    /// # Safety
    /// After [`Self::configure`].
    unsafe fn release(self, registers: &mut Self::Registers);

    /// Does a job.
    ///
    /// # Safety
    /// The tiles have their sizes; all pointers of `job` are valid for as many rows, for its steps and for
    /// the columns of `shape`.
    unsafe fn run(self, registers: &mut Self::Registers, operation: Operation, shape: Shape, job: &Job);

    /// Multiplies tiles in registers for some milliseconds; returns how many multiply-accumulates that were.
    #[cfg(feature = "peak")]
    fn multiply_for_peak(self, operation: Operation) -> usize;
}

/// Work that is written once for all units.
pub(crate) trait TileKernel {
    type Output;

    fn run<U: TileUnit>(&mut self, unit: U) -> Self::Output;
}

/// Tiles in use, until this is dropped.
pub(crate) struct Session<U: TileUnit> {
    unit: U,
    registers: U::Registers,
    /// Rows of the tiles; 0 before they have sizes.
    rows: usize,
    /// Of the thread that began it: tiles are a part of its state.
    of_thread: PhantomData<*const ()>,
}

impl<U: TileUnit> Session<U> {
    /// # Safety
    /// No other session is open on this thread.
    pub(crate) unsafe fn new(unit: U) -> Self {
        Self {
            unit,
            registers: unit.registers(),
            rows: 0,
            of_thread: PhantomData,
        }
    }

    /// Does `product`.
    ///
    /// More rows than a tile has are dealt to two tiles of equal size, which share a row if their number is
    /// odd: both compute and store the same sums of it. So no row is touched that is not there, and a tile
    /// costs what it has rows.
    ///
    /// # Safety
    /// All pointers are valid for what `product` names; rows of `sums` hold 16 words for each column.
    // Inlined, so that the job is written once: a product read back from memory by wider loads than it was
    // stored waits for all stores before it, tiles of sums among them (Intel with AMX: 8 % of attention).
    #[inline(always)]
    pub(crate) unsafe fn multiply(&mut self, product: &Product) {
        const WORD: usize = size_of::<u32>();
        let rows = product.rows;
        let (tile_rows, shape) = match (product.columns, rows) {
            (1..=MAX_COLUMN_TILES, 1..=TILE) => (rows, Shape::Row(product.columns)),
            (1..=2, ..=MAX_ROWS) => (rows.div_ceil(2), Shape::TwoRows(product.columns)),
            (3, ..=MAX_ROWS) if product.w_column == TILE => (rows.div_ceil(2), Shape::Block),
            (columns, rows) => unreachable!("{rows} rows by {columns} tiles"),
        };
        assert!(
            product.operation == Operation::Bf16 || product.columns == 3,
            "{} tiles of int8",
            product.columns
        );
        debug_assert!(product.steps > 0);
        let second = rows - tile_rows;
        let job = Job {
            x: [product.x, product.x.wrapping_add(second * product.x_stride)],
            x_stride: WORD * product.x_stride,
            w: product.w,
            w_stride: WORD * product.w_stride,
            w_column: WORD * product.w_column,
            w_step: WORD * product.w_step,
            sums: [
                product.sums,
                product.sums.wrapping_add(second * product.sums_stride),
            ],
            sums_stride: WORD * product.sums_stride,
            steps: product.steps,
            add: usize::from(product.add),
            ahead: product.ahead.at,
            ahead_pitch: product.ahead.pitch,
            ahead_advance: product.ahead.advance,
            ahead_lines: product.ahead.lines,
        };
        // SAFETY: the pointers are valid for the product; the tiles have the sizes of this job from here on.
        unsafe {
            if self.rows != tile_rows {
                self.unit
                    .configure(&mut self.registers, &Config::of_rows(tile_rows));
                self.rows = tile_rows;
            }
            self.unit.run(&mut self.registers, product.operation, shape, &job);
        }
    }
}

impl<U: TileUnit> Drop for Session<U> {
    fn drop(&mut self) {
        if self.rows > 0 {
            // SAFETY: the tiles have sizes.
            unsafe { self.unit.release(&mut self.registers) }
        }
    }
}
