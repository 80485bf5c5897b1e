//! Packing keys and values into the layout that the tiles read.

use crate::rows::Rows;
use crate::simd::bits::write;
use crate::simd::{Kernel, MAX_LANES, Simd};

/// The keys and values of one head, and where they go.
pub(super) struct Head<'a> {
    pub keys: Rows<'a>,
    pub values: Rows<'a>,
    /// Number of the first key given.
    pub first: usize,
    /// Steps of `head_dim` in the packed keys, with those that pad it.
    pub key_steps: usize,
    /// Steps of keys that values are padded to.
    pub value_group: usize,
    pub keys_to: &'a mut [u32],
    pub values_to: &'a mut [u32],
}

/// Packs a head as float32. The result is whether its values are all finite.
pub(super) struct PackF32<'a>(pub Head<'a>);

/// Packs a head as pairs of bfloat16, likewise.
pub(super) struct PackBf16<'a>(pub Head<'a>);

impl Kernel for PackF32<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) -> bool {
        self.0.pack::<S, F32Words>(simd)
    }
}

impl Kernel for PackBf16<'_> {
    type Output = bool;
    const USES_DOT_BF16: bool = true;

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) -> bool {
        self.0.pack::<S, Bf16Words>(simd)
    }
}

/// How elements become words.
trait Words {
    /// Elements in a word.
    const STEP: usize;

    /// Packs elements of a row, at most `LANES * STEP`, into the first `LANES` words of `to`, with zeros for
    /// the rest.
    fn along<S: Simd>(simd: S, row: &[f32], to: &mut [u32]);

    /// Packs element `i` of each of `STEP` rows, or zero for a row that is missing, into word `i` of the
    /// first `LANES` of `to`; zeros where rows end before. Bits in `kept` stay as they are.
    fn across<S: Simd>(simd: S, rows: [Option<&[f32]>; 2], kept: u32, to: &mut [u32]);

    /// Whether all elements of a word are finite.
    fn is_finite(word: u32) -> bool;
}

/// float32.
struct F32Words;

impl Words for F32Words {
    const STEP: usize = 1;

    #[inline(always)]
    fn along<S: Simd>(simd: S, row: &[f32], to: &mut [u32]) {
        write(simd.load_partial(row), to);
    }

    #[inline(always)]
    fn across<S: Simd>(simd: S, rows: [Option<&[f32]>; 2], _: u32, to: &mut [u32]) {
        if let Some(row) = rows[0] {
            Self::along(simd, row, to);
        }
    }

    #[inline(always)]
    fn is_finite(word: u32) -> bool {
        word & 0x7f80_0000 != 0x7f80_0000
    }
}

/// Pairs of bfloat16.
struct Bf16Words;

impl Words for Bf16Words {
    const STEP: usize = 2;

    #[inline(always)]
    fn along<S: Simd>(simd: S, row: &[f32], to: &mut [u32]) {
        let (first, second) = row.split_at(S::LANES.min(row.len()));
        write(
            simd.to_bf16_pairs(simd.load_partial(first), simd.load_partial(second)),
            to,
        );
    }

    #[inline(always)]
    fn across<S: Simd>(simd: S, rows: [Option<&[f32]>; 2], kept: u32, to: &mut [u32]) {
        let mut halves = [0_u16; 2 * MAX_LANES];
        // Zeros are not loaded: a masked load from where no memory is takes as long as a hundred others.
        let [first, second] = rows.map(|row| row.map_or(simd.splat(0.0), |row| simd.load_partial(row)));
        simd.store_bf16_pair(first, second, &mut halves);
        let (low, high) = halves[..2 * S::LANES].split_at(S::LANES);
        for ((word, &low), &high) in to.iter_mut().zip(low).zip(high) {
            *word = *word & kept | u32::from(low) | u32::from(high) << 16;
        }
    }

    #[inline(always)]
    fn is_finite(word: u32) -> bool {
        word & 0x7f80 != 0x7f80 && word & 0x7f80_0000 != 0x7f80_0000
    }
}

/// Rows that are cache lines: each would lie across two of them otherwise.
#[repr(align(64))]
struct Square([[u32; MAX_LANES]; MAX_LANES]);

impl Head<'_> {
    #[inline(always)]
    fn pack<S: Simd, W: Words>(&mut self, simd: S) -> bool {
        self.pack_keys::<S, W>(simd);
        self.pack_values::<S, W>(simd)
    }

    #[inline(always)]
    fn pack_keys<S: Simd, W: Words>(&mut self, simd: S) {
        let (first, head_dim, steps) = (self.first, self.keys.num_columns(), self.key_steps);
        let len = first + self.keys.num_rows();
        for panel in first / S::LANES..len.div_ceil(S::LANES) {
            let keys = panel * S::LANES..(panel + 1) * S::LANES;
            // Lanes before the first key given stay.
            let (start, end) = (first.saturating_sub(keys.start), S::LANES.min(len - keys.start));
            // The words of as many keys, a row a key, to be transposed; zeros for keys beyond the last one.
            let mut square = Square([[0; MAX_LANES]; MAX_LANES]);
            for step in (0..steps).step_by(S::LANES) {
                let from = head_dim.min(step * W::STEP);
                let to = head_dim.min(from + S::LANES * W::STEP);
                for (lane, words) in square.0.iter_mut().enumerate().take(end).skip(start) {
                    let key = self.keys.row(keys.start + lane - first);
                    W::along(simd, &key[from..to], words);
                }
                let count = S::LANES.min(steps - step);
                let to = &mut self.keys_to[(panel * steps + step) * S::LANES..][..count * S::LANES];
                if start == 0 && count == S::LANES {
                    simd.transpose(&square.0, to);
                    continue;
                }
                for (word, to) in to.chunks_exact_mut(S::LANES).enumerate() {
                    for (to, row) in to.iter_mut().zip(&square.0).skip(start) {
                        *to = row[word];
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn pack_values<S: Simd, W: Words>(&mut self, simd: S) -> bool {
        let (first, head_dim, values) = (self.first, self.values.num_columns(), self.values);
        let len = first + values.num_rows();
        let width = head_dim.next_multiple_of(S::LANES);
        let mut finite = true;
        for step in first / W::STEP..len.div_ceil(W::STEP).next_multiple_of(self.value_group) {
            let row = |part: usize| {
                let key = step * W::STEP + part;
                (part < W::STEP && first <= key && key < len).then(|| values.row(key - first))
            };
            let rows = [row(0), row(1)];
            // The key before the first one given may share its words: it stays.
            let kept = if step * W::STEP < first { 0xffff } else { 0 };
            for column in (0..head_dim).step_by(S::LANES) {
                let columns = column..head_dim.min(column + S::LANES);
                let to = &mut self.values_to[step * width + column..][..S::LANES];
                W::across(
                    simd,
                    rows.map(|row| row.map(|row| &row[columns.clone()])),
                    kept,
                    to,
                );
                let infinite = to
                    .iter()
                    .fold(0, |infinite, &word| infinite | u32::from(!W::is_finite(word)));
                finite &= infinite == 0;
            }
        }
        finite
    }
}
