//! Keys and values in the layout that the tiles read, and how they get there.

use std::sync::atomic::{AtomicBool, Ordering};

use faer::MatRef;
use half::bf16;

use crate::aligned::AlignedBuffer;
use crate::isa::Isa;
use crate::linear::Element;
use crate::pool::parallel_for;
use crate::simd::lanes;

/// Elements from which packing on a second thread pays.
const ELEMENTS_FOR_THREADS: usize = 1 << 16;

/// Keys and values of one sequence, all heads, in the layout that [`attention`](crate::attention()) reads.
///
/// ```
/// use faer::MatRef;
/// use saccade_kernels::{Element, Isa, PackedKeyValues};
/// let (keys, values) = ([1.0; 12], [2.0; 12]); // three keys of two heads of width 2
/// let mut kv = PackedKeyValues::new(Isa::best(), Element::Bf16, 2, 2);
/// kv.pack(1, MatRef::from_row_major_slice(&keys, 3, 4), MatRef::from_row_major_slice(&values, 3, 4));
/// assert_eq!(kv.len(), 3);
/// ```
#[derive(Clone)]
pub struct PackedKeyValues {
    isa: Isa,
    element: Element,
    num_heads: usize,
    head_dim: usize,
    len: usize,
    /// `[head][vector of keys][step of head_dim][lane]`; lanes beyond the last key are zero. A word is an f32, or a pair of bf16, the
    /// even element in its low half: then a step is two elements, and an odd `head_dim` is padded with zero.
    keys: AlignedBuffer<u32>,
    /// `[head][step of keys][head_dim]`, each row padded with zeros to whole vectors; words as in `keys`, pairs being of two keys.
    values: AlignedBuffer<u32>,
    /// Zero times any value is zero: removed keys need no care in the product.
    finite: bool,
}

impl PackedKeyValues {
    /// Holds no key yet. Keys and values will be held as `element`s: as they come, or rounded to bfloat16 in half the memory.
    ///
    /// # Panics
    /// If this CPU lacks `isa`, `head_dim` is 0, or `element` is neither [`Element::F32`] nor [`Element::Bf16`].
    #[must_use]
    pub fn new(isa: Isa, element: Element, num_heads: usize, head_dim: usize) -> Self {
        assert!(head_dim > 0, "head_dim: expected at least 1");
        assert!(isa.is_available(), "this CPU lacks {isa}");
        assert!(
            matches!(element, Element::F32 | Element::Bf16),
            "element: expected F32 or Bf16, got {element:?}"
        );
        let empty = || AlignedBuffer::zeroed(0);
        Self {
            isa,
            element,
            num_heads,
            head_dim,
            len: 0,
            keys: empty(),
            values: empty(),
            finite: true,
        }
    }

    /// Replaces what is held by `keys` and `values`, `(len, num_heads * head_dim)` each, row-major with any row stride.
    /// Memory is claimed only if this needs more than ever before.
    ///
    /// # Panics
    /// If a shape does not fit, or columns are not contiguous.
    pub fn pack(&mut self, threads: usize, keys: MatRef<'_, f32>, values: MatRef<'_, f32>) {
        self.len = keys.nrows();
        let (keys_size, values_size) = (self.keys_of_head(), self.values_of_head());
        reserve(&mut self.keys, self.num_heads * keys_size);
        reserve(&mut self.values, self.num_heads * values_size);
        self.finite = true;
        self.pack_from(threads, 0, keys, values);
    }

    /// Replaces the keys and values from number `first` on, all of them to the end, as [`Self::pack`] does; those before it stay.
    ///
    /// # Panics
    /// If a shape does not fit, or columns are not contiguous.
    pub fn pack_from(
        &mut self,
        threads: usize,
        first: usize,
        keys: MatRef<'_, f32>,
        values: MatRef<'_, f32>,
    ) {
        let width = self.num_heads * self.head_dim;
        let rows = keys.nrows();
        assert_eq!(
            first + rows,
            self.len,
            "keys: expected all that are held from number {first} on"
        );
        assert_eq!(keys.ncols(), width, "keys: expected num_heads * head_dim columns");
        assert_eq!(
            (values.nrows(), values.ncols()),
            (rows, width),
            "values: expected the shape of keys"
        );
        assert!(
            keys.col_stride() == 1 || width <= 1,
            "keys: expected contiguous rows"
        );
        assert!(
            values.col_stride() == 1 || width <= 1,
            "values: expected contiguous rows"
        );
        if rows == 0 || width == 0 {
            return;
        }
        let (keys_size, values_size) = (self.keys_of_head(), self.values_of_head());
        let finite = AtomicBool::new(true);
        let job = Pack {
            keys,
            values,
            first,
            keys_to: self.keys.as_mut_ptr(),
            values_to: self.values.as_mut_ptr(),
            lanes: lanes(self.isa),
            head_dim: self.head_dim,
        };
        let element = self.element;
        let threads = if 2 * rows * width < ELEMENTS_FOR_THREADS {
            1
        } else {
            threads
        };
        parallel_for(threads, self.num_heads, &|head| {
            // SAFETY: heads write their own parts of the two buffers, which have room for all of them.
            let head_is_finite = unsafe {
                match element {
                    Element::Bf16 => job.head::<bf16>(head, keys_size, values_size),
                    _ => job.head::<f32>(head, keys_size, values_size),
                }
            };
            if !head_is_finite {
                finite.store(false, Ordering::Relaxed);
            }
        });
        self.finite &= finite.into_inner();
    }

    /// Number of keys.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it holds no key.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Number of heads.
    #[must_use]
    pub fn num_heads(&self) -> usize {
        self.num_heads
    }

    /// Width of a head's queries, keys and values.
    #[must_use]
    pub fn head_dim(&self) -> usize {
        self.head_dim
    }

    /// How keys and values are held.
    #[must_use]
    pub fn element(&self) -> Element {
        self.element
    }

    /// The instruction set whose layout this is.
    #[must_use]
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Bytes held.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        size_of::<u32>() * (self.keys.len() + self.values.len())
    }

    /// Elements in a word.
    fn step(&self) -> usize {
        match self.element {
            Element::Bf16 => 2,
            _ => 1,
        }
    }

    /// Words of one head's keys.
    fn keys_of_head(&self) -> usize {
        self.len.next_multiple_of(lanes(self.isa)) * self.head_dim.div_ceil(self.step())
    }

    /// Words of one head's values.
    fn values_of_head(&self) -> usize {
        self.len.div_ceil(self.step()) * self.value_width()
    }

    /// Words from one step of keys to the next in the values.
    pub(super) fn value_width(&self) -> usize {
        self.head_dim.next_multiple_of(lanes(self.isa))
    }

    /// The keys of one head.
    pub(super) fn head_keys(&self, head: usize) -> &[u32] {
        let size = self.keys_of_head();
        &self.keys[head * size..(head + 1) * size]
    }

    /// The values of one head.
    pub(super) fn head_values(&self, head: usize) -> &[u32] {
        let size = self.values_of_head();
        &self.values[head * size..(head + 1) * size]
    }

    /// Whether all values are finite numbers.
    pub(super) fn is_finite(&self) -> bool {
        self.finite
    }
}

fn reserve(buffer: &mut AlignedBuffer<u32>, elements: usize) {
    if buffer.len() < elements {
        *buffer = AlignedBuffer::zeroed(elements);
    }
}

/// An element as it is held: `STEP` of them in a word.
trait Held {
    const STEP: usize;

    /// The bits of `x`, to be shifted to its place in a word.
    fn bits(x: f32) -> u32;

    /// Whether `bits` are a finite number's.
    fn is_finite(bits: u32) -> bool;
}

impl Held for f32 {
    const STEP: usize = 1;

    #[inline(always)]
    fn bits(x: f32) -> u32 {
        x.to_bits()
    }

    #[inline(always)]
    fn is_finite(bits: u32) -> bool {
        bits & 0x7f80_0000 != 0x7f80_0000
    }
}

impl Held for bf16 {
    const STEP: usize = 2;

    #[inline(always)]
    fn bits(x: f32) -> u32 {
        u32::from(bf16::from_f32(x).to_bits())
    }

    #[inline(always)]
    fn is_finite(bits: u32) -> bool {
        bits & 0x7f80 != 0x7f80
    }
}

/// Puts `bits` where element number `index` of the word's belongs; the other one stays.
#[inline(always)]
fn put<E: Held>(word: &mut u32, index: usize, bits: u32) {
    *word = match (E::STEP, index) {
        (1, _) => bits,
        (_, 0) => *word & 0xffff_0000 | bits,
        _ => *word & 0xffff | bits << 16,
    };
}

struct Pack<'a> {
    keys: MatRef<'a, f32>,
    values: MatRef<'a, f32>,
    /// Number of the first key given.
    first: usize,
    keys_to: *mut u32,
    values_to: *mut u32,
    lanes: usize,
    head_dim: usize,
}

// SAFETY: tasks read the views and write different heads of the buffers.
unsafe impl Sync for Pack<'_> {}

impl Pack<'_> {
    /// Packs one head; returns whether its values are all finite.
    ///
    /// # Safety
    /// The buffers have room for `head + 1` heads of the given sizes, and nobody else touches this one.
    unsafe fn head<E: Held>(&self, head: usize, keys_size: usize, values_size: usize) -> bool {
        // SAFETY: the caller's promise.
        let (keys_to, values_to) = unsafe {
            (
                std::slice::from_raw_parts_mut(self.keys_to.add(head * keys_size), keys_size),
                std::slice::from_raw_parts_mut(self.values_to.add(head * values_size), values_size),
            )
        };
        let (lanes, head_dim) = (self.lanes, self.head_dim);
        let row = |of: MatRef<'_, f32>, key: usize| {
            // SAFETY: the row is in the view, its columns are contiguous, and the head's are among them.
            unsafe {
                let start = of
                    .as_ptr()
                    .offset(key as isize * of.row_stride())
                    .add(head * head_dim);
                std::slice::from_raw_parts(start, head_dim)
            }
        };
        let len = self.first + self.keys.nrows();
        let panel_size = lanes * head_dim.div_ceil(E::STEP);
        for key in self.first..len.next_multiple_of(lanes) {
            let panel = &mut keys_to[key / lanes * panel_size..][..panel_size];
            let to = panel[key % lanes..].iter_mut().step_by(lanes);
            if key < len {
                for (to, from) in to.zip(row(self.keys, key - self.first).chunks(E::STEP)) {
                    *to = E::bits(from[0]);
                    if let Some(&second) = from.get(1) {
                        *to |= E::bits(second) << 16;
                    }
                }
            } else {
                to.for_each(|to| *to = 0);
            }
        }
        let mut finite = true;
        let width = head_dim.next_multiple_of(lanes);
        for key in self.first..len {
            let to = &mut values_to[key / E::STEP * width..][..width];
            for (to, &from) in to.iter_mut().zip(row(self.values, key - self.first)) {
                let bits = E::bits(from);
                finite &= E::is_finite(bits);
                put::<E>(to, key % E::STEP, bits);
            }
            to[head_dim..].fill(0);
        }
        if !len.is_multiple_of(E::STEP) {
            // The last word's other half belongs to no key.
            for to in &mut values_to[len / E::STEP * width..] {
                *to &= 0xffff;
            }
        }
        finite
    }
}
