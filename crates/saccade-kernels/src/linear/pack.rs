//! From weights as they are stored to panels.

use super::{Element, KernelError, WeightRef};
use crate::aligned::AlignedBuffer;
use crate::pool::{Interrupted, is_stopped, parallel_for};
use crate::rows::Matrix;

/// The panels of `columns` columns of `parts`, stacked; for int8 each column's scale and the sum of its weights, otherwise empty.
pub(super) fn pack_panels(
    threads: usize,
    element: Element,
    columns: usize,
    parts: &[(WeightRef<'_>, Option<&[f32]>)],
) -> Result<(AlignedBuffer<u32>, AlignedBuffer<f32>, AlignedBuffer<i32>), KernelError> {
    let in_features = parts[0].0.shape().1;
    let out_features: usize = parts.iter().map(|(weight, _)| weight.shape().0).sum();
    let num_panels = out_features.div_ceil(columns);
    let size = columns * in_features.div_ceil(element.per_word());
    let int8_columns = if element == Element::Int8 {
        num_panels * columns
    } else {
        0
    };
    // SAFETY: the tasks below write all of it; where they were stopped, it is dropped.
    let mut words = unsafe { AlignedBuffer::unwritten(num_panels * size)? };
    let mut scales = AlignedBuffer::zeroed(int8_columns)?;
    let mut sums = AlignedBuffer::zeroed(int8_columns)?;
    let to = To {
        words: words.pointer(),
        scales: scales.as_mut_ptr(),
        sums: sums.as_mut_ptr(),
    };
    parallel_for(threads, num_panels, &|index| {
        let to = &to;
        let int8 = if element == Element::Int8 { columns } else { 0 };
        // SAFETY: the buffers hold `num_panels` panels, and each task has its own, which is zero from here on.
        let mut panel = unsafe {
            to.words.add(index * size).write_bytes(0, size);
            Panel {
                element,
                columns,
                words: std::slice::from_raw_parts_mut(to.words.add(index * size), size),
                scales: std::slice::from_raw_parts_mut(to.scales.add(index * int8), int8),
                sums: std::slice::from_raw_parts_mut(to.sums.add(index * int8), int8),
            }
        };
        let (first, end) = (index * columns, (index + 1) * columns);
        let mut part_first = 0;
        for (weight, _) in parts {
            let part_end = part_first + weight.shape().0;
            let (from, until) = (part_first.max(first), part_end.min(end));
            if from < until {
                panel.fill(from - first, weight.rows(from - part_first..until - part_first));
            }
            part_first = part_end;
        }
    });
    if is_stopped() {
        return Err(Interrupted.into());
    }
    Ok((words, scales, sums))
}

struct To {
    words: *mut u32,
    scales: *mut f32,
    sums: *mut i32,
}

// SAFETY: tasks write different panels.
unsafe impl Sync for To {}

/// One panel, zero where nothing was written yet.
struct Panel<'a> {
    element: Element,
    columns: usize,
    words: &'a mut [u32],
    scales: &'a mut [f32],
    sums: &'a mut [i32],
}

impl Panel<'_> {
    /// Writes the columns from `first` on, one for each row of `weight`.
    fn fill(&mut self, first: usize, weight: WeightRef<'_>) {
        match (self.element, weight) {
            (Element::F32, WeightRef::F32(view)) => self.put::<_, 1>(first, view, |_, value| value.to_bits()),
            (Element::F32, WeightRef::Bf16(view)) => {
                self.put::<_, 1>(first, view, |_, value| u32::from(value.to_bits()) << 16);
            }
            (Element::F32, WeightRef::Int8 { values, scales }) => {
                self.put::<_, 1>(first, values, |row, value| {
                    (f32::from(value) * scales[row]).to_bits()
                });
            }
            (Element::Bf16, WeightRef::Bf16(view)) => {
                self.put::<_, 2>(first, view, |_, value| u32::from(value.to_bits()));
            }
            (Element::Bf16, WeightRef::F32(view)) => self.put::<_, 2>(first, view, |_, value| rounded(value)),
            (Element::Bf16, WeightRef::Int8 { values, scales }) => {
                self.put::<_, 2>(first, values, |row, value| {
                    rounded(f32::from(value) * scales[row])
                });
            }
            (Element::Int8, WeightRef::Int8 { values, scales }) => {
                self.put::<_, 4>(first, values, |_, value| u32::from(value.cast_unsigned()));
                for (row, sum) in self.sums[first..first + scales.len()].iter_mut().enumerate() {
                    *sum = (0..values.num_columns())
                        .map(|k| i32::from(values.get(row, k)))
                        .sum();
                }
                self.scales[first..first + scales.len()].copy_from_slice(scales);
            }
            (Element::Int8, WeightRef::F32(_) | WeightRef::Bf16(_)) => {
                let (rows, inputs) = weight.shape();
                let (mut values, mut scales) = (vec![0; rows * inputs], vec![0.0; rows]);
                quantize_rows(weight, &mut values, &mut scales);
                let values = Matrix::new(&values, inputs);
                let scales = &scales;
                self.fill(first, WeightRef::Int8 { values, scales });
            }
        }
    }

    /// Writes `bits(row, element)` of all elements, `STEP` of which make a word, the first one lowest.
    ///
    /// In blocks, so that neither the reading nor the writing side jumps through memory at every element; what is in a block is known to the
    /// compiler, which makes vectors of it.
    fn put<T: Copy, const STEP: usize>(
        &mut self,
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
                let to = &mut self.words[first_word * self.columns..];
                for (index, to) in to.chunks_mut(self.columns).take(block_words).enumerate() {
                    let column: [u32; BLOCK] = std::array::from_fn(|row| block[row][index]);
                    to[first + first_row..][..block_rows].copy_from_slice(&column[..block_rows]);
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

/// Quantises the rows of `weight (out_features, in_features)` to int8 as [`PackedLinear::pack`](super::PackedLinear::pack) does: `scale = max |w| / 127` of the row,
/// `value = w / scale` to the nearest, ties to even. `values` is row-major, `scales` has one element for each row.
///
/// A row that is nowhere larger than 127 of the smallest normal numbers (1.5e-36) becomes zeros with the scale 0; one with NaN or infinity
/// becomes zeros with the scale NaN. Weights that are int8 already are copied.
///
/// # Panics
/// If `values` or `scales` have another length.
///
/// ```
/// use saccade_kernels::{Matrix, WeightRef, quantize_rows};
/// let weight = WeightRef::F32(Matrix::new(&[1.0, -0.5, 0.0, 0.25], 2));
/// let (mut values, mut scales) = ([0; 4], [0.0; 2]);
/// quantize_rows(weight, &mut values, &mut scales);
/// assert_eq!((values, scales), ([127, -64, 0, 127], [1.0 / 127.0, 0.25 / 127.0]));
/// ```
pub fn quantize_rows(weight: WeightRef<'_>, values: &mut [i8], scales: &mut [f32]) {
    /// Adding it rounds to a whole number, ties to even, which is then the difference of the bits: 1.5 * 2^23.
    const ROUND: f32 = 12_582_912.0;
    let (rows, inputs) = weight.shape();
    assert_eq!(
        values.len(),
        rows * inputs,
        "values: expected the elements of weight"
    );
    assert_eq!(scales.len(), rows, "scales: expected one for each row of weight");
    if let WeightRef::Int8 {
        values: from,
        scales: from_scales,
    } = weight
    {
        scales.copy_from_slice(from_scales);
        for (row, to) in values.chunks_exact_mut(inputs.max(1)).enumerate() {
            to.iter_mut()
                .enumerate()
                .for_each(|(k, to)| *to = from.get(row, k));
        }
        return;
    }
    let mut wide = vec![0.0f32; inputs];
    for (row, scale) in scales.iter_mut().enumerate() {
        match &weight {
            WeightRef::F32(view) => widen(*view, row, &mut wide, |value| value),
            WeightRef::Bf16(view) => widen(*view, row, &mut wide, |value| {
                f32::from_bits(u32::from(value.to_bits()) << 16)
            }),
            WeightRef::Int8 { .. } => unreachable!("copied above"),
        }
        // Magnitudes are ordered as their bits are; NaN and infinity come last.
        let magnitudes = wide.iter().map(|value| value.to_bits() & 0x7fff_ffff);
        let largest = f32::from_bits(magnitudes.fold(0, u32::max));
        let to = &mut values[row * inputs..][..inputs];
        *scale = largest / 127.0;
        if !largest.is_finite() || *scale < f32::MIN_POSITIVE {
            *scale = if largest.is_finite() { 0.0 } else { f32::NAN };
            to.fill(0);
            continue;
        }
        for (to, value) in to.iter_mut().zip(&wide) {
            *to = (value / *scale + ROUND).to_bits().wrapping_sub(ROUND.to_bits()) as i8;
        }
    }
}

/// Row `row` in float32.
fn widen<T: Copy>(view: Matrix<'_, T>, row: usize, to: &mut [f32], convert: impl Fn(T) -> f32) {
    if let Some(from) = view.contiguous_row(row) {
        to.iter_mut()
            .zip(from)
            .for_each(|(to, &from)| *to = convert(from));
    } else {
        to.iter_mut()
            .enumerate()
            .for_each(|(k, to)| *to = convert(view.get(row, k)));
    }
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
