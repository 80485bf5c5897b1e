//! Panels that are words of consecutive `k` of one column: `[k / PER_WORD][column]`, the first `k` lowest,
//! zeros where there are no more. Of elements with groups, as many words of a column are next to each other.

use super::PanelMut;
use super::elements::Elements;
use crate::matrix::Matrix;
use crate::weights::{Element, WeightRef, quantize, row_scale};

/// Writes the columns of a panel from `first` on, one for each row of `weight`.
pub(super) fn pack<E: Elements>(weight: WeightRef<'_>, first: usize, columns: usize, panel: PanelMut<'_>) {
    const { assert!(E::GROUP <= 2) }
    match (E::WEIGHTS, E::GROUP) {
        (Element::F32, _) => put_f32(weight, first, columns, panel.words),
        (Element::Bf16, 1) => put_bf16::<1>(weight, first, columns, panel.words),
        (Element::Bf16, _) => put_bf16::<2>(weight, first, columns, panel.words),
        (Element::Int8, 1) => put_int8::<1>(weight, first, columns, panel),
        (Element::Int8, _) => put_int8::<2>(weight, first, columns, panel),
    }
}

/// float32.
fn put_f32(weight: WeightRef<'_>, first: usize, columns: usize, words: &mut [u32]) {
    match weight {
        WeightRef::F32(view) => put::<_, 1, 1>(words, columns, first, view, |_, value| value.to_bits()),
        WeightRef::Bf16(view) => put::<_, 1, 1>(words, columns, first, view, |_, value| {
            u32::from(value.to_bits()) << 16
        }),
        WeightRef::Int8 { values, scales } => put::<_, 1, 1>(words, columns, first, values, |row, value| {
            (f32::from(value) * scales[row]).to_bits()
        }),
    }
}

/// Pairs of bfloat16.
fn put_bf16<const RUN: usize>(weight: WeightRef<'_>, first: usize, columns: usize, words: &mut [u32]) {
    match weight {
        WeightRef::Bf16(view) => {
            put::<_, 2, RUN>(words, columns, first, view, |_, value| u32::from(value.to_bits()))
        }
        WeightRef::F32(view) => put::<_, 2, RUN>(words, columns, first, view, |_, value| rounded(value)),
        WeightRef::Int8 { values, scales } => {
            put::<_, 2, RUN>(words, columns, first, values, |row, value| {
                rounded(f32::from(value) * scales[row])
            })
        }
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
            put::<_, 4, RUN>(panel.words, columns, first, values, |_, value| {
                u32::from(value.cast_unsigned())
            })
        }
        WeightRef::F32(view) => put::<_, 4, RUN>(panel.words, columns, first, view, byte),
        WeightRef::Bf16(view) => put::<_, 4, RUN>(panel.words, columns, first, view, |row, value| {
            byte(row, value.to_f32())
        }),
    }
    let sums = &mut panel.sums[first..first + rows];
    sums.fill(0);
    for words in panel.words.chunks_exact(columns * RUN) {
        for (sum, words) in sums.iter_mut().zip(words[first * RUN..].chunks_exact(RUN)) {
            let bytes = words.iter().flat_map(|word| word.to_le_bytes());
            *sum += bytes.map(|byte| i32::from(byte.cast_signed())).sum::<i32>();
        }
    }
}

/// Writes `bits(row, element)` of all elements, `STEP` of which make a word, the first one lowest; `RUN`
/// words of a column stay together.
///
/// In blocks, so that neither the reading nor the writing side jumps through memory at every element; what is
/// in a block is known to the compiler, which makes vectors of it.
fn put<T: Copy, const STEP: usize, const RUN: usize>(
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
                    for (to, elements) in block.iter_mut().zip(elements.chunks_exact(STEP)) {
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
            // Blocks begin with a run of words.
            let to = &mut to_words[first_word * columns..];
            for index in 0..block_words {
                let column: [u32; BLOCK] = std::array::from_fn(|row| block[row][index]);
                let to = &mut to[index / RUN * RUN * columns..][index % RUN..];
                let to = to[(first + first_row) * RUN..].iter_mut().step_by(RUN);
                for (to, &word) in to.zip(&column[..block_rows]) {
                    *to = word;
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
        let near_halves = (0..=u16::MAX).flat_map(|high| {
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
