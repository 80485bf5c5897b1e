//! Panels that are words of consecutive `k` of one column: `[k / PER_WORD][column]`, the first `k` lowest,
//! zeros where there are no more. Of elements with groups, as many words of a column are next to each other. Of
//! int4, two such rows of words of bytes are one.

use super::PanelMut;
use super::elements::Elements;
use crate::matrix::Matrix;
use crate::simd::HIGH_NIBBLES;
use crate::weights::{Element, WeightRef, quantize, quantize_int4, row_scale, row_scale_int4};

/// Writes the columns of a panel from `first` on, one for each row of `weight`.
pub(super) fn pack<E: Elements>(
    weight: WeightRef<'_>,
    first: usize,
    columns: usize,
    has_nibbles: bool,
    panel: PanelMut<'_>,
) {
    const { assert!(E::GROUP <= 2) }
    match (E::WEIGHTS, E::GROUP) {
        (Element::F32, _) => put_f32(weight, first, columns, panel.words),
        (Element::Bf16, 1) => put_bf16::<1>(weight, first, columns, panel.words),
        (Element::Bf16, _) => put_bf16::<2>(weight, first, columns, panel.words),
        (Element::Int8, 1) if has_nibbles => put_int4::<1>(weight, first, columns, panel),
        (Element::Int8, 1) => put_int8::<1>(weight, first, columns, panel),
        (Element::Int8, _) if has_nibbles => put_int4::<2>(weight, first, columns, panel),
        (Element::Int8, _) => put_int8::<2>(weight, first, columns, panel),
        (Element::Int4, _) => unreachable!("int8, in panels of nibbles"),
    }
}

/// float32.
fn put_f32(weight: WeightRef<'_>, first: usize, columns: usize, words: &mut [u32]) {
    match weight {
        WeightRef::F32(view) => put::<_, 1, 1, 1>(words, columns, first, view, |_, value| value.to_bits()),
        WeightRef::Bf16(view) => put::<_, 1, 1, 1>(words, columns, first, view, |_, value| {
            u32::from(value.to_bits()) << 16
        }),
        WeightRef::Int8 { values, scales } => {
            put::<_, 1, 1, 1>(words, columns, first, values, |row, value| {
                (f32::from(value) * scales[row]).to_bits()
            })
        }
        WeightRef::Int4 { .. } => unreachable!("widened to int8 for other arithmetic"),
    }
}

/// Pairs of bfloat16.
fn put_bf16<const RUN: usize>(weight: WeightRef<'_>, first: usize, columns: usize, words: &mut [u32]) {
    match weight {
        WeightRef::Bf16(view) => {
            put::<_, 2, RUN, 1>(words, columns, first, view, |_, value| u32::from(value.to_bits()))
        }
        WeightRef::F32(view) => put::<_, 2, RUN, 1>(words, columns, first, view, |_, value| rounded(value)),
        WeightRef::Int8 { values, scales } => {
            put::<_, 2, RUN, 1>(words, columns, first, values, |row, value| {
                rounded(f32::from(value) * scales[row])
            })
        }
        WeightRef::Int4 { .. } => unreachable!("widened to int8 for other arithmetic"),
    }
}

/// Quads of int8, with the scales of the columns and the sums of their weights.
fn put_int8<const RUN: usize>(weight: WeightRef<'_>, first: usize, columns: usize, panel: PanelMut<'_>) {
    let rows = weight.shape().0;
    let scales = &mut panel.scales[first..first + rows];
    for (row, scale) in scales.iter_mut().enumerate() {
        *scale = row_scale(&weight, row);
    }
    let scales = &*scales;
    let byte = |row: usize, value: f32| u32::from(quantize(value, scales[row]).cast_unsigned());
    match weight {
        WeightRef::Int8 { values, .. } => {
            put::<_, 4, RUN, 1>(panel.words, columns, first, values, |_, value| {
                u32::from(value.cast_unsigned())
            })
        }
        WeightRef::F32(view) => put::<_, 4, RUN, 1>(panel.words, columns, first, view, byte),
        WeightRef::Bf16(view) => put::<_, 4, RUN, 1>(panel.words, columns, first, view, |row, value| {
            byte(row, value.to_f32())
        }),
        WeightRef::Int4 { .. } => unreachable!("widened to int8 for other arithmetic"),
    }
    let sums = &mut panel.sums[first..first + rows];
    add_bytes::<RUN>(panel.words, columns, first, sums, |word| word);
}

/// Quads of bytes that are 16 times the weights, two of them in a word, with a sixteenth of the scales.
fn put_int4<const RUN: usize>(weight: WeightRef<'_>, first: usize, columns: usize, panel: PanelMut<'_>) {
    let rows = weight.shape().0;
    let scales = &mut panel.scales[first..first + rows];
    for (row, scale) in scales.iter_mut().enumerate() {
        *scale = row_scale_int4(&weight, row);
    }
    let byte = |row: usize, value: f32| u32::from(quantize_int4(value, scales[row]).cast_unsigned() << 4);
    match weight {
        WeightRef::Int4 { values, .. } => {
            put::<_, 2, RUN, 2>(panel.words, columns, first, values, |_, pair| {
                let pair = u32::from(pair);
                (pair & 0x0f) << 4 | (pair & 0xf0) << 8
            })
        }
        WeightRef::Int8 { values, scales } => {
            put::<_, 4, RUN, 2>(panel.words, columns, first, values, |row, value| {
                byte(row, f32::from(value) * scales[row])
            })
        }
        WeightRef::F32(view) => put::<_, 4, RUN, 2>(panel.words, columns, first, view, byte),
        WeightRef::Bf16(view) => put::<_, 4, RUN, 2>(panel.words, columns, first, view, |row, value| {
            byte(row, value.to_f32())
        }),
    }
    scales.iter_mut().for_each(|scale| *scale /= 16.0);
    let sums = &mut panel.sums[first..first + rows];
    let high = HIGH_NIBBLES.cast_unsigned();
    add_bytes::<RUN>(panel.words, columns, first, sums, |word| word << 4 & high);
    add_bytes::<RUN>(panel.words, columns, first, sums, |word| word & high);
}

/// Adds the signed bytes of what `bytes` makes of each word to the sum of its column.
fn add_bytes<const RUN: usize>(
    words: &[u32],
    columns: usize,
    first: usize,
    sums: &mut [i32],
    bytes: impl Fn(u32) -> u32,
) {
    for words in words.chunks_exact(columns * RUN) {
        for (sum, words) in sums.iter_mut().zip(words[first * RUN..].as_chunks::<RUN>().0) {
            let bytes = words.iter().flat_map(|&word| bytes(word).to_le_bytes());
            *sum += bytes.map(|byte| i32::from(byte.cast_signed())).sum::<i32>();
        }
    }
}

/// Writes `bits(row, element)` of all elements, `STEP` of which make a word, the first one lowest; `RUN`
/// words of a column stay together. With `HALVES` of 2, the words of two such runs are one, the first in the low
/// halves of its bytes and the second in the high ones.
///
/// In blocks, so that neither the reading nor the writing side jumps through memory at every element; what is
/// in a block is known to the compiler, which makes vectors of it.
fn put<T: Copy, const STEP: usize, const RUN: usize, const HALVES: usize>(
    to_words: &mut [u32],
    columns: usize,
    first: usize,
    view: Matrix<'_, T>,
    bits: impl Fn(usize, T) -> u32,
) {
    /// Rows, and words of a row: a cache line of each.
    const BLOCK: usize = 16;
    let (rows, inputs) = (view.num_rows(), view.num_columns());
    let words = inputs.div_ceil(STEP);
    let word = |row: usize, elements: &[T]| {
        let parts = elements.iter().enumerate();
        parts.fold(0, |word, (part, &element)| {
            word | bits(row, element) << (32 / STEP * part)
        })
    };
    for first_row in (0..rows).step_by(BLOCK) {
        let block_rows = BLOCK.min(rows - first_row);
        for first_word in (0..words).step_by(BLOCK) {
            let block_words = BLOCK.min(words - first_word);
            let k = first_word * STEP;
            let mut block = [[0; BLOCK]; BLOCK];
            for (index, block) in block[..block_rows].iter_mut().enumerate() {
                let row = first_row + index;
                if let Some(elements) = view.contiguous_row(row)
                    && k + BLOCK * STEP <= inputs
                {
                    let elements = &elements[k..][..BLOCK * STEP];
                    for (to, elements) in block.iter_mut().zip(elements.as_chunks::<STEP>().0) {
                        *to = word(row, elements);
                    }
                } else {
                    for (index, to) in block[..block_words].iter_mut().enumerate() {
                        let k = k + index * STEP;
                        let count = STEP.min(inputs - k);
                        let elements: [T; STEP] =
                            std::array::from_fn(|part| view.get(row, k + part.min(count - 1)));
                        *to = word(row, &elements[..count]);
                    }
                }
            }
            // Blocks begin with a run of words, or with two that are one.
            let to = &mut to_words[first_word / HALVES * columns..];
            for index in 0..block_words {
                let column: [u32; BLOCK] = std::array::from_fn(|row| block[row][index]);
                let to = &mut to[index / RUN / HALVES * RUN * columns..][index % RUN..];
                let is_low = HALVES == 2 && (index / RUN).is_multiple_of(2);
                let to = to[(first + first_row) * RUN..].iter_mut().step_by(RUN);
                for (to, &word) in to.zip(&column[..block_rows]) {
                    *to |= if is_low { word >> 4 } else { word };
                }
            }
        }
    }
}

/// The bits of a float32 rounded to bf16, in the low half: as `bf16::from_f32`, without its branches.
fn rounded(value: f32) -> u32 {
    let bits = value.to_bits();
    let nearest = bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16;
    let quiet_nan = (bits >> 16) | 0x40;
    if value.is_nan() { quiet_nan } else { nearest }
}

#[cfg(test)]
mod tests {
    use half::bf16;

    use super::*;

    #[test]
    fn rounding_is_that_of_half() {
        // Miri would take half an hour for all of them.
        let apart = if cfg!(miri) { 257 } else { 1 };
        let near_halves = (0..=u16::MAX).step_by(apart).flat_map(|high| {
            let high = u32::from(high) << 16;
            [0, 1, 0x7fff, 0x8000, 0x8001, 0xffff].map(|low| high | low)
        });
        for bits in near_halves {
            let value = f32::from_bits(bits);
            assert_eq!(
                rounded(value),
                u32::from(bf16::from_f32(value).to_bits()),
                "{bits:#x}"
            );
        }
    }
}
