//! Products in tiles, of bfloat16 in pairs and of bytes in quads: what AMX multiplies, and its emulation in
//! software.

use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::ops::Range;

use super::convert::Convert;
use super::elements::{Elements, RowElements};
use super::name::{Joined, join};
use super::nibbles::{NAME_INT4, Unpack, has_nibbles};
use super::outliers::MultiplyOutliers;
use super::prefetch::Parts;
use super::{
    Block, Conversion, Finish, Gemm, MAX_MR, MAX_NR, MAX_ROW_BLOCK, PanelMut, ROW_BLOCK, Shape, pack,
};
use crate::simd::Simd;
use crate::simd::bits::cast_slice_mut;
use crate::tiles::{Ahead, MAX_ROWS, Operation, Product, Session, TILE, TileUnit};
use crate::weights::{Element, WeightRef};

/// Columns of a panel: three tiles, because six tiles of sums, one of rows and one of weights are all that
/// there are.
const COLUMNS: usize = 3 * TILE;

const _: () = assert!(COLUMNS <= MAX_NR && MAX_ROWS <= MAX_MR);

/// Words of weights that one step multiplies.
const STEP_WORDS: usize = TILE * COLUMNS;

/// Steps of a part of a panel at most: 192 kB, and in as many steps a line of each of 48 streams of 4 kB.
/// Parts of 4 to 12 steps, which the nearest cache holds while all rows pass, are slower: `encode` of N1.5 takes
/// 1.08 to 1.12 (int8) and 1.06 to 1.16 (bfloat16) of the time with 64 (Emerald Rapids, 2 threads, the fastest of
/// 5 interleaved rounds on a shared machine), probably since sums go to memory and back more often.
const PART_STEPS: usize = 64;

/// Bytes of the rows that go through a panel together at most. Products in tiles are so fast that weights
/// come from memory no faster than they are used: as many rows as fit into the second-level cache beside the
/// panel, 2 MB where there is AMX.
const ROW_BYTES: usize = 5 << 18;

/// Products of `E` in the tiles of `U`. A panel is what those of vectors are, `[k / elements of a
/// word][column]`, in whole steps of 16 words.
pub(crate) struct InTiles<U, E> {
    unit: U,
    /// Whether panels are of int4.
    has_nibbles: bool,
    elements: PhantomData<E>,
}

impl<U: TileUnit, E: Elements> InTiles<U, E> {
    const JOINED: Joined = join(U::NAME, "", E::NAME);
    const NAME: &'static str = Joined::as_str(&Self::JOINED);
    const JOINED_INT4: Joined = join(U::NAME, "", NAME_INT4);
    const NAME_INT4: &'static str = Joined::as_str(&Self::JOINED_INT4);
    const OPERATION: Operation = match E::WEIGHTS {
        Element::Bf16 => Operation::Bf16,
        Element::Int8 => Operation::Int8,
        Element::F32 | Element::Int4 => panic!("no tiles multiply them"),
    };

    /// Steps over which is summed.
    fn steps(in_features: usize) -> usize {
        in_features.div_ceil(TILE * E::PER_WORD)
    }

    /// Words of a panel for a step.
    fn panel_step(&self) -> usize {
        if self.has_nibbles {
            STEP_WORDS / 2
        } else {
            STEP_WORDS
        }
    }

    /// Prefetches where the results of some rows go: by the time that their sums are made, they are here.
    #[inline(always)]
    fn prefetch_results(&self, block: &Block<'_>, rows: Range<usize>) {
        for row in rows {
            for tile in 0..COLUMNS / TILE {
                self.unit.simd().prefetch(block.result(row, tile * TILE));
            }
        }
    }
}

// SAFETY: all steps write or add to the sums of all rows and columns, the first of them writes; the sizes are
// constant.
unsafe impl<U: TileUnit, E: Elements> Gemm for InTiles<U, E> {
    fn new(weights: Element) -> Option<Self> {
        let has_nibbles = has_nibbles::<E>(weights);
        U::new().map(|unit| Self {
            unit,
            has_nibbles,
            elements: PhantomData,
        })
    }

    fn name(&self) -> &'static str {
        if self.has_nibbles {
            Self::NAME_INT4
        } else {
            Self::NAME
        }
    }

    fn shape(&self) -> Shape {
        Shape {
            nr: COLUMNS,
            mr: MAX_ROWS,
            row_group: 1,
        }
    }

    fn row_block(&self, in_features: usize) -> usize {
        let row_bytes = size_of::<u32>() * TILE * Self::steps(in_features).max(1);
        (ROW_BYTES / row_bytes).clamp(ROW_BLOCK, MAX_ROW_BLOCK)
    }

    fn panel_words(&self, in_features: usize) -> usize {
        self.panel_step() * Self::steps(in_features)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        pack::pack::<E>(weight, first, COLUMNS, self.has_nibbles, panel);
    }

    fn converted_stride(&self, in_features: usize) -> Option<usize> {
        E::converted_stride(in_features)
    }

    fn convert(&self, mut conversion: Conversion<'_>) {
        if E::ROWS == RowElements::Bf16 {
            // Up to whole tiles: what may be NaN would make NaN of the zeros that it is multiplied by. Of
            // bytes any may follow.
            let width = conversion.x.num_columns();
            for row in conversion.words.iter_mut() {
                let row: &mut [u16] = cast_slice_mut(row);
                row[width..width.next_multiple_of(2 * TILE)].fill(0);
            }
        }
        self.unit.simd().run(&mut Convert::<E>::new(conversion));
    }

    fn multiply(&self, block: &Block<'_>, sums: &mut [MaybeUninit<u32>]) {
        self.multiply_and_finish(block, sums, &|_, _| ());
    }

    fn multiply_and_finish(&self, block: &Block<'_>, sums: &mut [MaybeUninit<u32>], finish: Finish<'_>) {
        let steps = Self::steps(block.in_features);
        block.check(self.shape(), self.panel_step() * steps, TILE * steps, sums);
        if steps == 0 {
            sums[..block.rows().len() * COLUMNS].fill(MaybeUninit::new(0));
            return finish(block.rows(), sums);
        }
        if self.has_nibbles {
            self.multiply_unpacked(block, steps, sums, finish);
        } else {
            self.multiply_parts(block, steps, None, sums, finish);
        }
    }

    fn multiply_outliers(&self, mut outliers: MultiplyOutliers<'_>) {
        outliers.has_nibbles = self.has_nibbles;
        self.unit.simd().run(&mut outliers);
    }
}

/// The weights of a part, in the second-level cache, from which a call takes them as it takes those that are not
/// unpacked.
#[repr(align(64))]
struct Unpacked([MaybeUninit<u32>; STEP_WORDS * PART_STEPS]);

impl<U: TileUnit, E: Elements> InTiles<U, E> {
    /// Multiplies panels of nibbles. Apart, because the stack is touched wherever a function has so much of it.
    #[inline(never)]
    fn multiply_unpacked(
        &self,
        block: &Block<'_>,
        steps: usize,
        sums: &mut [MaybeUninit<u32>],
        finish: Finish<'_>,
    ) {
        let mut unpacked = Unpacked([const { MaybeUninit::uninit() }; STEP_WORDS * PART_STEPS]);
        self.multiply_parts(block, steps, Some(&mut unpacked), sums, finish);
    }

    /// The sums of `steps`, of weights that are unpacked if there is room for them.
    #[inline(never)]
    fn multiply_parts(
        &self,
        block: &Block<'_>,
        steps: usize,
        mut unpacked: Option<&mut Unpacked>,
        sums: &mut [MaybeUninit<u32>],
        finish: Finish<'_>,
    ) {
        let first_row = block.rows().start;
        let panel_step = self.panel_step();
        // Sums stay in their tiles over a part: on their way to memory and back they cost more than weights
        // that are read again from the second-level cache.
        let part_steps = steps.div_ceil(steps.div_ceil(PART_STEPS)).next_multiple_of(8);
        let parts = Parts::new(block, panel_step, steps, part_steps);
        // SAFETY: no other session is open, and finishing uses no tiles.
        let mut session = unsafe { Session::new(self.unit) };
        for part in parts.iter() {
            let panel = &block.weights[panel_step * part.start..panel_step * part.end];
            let weights = match &mut unpacked {
                Some(Unpacked(to)) => {
                    let row = COLUMNS;
                    self.unit.simd().run(&mut Unpack { panel, row, to });
                    to.as_ptr().cast()
                }
                None => panel.as_ptr(),
            };
            for call in block.calls.clone() {
                let rows = block.split.rows(&(call..call + 1));
                let is_last = part.end == steps;
                if is_last {
                    self.prefetch_results(block, rows.clone());
                }
                let x = block.x.as_ptr();
                let product = Product {
                    operation: Self::OPERATION,
                    rows: rows.len(),
                    x: x.wrapping_add(rows.start * block.x.row_stride() + part.start * TILE),
                    x_stride: block.x.row_stride(),
                    w: weights,
                    w_stride: COLUMNS,
                    w_column: TILE,
                    w_step: STEP_WORDS,
                    columns: 3,
                    steps: part.len(),
                    sums: sums[(rows.start - first_row) * COLUMNS..].as_mut_ptr().cast(),
                    sums_stride: COLUMNS,
                    add: part.start > 0,
                    ahead: ahead(&parts, &part, call - block.calls.start, rows.len()),
                };
                // SAFETY: `check` found the rows in the block, the steps in the panel, and room for the sums; of
                // nibbles the steps of this part were unpacked above, all of them.
                unsafe { session.multiply(&product) };
                // At once, while the sums are in the nearest cache and the results on their way to it:
                // `encode` of N1.5 takes 0.95 (bfloat16) and 0.91 (int8) of the time with all rows after the
                // panel (Intel with AMX, 2 threads).
                if is_last {
                    finish(rows, sums);
                }
            }
        }
    }
}

#[cfg(feature = "peak")]
impl<U: TileUnit, E: Elements> super::PeakLoop for InTiles<U, E> {
    fn multiply_for_peak(&self) -> usize {
        self.unit.multiply_for_peak(Self::OPERATION)
    }
}

/// What call number `call` prefetches while it goes through `part`: some lines after each product. All of a
/// step at once cost 20 to 60 % (Sapphire Rapids).
fn ahead(parts: &Parts<'_>, part: &Range<usize>, call: usize, rows: usize) -> Ahead {
    const WORD: usize = size_of::<u32>();
    let products = if rows > TILE { 6 } else { 3 };
    let bursts = parts.bursts(part, call);
    Ahead {
        at: bursts.first.cast(),
        pitch: WORD * bursts.pitch,
        advance: WORD * bursts.advance,
        lines: bursts.lines.div_ceil(products),
    }
}
