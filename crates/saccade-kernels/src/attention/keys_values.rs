//! Keys and values in the layout that the tiles read, and how they get there.

use std::sync::atomic::{AtomicBool, Ordering};

use crate::aligned::{AlignedBuffer, AllocError};
use crate::isa::Isa;
use crate::pool::parallel_for;
use crate::rows::Rows;
use crate::simd::{Dot, Dots, Kernel, MAX_LANES, Simd, Vector, load};
use crate::weights::Element;

/// Elements from which packing on a second thread pays.
const ELEMENTS_FOR_THREADS: usize = 1 << 16;

/// Keys and values of one sequence, all heads, in the layout that [`attention`](crate::attention()) reads.
///
/// ```
/// use saccade_kernels::{Element, Isa, PackedKeyValues, Rows};
/// let (keys, values) = ([1.0; 12], [2.0; 12]); // three keys of two heads of width 2
/// let mut kv = PackedKeyValues::new(Isa::best(), Element::Bf16, 2, 2);
/// kv.pack(1, Rows::new(&keys, 4), Rows::new(&values, 4)).unwrap();
/// assert_eq!(kv.len(), 3);
/// ```
pub struct PackedKeyValues {
    isa: Isa,
    element: Element,
    num_kv_heads: usize,
    head_dim: usize,
    len: usize,
    /// Keys that each head has room for.
    capacity: usize,
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
    pub fn new(isa: Isa, element: Element, num_kv_heads: usize, head_dim: usize) -> Self {
        assert!(head_dim > 0, "head_dim: expected at least 1");
        isa.check();
        assert!(
            matches!(element, Element::F32 | Element::Bf16),
            "element: expected F32 or Bf16, got {element:?}"
        );
        let empty = AlignedBuffer::empty;
        Self {
            isa,
            element,
            num_kv_heads,
            head_dim,
            len: 0,
            capacity: 0,
            keys: empty(),
            values: empty(),
            finite: true,
        }
    }

    /// Replaces what is held by `keys` and `values`, `(len, num_kv_heads * head_dim)` each, row-major with any row stride.
    /// Memory is claimed only if this needs more than ever before.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory; nothing is held then.
    ///
    /// # Panics
    /// If a shape does not fit.
    pub fn pack(&mut self, threads: usize, keys: Rows<'_>, values: Rows<'_>) -> Result<(), AllocError> {
        (self.len, self.capacity) = (0, 0);
        self.finite = true;
        let needed = (
            self.num_kv_heads * self.keys_of_head(keys.num_rows()),
            self.num_kv_heads * self.values_of_head(keys.num_rows()),
        );
        grow(&mut self.keys, needed.0)?;
        grow(&mut self.values, needed.1)?;
        (self.len, self.capacity) = (keys.num_rows(), keys.num_rows());
        self.pack_from(threads, 0, keys, values);
        Ok(())
    }

    /// Replaces the keys and values from number `first` on, all of them to the end, as [`Self::pack`] does; those before it stay.
    ///
    /// # Panics
    /// If a shape does not fit.
    pub fn pack_from(&mut self, threads: usize, first: usize, keys: Rows<'_>, values: Rows<'_>) {
        let width = self.num_kv_heads * self.head_dim;
        let rows = keys.num_rows();
        assert_eq!(
            first + rows,
            self.len,
            "keys: expected all that are held from number {first} on"
        );
        assert_eq!(
            keys.num_columns(),
            width,
            "keys: expected num_kv_heads * head_dim columns"
        );
        assert_eq!(
            (values.num_rows(), values.num_columns()),
            (rows, width),
            "values: expected the shape of keys"
        );
        if rows == 0 || width == 0 {
            return;
        }
        let (keys_size, values_size) = (
            self.keys_of_head(self.capacity),
            self.values_of_head(self.capacity),
        );
        let finite = AtomicBool::new(true);
        let job = Pack {
            keys,
            values,
            first,
            keys_to: self.keys.as_mut_ptr(),
            values_to: self.values.as_mut_ptr(),
            head_dim: self.head_dim,
        };
        let (isa, element) = (self.isa, self.element);
        let threads = if 2 * rows * width < ELEMENTS_FOR_THREADS {
            1
        } else {
            threads
        };
        parallel_for(threads, self.num_kv_heads, &|head| {
            // SAFETY: heads write their own parts of the two buffers, which have room for all of them.
            let head = unsafe {
                Head {
                    job: &job,
                    head,
                    keys_to: std::slice::from_raw_parts_mut(job.keys_to.add(head * keys_size), keys_size),
                    values_to: std::slice::from_raw_parts_mut(
                        job.values_to.add(head * values_size),
                        values_size,
                    ),
                }
            };
            let head_is_finite = match element {
                Element::Bf16 => isa.run(PairHead(head)),
                _ => isa.run(WordHead(head)),
            };
            if !head_is_finite {
                finite.store(false, Ordering::Relaxed);
            }
        });
        self.finite &= finite.into_inner();
    }

    /// Adds `keys` and `values` after those that are held, as [`Self::pack`] would hold all of them together.
    ///
    /// Where there is no room left, room for twice as many is made; [`Self::reserve`] makes it ahead.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory; what was held then stays.
    ///
    /// # Panics
    /// If a shape does not fit.
    pub fn append(&mut self, threads: usize, keys: Rows<'_>, values: Rows<'_>) -> Result<(), AllocError> {
        let (first, len) = (self.len, self.len + keys.num_rows());
        if len > self.capacity {
            self.reserve(len.max(2 * self.capacity))?;
        }
        self.len = len;
        self.pack_from(threads, first, keys, values);
        Ok(())
    }

    /// Makes room for `capacity` keys, so that [`Self::append`] allocates nothing up to there. [`Self::pack`] gives it up.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory; what was held then stays.
    pub fn reserve(&mut self, capacity: usize) -> Result<(), AllocError> {
        if capacity <= self.capacity {
            return Ok(());
        }
        let keys = (self.keys_of_head(self.capacity), self.keys_of_head(capacity));
        let values = (self.values_of_head(self.capacity), self.values_of_head(capacity));
        let [keys, values] = [(&self.keys, keys), (&self.values, values)].map(|(from, (old, new))| {
            let mut to = AlignedBuffer::zeroed(self.num_kv_heads * new)?;
            for head in 0..self.num_kv_heads {
                to[head * new..][..old].copy_from_slice(&from[head * old..][..old]);
            }
            Ok(to)
        });
        (self.keys, self.values) = (keys?, values?);
        self.capacity = capacity;
        Ok(())
    }

    /// A copy.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory.
    pub fn try_clone(&self) -> Result<Self, AllocError> {
        Ok(Self {
            keys: self.keys.try_clone()?,
            values: self.values.try_clone()?,
            ..*self
        })
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

    /// Number of heads of keys and values.
    #[must_use]
    pub fn num_kv_heads(&self) -> usize {
        self.num_kv_heads
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

    /// Words of one head's keys, where there is room for `capacity` of them.
    fn keys_of_head(&self, capacity: usize) -> usize {
        capacity.next_multiple_of(self.isa.vectors().lanes) * self.head_dim.div_ceil(self.step())
    }

    /// Words of one head's values, where there is room for `capacity` of them.
    fn values_of_head(&self, capacity: usize) -> usize {
        capacity.div_ceil(self.step()) * self.value_width()
    }

    /// Words from one step of keys to the next in the values.
    pub(super) fn value_width(&self) -> usize {
        self.head_dim.next_multiple_of(self.isa.vectors().lanes)
    }

    /// The keys of one head.
    pub(super) fn head_keys(&self, head: usize) -> &[u32] {
        let size = self.keys_of_head(self.capacity);
        &self.keys[head * size..(head + 1) * size]
    }

    /// The values of one head.
    pub(super) fn head_values(&self, head: usize) -> &[u32] {
        let size = self.values_of_head(self.capacity);
        &self.values[head * size..(head + 1) * size]
    }

    /// Whether all values are finite numbers.
    pub(super) fn is_finite(&self) -> bool {
        self.finite
    }
}

fn grow(buffer: &mut AlignedBuffer<u32>, elements: usize) -> Result<(), AllocError> {
    if buffer.len() < elements {
        *buffer = AlignedBuffer::zeroed(elements)?;
    }
    Ok(())
}

struct Pack<'a> {
    keys: Rows<'a>,
    values: Rows<'a>,
    /// Number of the first key given.
    first: usize,
    keys_to: *mut u32,
    values_to: *mut u32,
    head_dim: usize,
}

// SAFETY: tasks read the views and write different heads of the buffers.
unsafe impl Sync for Pack<'_> {}

/// One head to pack; the result is whether its values are all finite.
struct Head<'a> {
    job: &'a Pack<'a>,
    head: usize,
    keys_to: &'a mut [u32],
    values_to: &'a mut [u32],
}

/// As float32.
struct WordHead<'a>(Head<'a>);

/// As pairs of bfloat16.
struct PairHead<'a>(Head<'a>);

impl Kernel for WordHead<'_> {
    type Output = bool;

    #[inline(always)]
    unsafe fn run<S: Simd>(self, _: S) -> bool {
        // SAFETY: called within `Simd::run`.
        unsafe { self.0.pack::<S, S::Vector, Words>() }
    }
}

impl Kernel for PairHead<'_> {
    type Output = bool;
    const DOTS: Option<Dot> = Some(Dot::Bf16);

    #[inline(always)]
    unsafe fn run<S: Simd>(self, _: S) -> bool {
        // SAFETY: called within `Simd::run`.
        unsafe { self.0.pack::<S, S::Vector, Pairs>() }
    }
}

/// How elements become words.
///
/// # Safety
/// Every method is called within [`Simd::run`] of `S`, with pointers to as many elements as it names, and room for a vector of words.
trait Store<S: Simd> {
    /// Elements in a word.
    const STEP: usize;

    /// The first `count` elements of a row, at most `LANES * STEP`, as a vector of words, with zeros for the rest.
    unsafe fn along(row: *const f32, count: usize, to: *mut u32);

    /// Element `i` of each of `STEP` rows, or of those that are there, in word `i`: the first `count` elements, at most `LANES`, with zeros
    /// for the rest. Bits in `kept` stay as they are.
    unsafe fn across(rows: [Option<*const f32>; 2], count: usize, kept: u32, to: *mut u32);

    /// Whether all elements of a word are finite.
    fn is_finite(word: u32) -> bool;
}

/// float32.
struct Words;

impl<S: Simd<Vector = V>, V: Vector> Store<S> for Words {
    const STEP: usize = 1;

    #[inline(always)]
    unsafe fn along(row: *const f32, count: usize, to: *mut u32) {
        // SAFETY: the trait's contract; so throughout.
        unsafe { load::<V>(row, count).store(to.cast()) }
    }

    #[inline(always)]
    unsafe fn across(rows: [Option<*const f32>; 2], count: usize, _: u32, to: *mut u32) {
        if let Some(row) = rows[0] {
            // SAFETY: as above.
            unsafe { <Self as Store<S>>::along(row, count, to) }
        }
    }

    #[inline(always)]
    fn is_finite(word: u32) -> bool {
        word & 0x7f80_0000 != 0x7f80_0000
    }
}

/// Pairs of bfloat16.
struct Pairs;

impl<S: Simd<Vector = V>, V: Vector> Store<S> for Pairs {
    const STEP: usize = 2;

    #[inline(always)]
    unsafe fn along(row: *const f32, count: usize, to: *mut u32) {
        // SAFETY: as above.
        unsafe {
            let first = load::<V>(row, V::LANES.min(count));
            let second = load::<V>(row.wrapping_add(V::LANES), count.saturating_sub(V::LANES));
            S::Dots::store_bf16(first, second, to.cast());
        }
    }

    #[inline(always)]
    unsafe fn across(rows: [Option<*const f32>; 2], count: usize, kept: u32, to: *mut u32) {
        let mut halves = [0_u16; 2 * MAX_LANES];
        // SAFETY: as above; two vectors of half the width fit.
        let to = unsafe {
            let [first, second] = rows.map(|row| match row {
                Some(row) => load::<V>(row, count),
                None => V::splat(0.0),
            });
            S::Dots::store_bf16(first, second, halves.as_mut_ptr());
            std::slice::from_raw_parts_mut(to, V::LANES)
        };
        let (low, high) = halves[..2 * V::LANES].split_at(V::LANES);
        for ((word, &low), &high) in to.iter_mut().zip(low).zip(high) {
            *word = *word & kept | u32::from(low) | u32::from(high) << 16;
        }
    }

    #[inline(always)]
    fn is_finite(word: u32) -> bool {
        word & 0x7f80 != 0x7f80 && word & 0x7f80_0000 != 0x7f80_0000
    }
}

impl Head<'_> {
    /// Columns of this head in a row of `of`.
    fn row(&self, of: Rows<'_>, index: usize) -> *const f32 {
        of.as_ptr()
            .wrapping_add(index * of.row_stride())
            .wrapping_add(self.head * self.job.head_dim)
    }

    /// # Safety
    /// Called within [`Simd::run`] of `S`.
    #[inline(always)]
    unsafe fn pack<S: Simd<Vector = V>, V: Vector, W: Store<S>>(mut self) -> bool {
        // SAFETY: the caller's promise.
        unsafe {
            self.pack_keys::<S, V, W>();
            self.pack_values::<S, V, W>()
        }
    }

    /// # Safety
    /// As [`Self::pack`].
    #[inline(always)]
    unsafe fn pack_keys<S: Simd<Vector = V>, V: Vector, W: Store<S>>(&mut self) {
        let (first, head_dim) = (self.job.first, self.job.head_dim);
        let len = first + self.job.keys.num_rows();
        let steps = head_dim.div_ceil(W::STEP);
        for panel in first / V::LANES..len.div_ceil(V::LANES) {
            let keys = panel * V::LANES..(panel + 1) * V::LANES;
            // Lanes before the first key given stay.
            let (start, end) = (first.saturating_sub(keys.start), V::LANES.min(len - keys.start));
            // Words of as many keys, a row a key, to be turned over; zeros for keys beyond the last one.
            let mut square = [[0; MAX_LANES]; MAX_LANES];
            for step in (0..steps).step_by(V::LANES) {
                for (lane, to) in square.iter_mut().enumerate().take(end).skip(start) {
                    let row = self.row(self.job.keys, keys.start + lane - first);
                    let (from, most) = (step * W::STEP, V::LANES * W::STEP);
                    let (row, count) = (row.wrapping_add(from), most.min(head_dim - from));
                    // SAFETY: the row has these elements; the caller has the instruction set.
                    unsafe { W::along(row, count, to.as_mut_ptr()) };
                }
                let to = &mut self.keys_to[(panel * steps + step) * V::LANES..];
                let count = V::LANES.min(steps - step);
                for (word, to) in to.chunks_exact_mut(V::LANES).take(count).enumerate() {
                    for (to, row) in to.iter_mut().zip(&square).skip(start) {
                        *to = row[word];
                    }
                }
            }
        }
    }

    /// # Safety
    /// As [`Self::pack`].
    #[inline(always)]
    unsafe fn pack_values<S: Simd<Vector = V>, V: Vector, W: Store<S>>(&mut self) -> bool {
        let (first, head_dim) = (self.job.first, self.job.head_dim);
        let len = first + self.job.values.num_rows();
        let width = head_dim.next_multiple_of(V::LANES);
        let mut finite = true;
        for step in first / W::STEP..len.div_ceil(W::STEP) {
            let row = |part: usize| {
                let key = step * W::STEP + part;
                (part < W::STEP && first <= key && key < len).then(|| self.row(self.job.values, key - first))
            };
            let rows = [row(0), row(1)];
            // The key before the first one given may share its words: it stays.
            let kept = if step * W::STEP < first { 0xffff } else { 0 };
            for column in (0..head_dim).step_by(V::LANES) {
                let rows = rows.map(|row| row.map(|row| row.wrapping_add(column)));
                let count = V::LANES.min(head_dim - column);
                let to = &mut self.values_to[step * width + column..][..V::LANES];
                // SAFETY: the rows have these elements, and a vector of words fits; the caller has the instruction set.
                unsafe { W::across(rows, count, kept, to.as_mut_ptr()) };
                let infinite = to
                    .iter()
                    .fold(0, |infinite, &word| infinite | u32::from(!W::is_finite(word)));
                finite &= infinite == 0;
            }
        }
        finite
    }
}
