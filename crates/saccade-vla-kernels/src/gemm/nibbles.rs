//! Weights of four bits. A panel holds two words of int8 in one, and is unpacked a part at a time into the
//! nearest cache, where the instructions of int8 multiply it.
//!
//! A weight `w` from -7 to 7 is unpacked as the byte `16 w`, which takes two operations for two words. Sums are
//! then those of int8 times 16, exactly, and a sixteenth goes into the columns' scales: results have the bits that
//! int8 has with the same weights.

use std::marker::PhantomData;

use super::Gemm;
use super::elements::{Elements, SumVector};
#[allow(
    unused_imports,
    reason = "not every architecture and set of features has tiles"
)]
use super::in_tiles::InTiles;
use super::in_vectors::InVectors;
use super::step::{MicroKernel, Step};
use crate::simd::Simd;
use crate::weights::Element;

/// The elements of int8 `E`, with panels of nibbles.
pub(crate) struct Nibbles<E>(PhantomData<E>);

impl<E: Elements> Elements for Nibbles<E> {
    const NAME: &'static str = "int4";
    const WEIGHTS: Element = Element::Int4;
    const ROWS: super::elements::RowElements = E::ROWS;
    const GROUP: usize = E::GROUP;
    type Sums = E::Sums;
}

impl<L: MicroKernel, E: Step<L>> Step<L> for Nibbles<E> {
    const DEPTH: usize = 2 * E::DEPTH;
    const FEWER_GROUPS: usize = E::FEWER_GROUPS;

    /// Two steps of int8, by weights that are unpacked.
    #[inline(always)]
    unsafe fn multiply_add<S: Simd, const NV: usize, const MR: usize>(
        simd: S,
        sums: &mut [[SumVector<S, Self>; NV]; MR],
        x: &[*const u32; MR],
        step: usize,
        weights: *const u32,
        count: usize,
    ) {
        let words = L::shape::<S, E>().nr * E::DEPTH / E::PER_WORD;
        // SAFETY: the contract of this function; a step has the words of two of int8, and the second is left out
        // where rows have no element of it.
        unsafe {
            E::multiply_add(simd, sums, x, 2 * step, weights, count.min(E::DEPTH));
            if count > E::DEPTH {
                let rest = count - E::DEPTH;
                E::multiply_add(simd, sums, x, 2 * step + 1, weights.add(words), rest);
            }
        }
    }
}

/// A product of int8, which has the same of nibbles.
pub(crate) trait OfInt8 {
    type OfNibbles: Gemm + 'static;
}

impl<S, E, L> OfInt8 for InVectors<S, E, L>
where
    InVectors<S, Nibbles<E>, L>: Gemm + 'static,
{
    type OfNibbles = InVectors<S, Nibbles<E>, L>;
}

impl<U, E> OfInt8 for InTiles<U, E>
where
    InTiles<U, Nibbles<E>>: Gemm + 'static,
{
    type OfNibbles = InTiles<U, Nibbles<E>>;
}
