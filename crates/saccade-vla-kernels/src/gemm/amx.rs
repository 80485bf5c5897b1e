//! Products in tiles, of bfloat16 in pairs and of bytes in quads: what AMX multiplies, and its emulation in software.

use std::marker::PhantomData;
use std::ops::Range;

use super::dot_bf16::Narrowing;
use super::dot_int8::Quantizing;
use super::outliers::MultiplyOutliers;
use super::streams::Parts;
use super::{Block, Gemm, MAX_ROW_BLOCK, PanelMut, ROW_BLOCK, Shape, Source, odd_lines, panel};
use crate::simd::{Simd, Vector};
use crate::tiles::{Ahead, MAX_ROWS, Operation, Product, Session, TILE, TileUnit};
use crate::weights::WeightRef;

/// Columns of a panel: three tiles, because six tiles of sums, one of rows and one of weights are all that there are.
const COLUMNS: usize = 3 * TILE;

/// Words of a panel that one step meets.
const STEP_WORDS: usize = TILE * COLUMNS;

/// Steps of a part of a panel at most: 192 kB, and in as many steps a line of each of 48 streams of 4 kB.
const PART_STEPS: usize = 64;

/// Bytes of the rows that go through a panel together at most. Products in tiles are so fast that weights come from memory no faster than
/// they are used: as many rows as fit into the second-level cache beside the panel, 2 MB where there is AMX.
const ROW_BYTES: usize = 5 << 18;

/// What is multiplied, and how weights and rows become words of it.
pub(crate) trait Elements: Send + Sync + 'static {
    const OPERATION: Operation;

    fn pack(weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>);

    /// Converts rows, `stride` words apart, with zeros to whole tiles.
    ///
    /// # Safety
    /// As [`Gemm::convert`].
    unsafe fn convert<S: Simd>(simd: S, source: &Source, rows: Range<usize>, stride: usize);
}

/// Pairs of bfloat16.
pub(crate) struct Pairs;

impl Elements for Pairs {
    const OPERATION: Operation = Operation::Bf16;

    fn pack(weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        panel::pack_bf16(weight, first, COLUMNS, panel.words);
    }

    unsafe fn convert<S: Simd>(simd: S, source: &Source, rows: Range<usize>, stride: usize) {
        simd.run(Narrowing {
            source,
            rows: rows.clone(),
            stride,
        });
        let width = source.in_features;
        for row in rows {
            // What may be NaN would make NaN of the zeros that it is multiplied by.
            // SAFETY: a row has whole lines, which are steps.
            unsafe {
                let elements = source.words.add(row * stride).cast::<u16>();
                elements
                    .add(width)
                    .write_bytes(0, width.next_multiple_of(2 * TILE) - width);
            }
        }
    }
}

/// Quads of bytes.
pub(crate) struct Quads;

impl Elements for Quads {
    const OPERATION: Operation = Operation::Int8;

    fn pack(weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        panel::pack_int8(weight, first, COLUMNS, panel);
    }

    unsafe fn convert<S: Simd>(simd: S, source: &Source, rows: Range<usize>, stride: usize) {
        // Any bytes may follow: they are multiplied by zeros.
        simd.run(Quantizing { source, rows, stride });
    }
}

/// Products of `E` in the tiles of `U`. A panel is what those of vectors are, `[k / elements of a word][column]`, in whole steps of 16 words.
pub(crate) struct InTiles<U, E> {
    unit: U,
    elements: PhantomData<E>,
}

impl<U: TileUnit, E: Elements> InTiles<U, E> {
    /// Steps over which is summed.
    fn steps(in_features: usize) -> usize {
        in_features.div_ceil(TILE * E::OPERATION.per_word())
    }

    /// Asks memory for where the results of some rows go: by the time that their sums are made, they are here.
    #[inline(always)]
    fn ask_for_results(&self, block: &Block<'_>, rows: Range<usize>) {
        for row in rows {
            let out = block.out.wrapping_offset(row as isize * block.out_stride);
            for tile in 0..COLUMNS / TILE {
                // SAFETY: prefetching is allowed at any address; the unit is the proof of its vectors.
                unsafe { <U::Simd as Simd>::Vector::prefetch(out.wrapping_add(tile * TILE).cast()) };
            }
        }
    }
}

// SAFETY: the unit is the proof that its instructions may be used; `convert` and `multiply` keep to their rows and block.
unsafe impl<U: TileUnit, E: Elements> Gemm for InTiles<U, E> {
    fn new() -> Option<Self> {
        let elements = PhantomData;
        U::new().map(|unit| Self { unit, elements })
    }

    fn shape(&self) -> Shape {
        Shape {
            columns: COLUMNS,
            tile_rows: MAX_ROWS,
            row_group: 1,
            rows_beyond: 0,
        }
    }

    fn row_block(&self, in_features: usize) -> usize {
        let row_bytes = size_of::<u32>() * TILE * Self::steps(in_features).max(1);
        (ROW_BYTES / row_bytes).clamp(ROW_BLOCK, MAX_ROW_BLOCK)
    }

    fn panel_words(&self, in_features: usize) -> usize {
        STEP_WORDS * Self::steps(in_features)
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        E::pack(weight, first, panel);
    }

    fn converted_stride(&self, in_features: usize) -> Option<usize> {
        Some(odd_lines(in_features, E::OPERATION.per_word()))
    }

    unsafe fn convert(&self, source: &Source, rows: Range<usize>) {
        let stride = odd_lines(source.in_features, E::OPERATION.per_word());
        // SAFETY: the caller's promise.
        unsafe { E::convert(self.unit.simd(), source, rows, stride) }
    }

    unsafe fn multiply(&self, block: &Block<'_>) {
        let (tiles, steps) = (&block.range, Self::steps(block.in_features));
        let first_row = block.rows().start;
        if steps == 0 {
            // SAFETY: the block's sums have room for its rows.
            unsafe { block.sums.write_bytes(0, block.rows().len() * COLUMNS) };
            return (block.finish)(block.rows());
        }
        // Sums stay in their tiles over a part: on their way to memory and back they cost more than weights that are read again from the
        // second-level cache.
        let part_steps = steps.div_ceil(steps.div_ceil(PART_STEPS)).next_multiple_of(8);
        let parts = Parts::new(block, STEP_WORDS, steps, part_steps);
        // SAFETY: no other session is open, and finishing uses no tiles; the tile's rows are in the block, its steps in the panel, and its sums
        // within the block's.
        unsafe {
            let mut session = Session::new(self.unit);
            for part in parts.iter() {
                for tile in tiles.clone() {
                    let (first, end) = (block.tiles.first_row(tile), block.tiles.first_row(tile + 1));
                    let is_last = part.end == steps;
                    if is_last {
                        self.ask_for_results(block, first..end);
                    }
                    session.multiply(&Product {
                        operation: E::OPERATION,
                        rows: end - first,
                        x: block
                            .x
                            .offset(first as isize * block.x_stride)
                            .add(part.start * TILE),
                        x_stride: block.x_stride.cast_unsigned(),
                        w: block.weights.as_ptr().add(part.start * STEP_WORDS),
                        w_stride: COLUMNS,
                        w_column: TILE,
                        w_step: STEP_WORDS,
                        columns: 3,
                        steps: part.len(),
                        sums: block.sums.add((first - first_row) * COLUMNS),
                        sums_stride: COLUMNS,
                        add: part.start > 0,
                        ahead: ahead(&parts, &part, tile - tiles.start, end - first),
                    });
                    // At once, while the sums are in the nearest cache and the results on their way to it: `encode` of N1.5 takes 0.95
                    // (bfloat16) and 0.91 (int8) of the time with all rows after the panel (Intel with AMX, 2 threads).
                    if is_last {
                        (block.finish)(first..end);
                    }
                }
            }
        }
    }

    fn multiply_outliers(&self, outliers: MultiplyOutliers<'_>) {
        self.unit.simd().run(outliers);
    }

    fn chains(&self) -> usize {
        self.unit.chains(E::OPERATION)
    }
}

/// What tile number `tile` of a block asks for while it goes through `part`: some lines after each product. All of a step at once cost 20 to
/// 60 % (Sapphire Rapids).
fn ahead(parts: &Parts<'_>, part: &Range<usize>, tile: usize, rows: usize) -> Ahead {
    const WORD: usize = size_of::<u32>();
    let products = if rows > TILE { 6 } else { 3 };
    let bursts = parts.bursts(part, tile);
    Ahead {
        at: bursts.first.cast(),
        pitch: WORD * bursts.pitch,
        advance: WORD * bursts.advance,
        lines: bursts.lines.div_ceil(products),
    }
}
