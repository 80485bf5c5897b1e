//! Elements of a row that are far larger than the others: kept out of its quantisation, and multiplied in float32.
//!
//! Models have a few channels a hundred times as large as the rest. A row that is quantised over the range of all of its
//! elements has few steps left for the others. Which elements are kept apart depends on their row alone.
//!
//! Equation 39 of docs/equations.md.

use crate::aligned::Zeroable;
use crate::simd::{Kernel, Simd};

/// The most elements of a row that are kept apart.
pub(crate) const MAX_OUTLIERS: usize = 8;

/// Elements beyond this many times the mean magnitude of their row are kept apart: normal ones never are, of 6144 products
/// of two normal ones one or two.
///
/// Relative error of the features of a small backbone (8 layers each, widths 288 and 512), all large layers in int8: 0.038,
/// and 0.037 with 12. With channels of down projections planted 50 and 1000 times as large: 0.09 and 0.50, with 12 0.040 and
/// 0.059; of fc2: 0.09 and 0.78, with 12 0.068 and 0.11. Thresholds of 6 and 8, and 4 or 16 elements, change these by less
/// than a tenth.
const THRESHOLD: f32 = 12.0;

/// What is larger is not kept apart: as many products with 127 must not overflow.
const LARGEST: f32 = f32::MAX / (128 * MAX_OUTLIERS) as f32;

/// What is kept apart of a row.
#[derive(Clone, Copy)]
pub(crate) struct Outliers {
    count: u32,
    inputs: [u32; MAX_OUTLIERS],
    values: [f32; MAX_OUTLIERS],
}

// SAFETY: zero bytes are numbers that are zero.
unsafe impl Zeroable for Outliers {}

impl Outliers {
    /// Those of a finite row, given the sum of its magnitudes and the largest one; the magnitude beyond which they are.
    #[inline(always)]
    pub(super) fn of(row: &[f32], sum: f32, largest: f32) -> (Self, f32) {
        let mut found = Self {
            count: 0,
            inputs: [0; MAX_OUTLIERS],
            values: [0.0; MAX_OUTLIERS],
        };
        let limit = THRESHOLD * (sum / row.len() as f32);
        // Not with infinity or NaN; nor where products with bytes could overflow, as those with weights do not.
        let can_be_multiplied = largest < LARGEST;
        if largest <= limit || !can_be_multiplied {
            return (found, f32::INFINITY);
        }
        let limit = limit.max(ninth(row, limit));
        for (input, &value) in row.iter().enumerate() {
            if value.abs() > limit {
                let place = found.count as usize;
                (found.inputs[place], found.values[place]) = (input as u32, value);
                found.count += 1;
            }
        }
        (found, limit)
    }

    /// Input and value of each.
    #[inline(always)]
    pub(crate) fn iter(&self) -> impl Iterator<Item = (usize, f32)> {
        let inputs = self.inputs.iter().zip(&self.values).take(self.count as usize);
        inputs.map(|(&input, &value)| (input as usize, value))
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.count == 0
    }
}

/// The magnitude after the [`MAX_OUTLIERS`] largest ones, as far as it is beyond `limit`.
#[inline(always)]
fn ninth(row: &[f32], limit: f32) -> f32 {
    let mut largest = [limit; MAX_OUTLIERS + 1]; // descending
    for value in row {
        let value = value.abs();
        if value > largest[MAX_OUTLIERS] {
            let place = largest
                .iter()
                .position(|other| value > *other)
                .unwrap_or(MAX_OUTLIERS);
            largest.copy_within(place..MAX_OUTLIERS, place + 1);
            largest[place] = value;
        }
    }
    largest[MAX_OUTLIERS]
}

/// Multiplies the outliers of rows by a panel of bytes or of nibbles.
pub(crate) struct MultiplyOutliers<'a> {
    /// Of each row.
    pub outliers: &'a [Outliers],
    pub panel: &'a [u32],
    pub columns: usize,
    /// Words of a column next to each other in the panel, and whether a word is two words of int8.
    pub run: usize,
    pub has_nibbles: bool,
    /// Rows of `columns` sums, zero at first.
    pub sums: &'a mut [f32],
}

impl Kernel for MultiplyOutliers<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, _: S) {
        let rows = self.outliers.iter().zip(self.sums.chunks_exact_mut(self.columns));
        for (outliers, sums) in rows.filter(|(outliers, _)| !outliers.is_empty()) {
            for (input, value) in outliers.iter() {
                let (run, word) = (self.run, input / 4);
                let (halves, mask) = if self.has_nibbles { (2, !15) } else { (1, !0) };
                let words = &self.panel[word / run / halves * run * self.columns..][..run * self.columns];
                // Of nibbles, words alternate: the low half of each byte, then the high one.
                let is_low_half = self.has_nibbles && (word / run).is_multiple_of(2);
                let shift = 24 - 8 * (input % 4) as u32 + if is_low_half { 4 } else { 0 };
                if run == 1 {
                    // Words next to each other: compilers make vectors of them.
                    add(sums, words.iter(), shift, mask, value);
                } else {
                    add(sums, words[word % run..].iter().step_by(run), shift, mask, value);
                }
            }
        }
    }
}

/// `sums += value * weight` for the weights that are the bits in `mask` of the byte of these words that ends `shift` bits below
/// the top.
#[inline(always)]
fn add<'a>(sums: &mut [f32], words: impl Iterator<Item = &'a u32>, shift: u32, mask: i32, value: f32) {
    for (sum, word) in sums.iter_mut().zip(words) {
        let weight = (word << shift).cast_signed() >> 24 & mask;
        *sum += value * weight as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(row: &[f32]) -> (Vec<(usize, f32)>, f32) {
        let sum = row.iter().map(|value| value.abs()).sum();
        let largest = row
            .iter()
            .fold(0.0, |largest: f32, value| largest.max(value.abs()));
        let (found, limit) = Outliers::of(row, sum, largest);
        (found.iter().collect(), limit)
    }

    #[test]
    fn a_few_elements_that_are_far_larger_than_the_others() {
        let mut row = vec![1.0_f32; 1000];
        assert_eq!(of(&row), (vec![], f32::INFINITY));
        (row[7], row[900]) = (-50.0, 1e6);
        let (found, _) = of(&row);
        assert_eq!(
            found,
            [(900, 1e6)],
            "next to a very large one, 50 is not far larger than the mean"
        );
        row[900] = 60.0;
        assert_eq!(of(&row).0, [(7, -50.0), (900, 60.0)]);
    }

    #[test]
    fn of_many_the_largest() {
        let mut row = vec![0.01_f32; 4000];
        for index in 0..20 {
            row[100 * index] = 100.0 + index as f32;
        }
        let (found, limit) = of(&row);
        let expected: Vec<(usize, f32)> = (12..20)
            .map(|index| (100 * index, 100.0 + index as f32))
            .collect();
        assert_eq!((found, limit), (expected, 111.0));
        row[1900] = 118.0;
        row[0] = 112.0;
        assert!(of(&row).0.len() <= MAX_OUTLIERS);
        let same = vec![(1_usize, 0.0_f32); 0];
        let mut ties = vec![0.0_f32; 4000];
        (0..9).for_each(|index| ties[index] = 5.0);
        assert_eq!(of(&ties).0, same, "equal ones are treated alike");
        assert_eq!(of(&[0.0; 5]).0, same);
    }
}
