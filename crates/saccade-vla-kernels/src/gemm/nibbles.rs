//! Weights of four bits, which products of int8 multiply. Of a panel of them two rows of words, a word for each
//! column or as many as the elements have groups, are one, and are unpacked a few at a time into the nearest cache.
//!
//! A weight `w` from -7 to 7 is unpacked as the byte `16 w`, which takes two operations for two words. Sums are
//! then those of int8 times 16, exactly, and a sixteenth goes into the columns' scales: results have the bits that
//! int8 has with the same weights, unless a sixteenth of a scale is no normal number (below 1.9e-37 the scale).
//!
//! Whether panels are so is known at run time, not by a type: the loops of int8 are most of what this crate compiles,
//! and would be compiled twice.

use std::mem::MaybeUninit;

use super::elements::Elements;
use crate::simd::bits::write_uninit;
use crate::simd::{Kernel, Simd};
use crate::weights::Element;

/// Their part of a kernel's name.
pub(super) const NAME_INT4: &str = "int4";

/// Whether panels of `weights`, which products of `E` multiply, are of int4.
///
/// # Panics
/// If `E` cannot multiply them.
pub(super) fn has_nibbles<E: Elements>(weights: Element) -> bool {
    let has_nibbles = E::ARE_BYTES && weights == Element::Int4;
    assert!(has_nibbles || weights == E::WEIGHTS, "{} by {weights:?}", E::NAME);
    has_nibbles
}

/// Words of a column that `words` of int8, in runs of `group`, are packed to.
pub(super) fn packed_words(words: usize, group: usize) -> usize {
    words.div_ceil(2 * group) * group
}

/// Unpacks rows of a panel, of `row` words each, as twice as many rows of int8.
///
/// # Panics
/// If `row` is not a number of whole vectors, `panel` not one of whole rows, or `to` has no room.
pub(super) struct Unpack<'a> {
    pub panel: &'a [u32],
    pub row: usize,
    pub to: &'a mut [MaybeUninit<u32>],
}

impl Kernel for Unpack<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        assert!(self.row.is_multiple_of(S::LANES), "rows of whole vectors");
        assert!(self.panel.len().is_multiple_of(self.row), "whole rows");
        let to = self.to[..2 * self.panel.len()].chunks_exact_mut(2 * self.row);
        for (words, to) in self.panel.chunks_exact(self.row).zip(to) {
            let (low, high) = to.split_at_mut(self.row);
            let low = low.chunks_exact_mut(S::LANES);
            let vectors = low.zip(high.chunks_exact_mut(S::LANES));
            for (words, (low, high)) in words.chunks_exact(S::LANES).zip(vectors) {
                let words = simd.load_words(words);
                write_uninit(simd.low_nibbles(words), low);
                write_uninit(simd.high_nibbles(words), high);
            }
        }
    }
}
