//! Products in the vectors of an instruction set.

use std::marker::PhantomData;
use std::mem::MaybeUninit;

use super::convert::Convert;
use super::elements::Elements;
use super::name::{Joined, join};
use super::nibbles::{NAME_INT4, has_nibbles, packed_words};
use super::outliers::MultiplyOutliers;
use super::step::{MicroKernel, RunsOn, Step};
use super::{Block, Conversion, Gemm, PanelMut, Shape, pack};
use crate::simd::{Kernel, Simd};
use crate::weights::{Element, WeightRef};

/// Products of `E` in the vectors of `S` by the micro-kernel `L`.
pub(crate) struct InVectors<S, E, L = super::broadcast::Broadcast> {
    simd: S,
    /// Whether panels are of int4.
    has_nibbles: bool,
    kinds: PhantomData<(E, L)>,
}

impl<S: Simd, E: Step<L>, L: MicroKernel> InVectors<S, E, L> {
    const JOINED: Joined = match E::WEIGHTS {
        Element::Int8 => join(S::NAME, S::DOT_NAME, E::NAME),
        _ => join(S::NAME, "", E::NAME),
    };
    const NAME: &'static str = Joined::as_str(&Self::JOINED);
    const JOINED_INT4: Joined = join(S::NAME, S::DOT_NAME, NAME_INT4);
    const NAME_INT4: &'static str = Joined::as_str(&Self::JOINED_INT4);
}

// SAFETY: the micro-kernel writes the sums, and its shape is constant.
unsafe impl<S: Simd, E: RunsOn<S, L>, L: MicroKernel> Gemm for InVectors<S, E, L> {
    fn new(weights: Element) -> Option<Self> {
        let has_nibbles = has_nibbles::<E>(weights);
        S::new().map(|simd| Self {
            simd,
            has_nibbles,
            kinds: PhantomData,
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
        L::shape::<S, E>()
    }

    fn panel_words(&self, in_features: usize) -> usize {
        let words = E::DEPTH / E::PER_WORD * in_features.div_ceil(E::DEPTH);
        let packed = if self.has_nibbles {
            packed_words(words, E::GROUP)
        } else {
            words
        };
        self.shape().nr * packed
    }

    fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
        pack::pack::<E>(weight, first, self.shape().nr, self.has_nibbles, panel);
    }

    fn converted_stride(&self, in_features: usize) -> Option<usize> {
        E::converted_stride(in_features)
    }

    fn convert(&self, conversion: Conversion<'_>) {
        self.simd.run(&mut Convert::<E>::new(conversion));
    }

    fn multiply(&self, block: &Block<'_>, sums: &mut [MaybeUninit<u32>]) {
        let row_words = E::converted_stride(block.in_features).unwrap_or(block.in_features);
        block.check(self.shape(), self.panel_words(block.in_features), row_words, sums);
        const {
            assert!(E::DEPTH == E::Loops::DEPTH && E::FEWER_GROUPS == E::Loops::FEWER_GROUPS);
            assert!(E::PER_WORD == E::Loops::PER_WORD && E::GROUP == E::Loops::GROUP);
        }
        // SAFETY: checked above, and `S` has the instructions because of `RunsOn`: the steps are the same.
        self.simd
            .run(&mut unsafe { Multiply::<E::Loops, L>::new(block, self.has_nibbles, sums) });
    }

    fn multiply_outliers(&self, outliers: MultiplyOutliers<'_>) {
        let (run, has_nibbles) = (E::GROUP, self.has_nibbles);
        self.simd.run(&mut MultiplyOutliers {
            run,
            has_nibbles,
            ..outliers
        });
    }
}

/// The sums of a block.
struct Multiply<'a, 'b, E, L> {
    block: &'a Block<'b>,
    has_nibbles: bool,
    sums: &'a mut [MaybeUninit<u32>],
    kinds: PhantomData<(E, L)>,
}

impl<'a, 'b, E, L> Multiply<'a, 'b, E, L> {
    /// # Safety
    /// As [`MicroKernel::multiply`], of the instruction set that this runs on.
    unsafe fn new(block: &'a Block<'b>, has_nibbles: bool, sums: &'a mut [MaybeUninit<u32>]) -> Self {
        Self {
            block,
            has_nibbles,
            sums,
            kinds: PhantomData,
        }
    }
}

impl<E: Step<L>, L: MicroKernel> Kernel for Multiply<'_, '_, E, L> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        // SAFETY: the constructor's contract.
        unsafe { L::multiply::<S, E>(simd, self.block, self.has_nibbles, self.sums) }
    }
}

#[cfg(feature = "peak")]
impl<S: Simd, E: RunsOn<S, L>, L: MicroKernel> super::PeakLoop for InVectors<S, E, L> {
    fn multiply_for_peak(&self) -> usize {
        // SAFETY: `S` has the instructions because of `RunsOn`.
        self.simd.run(&mut unsafe { Peak::<E, L>::new() })
    }
}

/// The steps of a peak.
#[cfg(feature = "peak")]
struct Peak<E, L>(PhantomData<(E, L)>);

#[cfg(feature = "peak")]
impl<E, L> Peak<E, L> {
    /// # Safety
    /// As [`MicroKernel::multiply_for_peak`], of the instruction set that this runs on.
    unsafe fn new() -> Self {
        Self(PhantomData)
    }
}

#[cfg(feature = "peak")]
impl<E: Step<L>, L: MicroKernel> Kernel for Peak<E, L> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) -> usize {
        // SAFETY: the constructor's contract.
        unsafe { L::multiply_for_peak::<S, E>(simd) }
    }
}
