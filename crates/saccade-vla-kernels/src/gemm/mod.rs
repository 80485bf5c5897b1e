//! Products of rows with packed weights (GEMM), each by one instruction set and of one kind of elements: its
//! shape, how weights are packed and rows converted for it, and the micro-kernel.
//!
//! In BLIS's words: a micro-kernel multiplies `mr` rows by a panel of `nr` columns, whose sums stay in
//! registers. There are two for vectors, [`broadcast`] and, on ARM, [`neon`]; both are generic over a
//! [`Step`](step::Step). A third is for tile units, [`in_tiles`].

pub(crate) mod broadcast;
mod broadcast_steps;
mod convert;
pub(crate) mod elements;
#[cfg_attr(
    not(any(
        all(target_arch = "x86_64", not(saccade_portable)),
        feature = "software-tiles"
    )),
    allow(dead_code, reason = "no unit multiplies tiles there")
)]
pub(crate) mod in_tiles;
pub(crate) mod in_vectors;
mod name;
#[cfg(all(target_arch = "aarch64", not(saccade_portable)))]
pub(crate) mod neon;
mod nibbles;
pub(crate) mod outliers;
mod pack;
#[cfg_attr(
    not(any(
        all(target_arch = "x86_64", not(saccade_portable)),
        feature = "software-tiles"
    )),
    allow(dead_code, reason = "no unit multiplies tiles there")
)]
mod prefetch;
mod step;

use std::mem::MaybeUninit;
use std::ops::Range;

use crate::aligned::Zeroable;
use crate::parts::part_start;
use crate::rows::{Rows, RowsMut};
use crate::simd::LINE;
use crate::weights::{Element, WeightRef};
use outliers::{MultiplyOutliers, Outliers};

/// Sizes that rows and weights are split by.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shape {
    /// Output columns of a panel of weights (NR).
    pub nr: usize,
    /// Rows of the largest call of the micro-kernel (MR), a multiple of `row_group`.
    pub mr: usize,
    /// Rows that are converted together: calls of the micro-kernel begin at multiples of it.
    pub row_group: usize,
}

/// Output columns of the widest panel: three vectors of 16.
pub(crate) const MAX_NR: usize = 48;

/// Rows of the largest micro-kernel: two tiles of 16.
const MAX_MR: usize = 32;

/// Rows that go through a panel together, or a few more: their activations should stay in the second-level
/// cache while the panel streams past. 96 rows of 2048 are 768 kB, three quarters of a 1 MB cache.
pub(crate) const ROW_BLOCK: usize = 96;

/// Rows of the largest block of any product, that of tiles; or a few more.
pub(crate) const MAX_ROW_BLOCK: usize = 320;

/// Words of the sums of the largest block of rows and a panel.
pub(crate) const MAX_SUMS: usize = (MAX_ROW_BLOCK + MAX_MR) * MAX_NR;

/// Products that are summed from zero. One running float32 sum over the 8192 inputs of a feed-forward loses
/// five times as much as parts of 512 do (measured on the full head). Equal on all instruction sets, and so
/// are their bits.
const SUM_PART: usize = 512;

/// How a row was quantised: `x = scale * (byte - zero)`, with `zero` its zero point.
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
    /// What each column's sums are multiplied by, of int8 and int4; otherwise empty.
    pub scales: &'a mut [f32],
    /// The sum of each column's bytes, likewise.
    pub sums: &'a mut [i32],
}

/// Rows to convert, and memory for them.
pub(crate) struct Conversion<'a> {
    /// In whole groups, but for the last.
    pub x: Rows<'a>,
    /// A group in each row, [`Gemm::converted_stride`] words for each of its rows.
    pub words: RowsMut<'a, u32>,
    /// How each row was quantised, of int8 and int4.
    pub quantized: Option<RowsMut<'a, Quantized>>,
    /// The outliers of each row, if they are to be kept apart.
    pub outliers: Option<RowsMut<'a, Outliers>>,
}

/// How the rows of a call are dealt to calls of the micro-kernel: evenly and in whole groups, so that 49 are
/// 7 times 7, not 6 times 8 and one of 1.
#[derive(Clone, Copy)]
pub(crate) struct RowSplit {
    rows: usize,
    pub count: usize,
    row_group: usize,
}

impl RowSplit {
    pub(crate) fn new(rows: usize, shape: Shape) -> Self {
        Self {
            rows,
            count: rows.div_ceil(shape.mr),
            row_group: shape.row_group,
        }
    }

    /// The first row of call number `index`.
    #[inline(always)]
    pub(crate) fn first_row(&self, index: usize) -> usize {
        if self.row_group == 1 {
            return part_start(self.rows, index, self.count);
        }
        let groups = self.rows.div_ceil(self.row_group);
        self.rows
            .min(part_start(groups, index, self.count) * self.row_group)
    }

    /// The rows of some calls.
    #[inline(always)]
    pub(crate) fn rows(&self, calls: &Range<usize>) -> Range<usize> {
        self.first_row(calls.start)..self.first_row(calls.end)
    }
}

/// A block of rows, and the panel that multiplies it.
pub(crate) struct Block<'a> {
    /// The rows of the whole call, in whole groups: what [`Gemm::convert`] made, or the bits of float32 where
    /// rows are not converted.
    pub x: Rows<'a, u32>,
    pub in_features: usize,
    pub split: RowSplit,
    /// The calls of the micro-kernel for this block.
    pub calls: Range<usize>,
    /// The panel, as [`Gemm::pack`] made it.
    pub weights: &'a [u32],
    /// Columns of it whose sums must be written. The others may be left unwritten, and nobody reads them.
    pub needed: usize,
    /// How many panels further the one is that this thread will probably take next.
    pub ahead: usize,
    /// Whether to prefetch weights as many streams, rather than one line after the other.
    pub streams: bool,
    /// Where row 0 of the results of this panel will be written afterwards. Prefetched only, so any address
    /// will do.
    pub out: *const f32,
    /// Elements from one row of them to the next.
    pub out_stride: usize,
}

impl Block<'_> {
    /// Its rows, as rows of the call.
    #[inline(always)]
    pub(crate) fn rows(&self) -> Range<usize> {
        self.split.rows(&self.calls)
    }

    /// Where results of a row will be written from a column of the panel on.
    #[inline(always)]
    fn result(&self, row: usize, column: usize) -> *const u8 {
        self.out.wrapping_add(row * self.out_stride + column).cast::<u8>()
    }

    /// Checks what the micro-kernels rely on: the sizes of the panel, of `sums`, and of the rows.
    fn check(&self, shape: Shape, panel_words: usize, row_words: usize, sums: &[MaybeUninit<u32>]) {
        let rows = self.rows();
        let held = self.split.rows.next_multiple_of(shape.row_group);
        assert!(
            self.weights.len() == panel_words
                && sums.len() >= rows.len() * shape.nr
                && self.x.num_rows() >= held
                && self.x.num_columns() >= row_words
                && self.calls.end <= self.split.count,
            "a block of rows {rows:?} and {} words of weights",
            self.weights.len()
        );
    }
}

/// A product of rows with packed weights on one instruction set. [`PackedLinear`](crate::PackedLinear) splits
/// rows and panels, and makes results of the sums.
///
/// An implementation sums each element in an order that depends on nothing but `in_features`: neither on the
/// number of rows nor on where a row is. The sums are float32, and of int8 and int4 they are int32, of which
/// `scales[column] * quantized[row].scale * (sum - quantized[row].zero * sums[column])` is the product.
///
/// # Safety
/// [`Self::multiply`] and [`Self::multiply_and_finish`] write what they say: the sums are read afterwards.
/// [`Self::shape`] never changes, and `nr`, `mr` and [`Self::row_block`] are at most [`MAX_NR`], [`MAX_MR`]
/// and [`MAX_ROW_BLOCK`].
pub(crate) unsafe trait Gemm: PeakLoop + Send + Sync {
    /// The kernel for panels of these elements, if this CPU has the instructions. One of int8 takes int4, too.
    fn new(weights: Element) -> Option<Self>
    where
        Self: Sized;

    /// The kernel's name in reports: the instruction set and the elements, as in `avx512-vnni-int8`.
    fn name(&self) -> &'static str;

    fn shape(&self) -> Shape;

    /// Rows that go through a panel together, or a few more.
    fn row_block(&self, _in_features: usize) -> usize {
        ROW_BLOCK
    }

    /// Words of a panel.
    fn panel_words(&self, in_features: usize) -> usize;

    /// Writes the columns of a panel from `first` on, one for each row of `weight`.
    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>);

    /// Words from one converted row to the next; `None` if float32 rows are read where they are.
    fn converted_stride(&self, in_features: usize) -> Option<usize>;

    /// Converts rows, where [`Self::converted_stride`] is not `None`.
    fn convert(&self, conversion: Conversion<'_>);

    /// Writes the sums of a block of rows times a panel to rows of `nr` words, from the first row of the
    /// block on: those of [`Block::needed`] columns at least.
    fn multiply(&self, block: &Block<'_>, sums: &mut [MaybeUninit<u32>]);

    /// The same, and calls `finish` once for each row of the block, with all sums, when those of the row are
    /// complete.
    fn multiply_and_finish(&self, block: &Block<'_>, sums: &mut [MaybeUninit<u32>], finish: Finish<'_>) {
        self.multiply(block, sums);
        finish(block.rows(), sums);
    }

    /// Multiplies what was kept apart of rows by a panel of int8 or int4.
    fn multiply_outliers(&self, outliers: MultiplyOutliers<'_>);
}

/// What makes results of the sums of some rows of the call, within all sums of the block. It uses vectors,
/// never tiles.
pub(crate) type Finish<'a> = &'a dyn Fn(Range<usize>, &[MaybeUninit<u32>]);

/// The loop that measures what the instruction of a product can do at most.
#[cfg(feature = "peak")]
pub(crate) trait PeakLoop {
    /// Multiplies words in registers and the nearest cache for some milliseconds; returns how many
    /// multiply-accumulates that were.
    fn multiply_for_peak(&self) -> usize;
}

/// Nothing is measured.
#[cfg(not(feature = "peak"))]
pub(crate) trait PeakLoop {}
#[cfg(not(feature = "peak"))]
impl<T> PeakLoop for T {}

/// A product, where this CPU has the instructions.
pub(crate) fn available<G: Gemm + 'static>(weights: Element) -> Option<Box<dyn Gemm>> {
    Some(Box::new(G::new(weights)?))
}

/// Words of a converted row with `per_word` elements in a word: whole cache lines, an odd number of them.
/// Rows at multiples of a page would compete for the same few places in the cache.
fn odd_lines(in_features: usize, per_word: usize) -> usize {
    in_features.div_ceil(per_word).next_multiple_of(LINE) | LINE
}
