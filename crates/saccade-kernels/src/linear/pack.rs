//! From weights as they are stored to panels.

use faer::MatRef;
use half::bf16;

use super::{Element, WeightRef};
use crate::aligned::AlignedBuffer;
use crate::pool::parallel_for;

/// The panels of `columns` columns of `parts`, stacked; for int8 each column's scale and the sum of its weights, otherwise empty.
pub(super) fn pack_panels(
    threads: usize,
    element: Element,
    columns: usize,
    parts: &[(WeightRef<'_>, Option<&[f32]>)],
) -> (AlignedBuffer<u32>, AlignedBuffer<f32>, AlignedBuffer<i32>) {
    let in_features = parts[0].0.shape().1;
    let out_features: usize = parts.iter().map(|(weight, _)| weight.shape().0).sum();
    let num_panels = out_features.div_ceil(columns);
    let size = columns * in_features.div_ceil(element.per_word());
    let int8_columns = if element == Element::Int8 {
        num_panels * columns
    } else {
        0
    };
    let mut words = AlignedBuffer::zeroed(num_panels * size);
    let mut scales = AlignedBuffer::zeroed(int8_columns);
    let mut sums = AlignedBuffer::zeroed(int8_columns);
    let to = To {
        words: words.as_mut_ptr(),
        scales: scales.as_mut_ptr(),
        sums: sums.as_mut_ptr(),
    };
    parallel_for(threads, num_panels, &|index| {
        let to = &to;
        let int8 = if element == Element::Int8 { columns } else { 0 };
        // SAFETY: the buffers hold `num_panels` panels, and each task has its own.
        let mut panel = unsafe {
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
                panel.fill(from - first, weight.subrows(from - part_first, until - from));
            }
            part_first = part_end;
        }
    });
    (words, scales, sums)
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
        let columns = self.columns;
        let words = &mut *self.words;
        match (self.element, weight) {
            (Element::F32, WeightRef::F32(view)) => for_each(view, |row, k, value| {
                words[k * columns + first + row] = value.to_bits();
            }),
            (Element::F32, WeightRef::Bf16(view)) => for_each(view, |row, k, value| {
                words[k * columns + first + row] = value.to_f32().to_bits();
            }),
            (Element::F32, WeightRef::Int8 { values, scales }) => for_each(values, |row, k, value| {
                words[k * columns + first + row] = (f32::from(value) * scales[row]).to_bits();
            }),
            (Element::Bf16, WeightRef::Bf16(view)) => for_each(view, |row, k, value| {
                words[k / 2 * columns + first + row] |= half(value, k);
            }),
            (Element::Bf16, WeightRef::F32(view)) => for_each(view, |row, k, value| {
                words[k / 2 * columns + first + row] |= half(bf16::from_f32(value), k);
            }),
            (Element::Bf16, WeightRef::Int8 { values, scales }) => for_each(values, |row, k, value| {
                words[k / 2 * columns + first + row] |=
                    half(bf16::from_f32(f32::from(value) * scales[row]), k);
            }),
            (Element::Int8, WeightRef::Int8 { values, scales }) => {
                let sums = &mut *self.sums;
                for_each(values, |row, k, value| {
                    words[k / 4 * columns + first + row] |= u32::from(value.cast_unsigned()) << (8 * (k % 4));
                    sums[first + row] += i32::from(value);
                });
                self.scales[first..first + scales.len()].copy_from_slice(scales);
            }
            (Element::Int8, WeightRef::F32(_) | WeightRef::Bf16(_)) => {
                let (rows, inputs) = weight.shape();
                let (mut values, mut scales) = (vec![0; rows * inputs], vec![0.0; rows]);
                quantize_rows(weight, &mut values, &mut scales);
                let values = MatRef::from_row_major_slice(&values, rows, inputs);
                let scales = &scales;
                self.fill(first, WeightRef::Int8 { values, scales });
            }
        }
    }
}

/// Element `k` in its half of a word.
fn half(value: bf16, k: usize) -> u32 {
    u32::from(value.to_bits()) << (16 * (k % 2))
}

/// Visits all elements, `(row, k, element)`, in blocks, so that neither the reading nor the writing side jumps through memory at every one.
fn for_each<T: Copy>(view: MatRef<'_, T>, mut visit: impl FnMut(usize, usize, T)) {
    const BLOCK: usize = 16;
    for row in (0..view.nrows()).step_by(BLOCK) {
        let count = BLOCK.min(view.nrows() - row);
        for first in (0..view.ncols()).step_by(BLOCK) {
            let block = view.submatrix(row, first, count, BLOCK.min(view.ncols() - first));
            for k in 0..block.ncols() {
                for index in 0..count {
                    visit(row + index, first + k, block[(index, k)]);
                }
            }
        }
    }
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
/// use faer::MatRef;
/// use saccade_kernels::{WeightRef, quantize_rows};
/// let weight = WeightRef::F32(MatRef::from_row_major_slice(&[1.0, -0.5, 0.0, 0.25], 2, 2));
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
            to.iter_mut().enumerate().for_each(|(k, to)| *to = from[(row, k)]);
        }
        return;
    }
    let mut wide = vec![0.0f32; inputs];
    for (row, scale) in scales.iter_mut().enumerate() {
        for (k, wide) in wide.iter_mut().enumerate() {
            *wide = match &weight {
                WeightRef::F32(view) => view[(row, k)],
                WeightRef::Bf16(view) => view[(row, k)].to_f32(),
                WeightRef::Int8 { .. } => unreachable!("copied above"),
            };
        }
        // `max` passes over NaN; the sum of zeros times values does not.
        let largest = wide
            .iter()
            .fold(0.0f32, |largest, value| largest.max(value.abs()));
        let poison = wide.iter().fold(0.0f32, |poison, value| poison + 0.0 * value);
        let to = &mut values[row * inputs..][..inputs];
        *scale = largest / 127.0;
        if poison.is_nan() || *scale < f32::MIN_POSITIVE {
            *scale = if poison.is_nan() { f32::NAN } else { 0.0 };
            to.fill(0);
            continue;
        }
        for (to, value) in to.iter_mut().zip(&wide) {
            *to = (value / *scale + ROUND).to_bits().wrapping_sub(ROUND.to_bits()) as i8;
        }
    }
}
