//! Products of rows with packed weights, each on one instruction set and in one arithmetic: its shape, its packing, its rows and its tile.

pub(crate) mod amx;
pub(crate) mod broadcast;
mod chains;
#[allow(
    dead_code,
    reason = "not every architecture has an instruction set with such products"
)]
pub(crate) mod dot_bf16;
pub(crate) mod dot_int8;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
pub(crate) mod outliers;
mod panel;
mod streams;
mod tile;

use std::ops::Range;

use crate::aligned::Zeroable;
use crate::parts::part_start;
use crate::simd::LINE;
use crate::weights::WeightRef;
use outliers::{MultiplyOutliers, Outliers};

/// What is multiplied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Product {
    /// float32 rows by float32 weights.
    Float32,
    /// float32 rows by bfloat16 weights, which are widened in registers.
    WidenedBf16,
    /// Rows rounded to bfloat16 by bfloat16 weights.
    Bf16,
    /// Rows quantised to unsigned bytes by int8 weights.
    Int8,
}

/// Sizes that rows and weights are split by.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shape {
    /// Output columns of a panel of weights, at most [`MAX_COLUMNS`].
    pub columns: usize,
    /// Rows of the largest tile, a multiple of `row_group`.
    pub tile_rows: usize,
    /// Rows that are converted together: tiles begin at multiples of it.
    pub row_group: usize,
    /// Rows beyond the last one that may be read, where rows are converted.
    pub rows_beyond: usize,
}

/// Output columns of the widest panel.
pub(crate) const MAX_COLUMNS: usize = 64;

/// Rows that go through a panel together, or a tile more: their activations should stay in the second-level cache while the panel streams
/// past. 96 rows of 2048 are 768 kB, three quarters of a 1 MB cache.
pub(crate) const ROW_BLOCK: usize = 96;

/// Rows of the largest block of any product, that of tiles; or a tile more.
pub(crate) const MAX_ROW_BLOCK: usize = 320;

/// Words of the sums of a block of rows and a panel: of 48 columns, where the block is the largest.
pub(crate) const MAX_SUMS: usize = (MAX_ROW_BLOCK + 32) * 48;

const _: () = assert!(MAX_SUMS >= (ROW_BLOCK + 32) * MAX_COLUMNS);

/// How a row was quantised: `x = scale * (byte - zero)`.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Quantized {
    pub scale: f32,
    pub zero: i32,
}

// SAFETY: zero bytes are two numbers that are zero.
unsafe impl Zeroable for Quantized {}

/// A panel of packed weights to write, zero at first.
pub(crate) struct PanelMut<'a> {
    /// [`Gemm::panel_words`] of them.
    pub words: &'a mut [u32],
    /// The scale of each column, for [`Product::Int8`]; otherwise empty.
    pub scales: &'a mut [f32],
    /// The sum of each column's int8 weights, likewise.
    pub sums: &'a mut [i32],
}

/// Rows to convert.
#[derive(Clone, Copy)]
pub(crate) struct Source {
    pub x: *const f32,
    /// Elements from one row to the next.
    pub x_stride: isize,
    pub in_features: usize,
    /// Where converted rows go, [`Gemm::converted_stride`] words from one to the next.
    pub words: *mut u32,
    /// How each row was quantised, for [`Product::Int8`].
    pub quantized: *mut Quantized,
    /// Where the outliers of each row go, if they are to be kept apart.
    pub outliers: Option<*mut Outliers>,
}

/// How the rows of a call are dealt to tiles: evenly and in whole groups, so that 49 are 7 tiles of 7, not 6 of 8 and one of 1.
#[derive(Clone, Copy)]
pub(crate) struct Tiles {
    pub rows: usize,
    pub count: usize,
    pub row_group: usize,
}

impl Tiles {
    pub(crate) fn new(rows: usize, shape: Shape) -> Self {
        Self {
            rows,
            count: rows.div_ceil(shape.tile_rows),
            row_group: shape.row_group,
        }
    }

    /// The first row of tile number `tile`.
    #[inline(always)]
    pub(crate) fn first_row(&self, tile: usize) -> usize {
        if self.row_group == 1 {
            return part_start(self.rows, tile, self.count);
        }
        let groups = self.rows.div_ceil(self.row_group);
        self.rows
            .min(part_start(groups, tile, self.count) * self.row_group)
    }
}

/// A block of rows, and the panel that multiplies it.
pub(crate) struct Block<'a> {
    /// All rows of the call: what [`Gemm::convert`] made, or float32 where rows are not converted.
    pub x: *const u32,
    /// Words from one row to the next.
    pub x_stride: isize,
    pub in_features: usize,
    pub tiles: Tiles,
    /// The tiles of the block.
    pub range: Range<usize>,
    /// The panel.
    pub weights: &'a [u32],
    /// Columns of it whose sums must be written. The others may be left unwritten, and nobody reads them.
    pub needed: usize,
    /// How many panels further the one is that this thread will probably take next.
    pub ahead: usize,
    /// Whether to ask memory for weights as many streams, rather than for one line after the other.
    pub streams: bool,
    /// Where the sums go: rows of [`Shape::columns`] words, from the first row of the block on.
    pub sums: *mut u32,
    /// Where row 0 of the results of this panel will be written afterwards.
    pub out: *const f32,
    /// Elements from one row of them to the next.
    pub out_stride: isize,
    /// Makes results of the needed sums of rows of the call. It uses vectors, never tiles.
    pub finish: &'a dyn Fn(Range<usize>),
}

impl Block<'_> {
    /// Its rows, as rows of the call.
    #[inline(always)]
    pub(crate) fn rows(&self) -> Range<usize> {
        self.tiles.first_row(self.range.start)..self.tiles.first_row(self.range.end)
    }
}

/// A product of rows with packed weights on one instruction set. [`PackedLinear`](crate::PackedLinear) splits rows and panels, and makes
/// results of the sums.
///
/// An implementation sums each element in an order that depends on nothing but `in_features`: neither on the number of rows nor on the tile
/// that a row is in. The sums are float32, and for [`Product::Int8`] int32, of which
/// `scales[column] * quantized[row].scale * (sum - quantized[row].zero * sums[column])` is the product.
///
/// # Safety
/// A value exists only on a CPU that has the instructions. [`Self::convert`] and [`Self::multiply`] do what their contracts say, and read and
/// write nothing else: `multiply` finishes no row whose sums are not complete. [`Self::shape`] never changes, and keeps to the bounds of [`Shape`] and [`MAX_SUMS`].
pub(crate) unsafe trait Gemm: Send + Sync {
    /// The proof that this CPU has the instructions.
    fn new() -> Option<Self>
    where
        Self: Sized;

    fn shape(&self) -> Shape;

    /// Rows that go through a panel together, or a tile more.
    fn row_block(&self, _in_features: usize) -> usize {
        ROW_BLOCK
    }

    /// Words of a panel.
    fn panel_words(&self, in_features: usize) -> usize;

    /// Writes the columns of a panel from `first` on, one for each row of `weight`.
    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>);

    /// Words from one converted row to the next; `None` if float32 rows are read where they are.
    fn converted_stride(&self, in_features: usize) -> Option<usize>;

    /// Converts the rows in `rows`, whole groups of them but for the last.
    ///
    /// # Safety
    /// [`Self::converted_stride`] is not `None`. The rows are in `source.x`; `source.words` has room for them in whole groups, and
    /// for [`Product::Int8`] `source.quantized` and, if they are given, `source.outliers`. No other thread reads or writes these places.
    unsafe fn convert(&self, source: &Source, rows: Range<usize>);

    /// Writes the sums of a block of rows times a panel, those of [`Block::needed`] columns at least, and calls [`Block::finish`] once for each
    /// of its rows, when these sums of the row are complete.
    ///
    /// # Safety
    /// The panel was packed by this product. `block.x` holds the rows of the block, for converted rows also [`Shape::rows_beyond`] more;
    /// `block.sums` has room for the block, whose rows are at most [`MAX_SUMS`] words. `block.out` is not dereferenced.
    unsafe fn multiply(&self, block: &Block<'_>);

    /// Multiplies what was kept apart of rows by a panel, for [`Product::Int8`].
    fn multiply_outliers(&self, _outliers: MultiplyOutliers<'_>) {
        unreachable!("nothing is kept apart of rows that are not quantised")
    }

    /// Runs independent chains of the instruction that products are made of, from registers, for some milliseconds. Returns how many
    /// multiply-accumulates that were.
    fn chains(&self) -> usize;
}

/// A product, where this CPU has the instructions.
pub(crate) fn available<G: Gemm + 'static>() -> Option<Box<dyn Gemm>> {
    Some(Box::new(G::new()?))
}

/// Words of a converted row with `per_word` elements in a word: whole cache lines, an odd number of them. Rows at multiples of a page would
/// compete for the same few places in the cache.
fn odd_lines(in_features: usize, per_word: usize) -> usize {
    in_features.div_ceil(per_word).next_multiple_of(LINE) | LINE
}
