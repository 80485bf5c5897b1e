//! Keys and values on their way into the layout that the tiles read.

use crate::rows::Rows;
use crate::simd::{Dot, Dots, Kernel, MAX_LANES, Simd, Vector, load};

pub(super) struct Pack<'a> {
    pub keys: Rows<'a>,
    pub values: Rows<'a>,
    /// Number of the first key given.
    pub first: usize,
    pub keys_to: *mut u32,
    pub values_to: *mut u32,
    pub head_dim: usize,
    /// Steps of `head_dim` in the keys, with those that pad it.
    pub key_steps: usize,
    /// Steps of keys that values are padded to.
    pub value_group: usize,
}

// SAFETY: tasks read the views and write different heads of the buffers.
unsafe impl Sync for Pack<'_> {}

/// One head to pack; the result is whether its values are all finite.
pub(super) struct Head<'a> {
    pub job: &'a Pack<'a>,
    pub head: usize,
    pub keys_to: &'a mut [u32],
    pub values_to: &'a mut [u32],
}

/// As float32.
pub(super) struct WordHead<'a>(pub Head<'a>);

/// As pairs of bfloat16.
pub(super) struct PairHead<'a>(pub Head<'a>);

impl Kernel for WordHead<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> bool {
        // SAFETY: called within `Simd::run`.
        unsafe { self.0.pack::<S, S::Vector, WordLayout>() }
    }
}

impl Kernel for PairHead<'_> {
    type Output = bool;
    const DOTS: Option<Dot> = Some(Dot::Bf16);

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> bool {
        // SAFETY: called within `Simd::run`.
        unsafe { self.0.pack::<S, S::Vector, PairLayout>() }
    }
}

/// How elements become words.
///
/// # Safety
/// Every method is called within [`Simd::run`] of `S`, with pointers to as many elements as it names, and room for a vector of words.
trait Layout<S: Simd> {
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
struct WordLayout;

impl<S: Simd<Vector = V>, V: Vector> Layout<S> for WordLayout {
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
            unsafe { <Self as Layout<S>>::along(row, count, to) }
        }
    }

    #[inline(always)]
    fn is_finite(word: u32) -> bool {
        word & 0x7f80_0000 != 0x7f80_0000
    }
}

/// PairLayout of bfloat16.
struct PairLayout;

impl<S: Simd<Vector = V>, V: Vector> Layout<S> for PairLayout {
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
    unsafe fn pack<S: Simd<Vector = V>, V: Vector, W: Layout<S>>(mut self) -> bool {
        // SAFETY: the caller's promise.
        unsafe {
            self.pack_keys::<S, V, W>();
            self.pack_values::<S, V, W>()
        }
    }

    /// # Safety
    /// As [`Self::pack`].
    #[inline(always)]
    unsafe fn pack_keys<S: Simd<Vector = V>, V: Vector, W: Layout<S>>(&mut self) {
        let (first, head_dim) = (self.job.first, self.job.head_dim);
        let len = first + self.job.keys.num_rows();
        let steps = self.job.key_steps;
        for panel in first / V::LANES..len.div_ceil(V::LANES) {
            let keys = panel * V::LANES..(panel + 1) * V::LANES;
            // Lanes before the first key given stay.
            let (start, end) = (first.saturating_sub(keys.start), V::LANES.min(len - keys.start));
            // WordLayout of as many keys, a row a key, to be transposed; zeros for keys beyond the last one.
            let mut square = [[0; MAX_LANES]; MAX_LANES];
            for step in (0..steps).step_by(V::LANES) {
                for (lane, to) in square.iter_mut().enumerate().take(end).skip(start) {
                    let row = self.row(self.job.keys, keys.start + lane - first);
                    let (from, most) = (step * W::STEP, V::LANES * W::STEP);
                    let (row, count) = (row.wrapping_add(from), most.min(head_dim.saturating_sub(from)));
                    // SAFETY: the row has these elements; the caller has the instruction set.
                    unsafe { W::along(row, count, to.as_mut_ptr()) };
                }
                let count = V::LANES.min(steps - step);
                let to = &mut self.keys_to[(panel * steps + step) * V::LANES..][..count * V::LANES];
                if start == 0 && count == V::LANES {
                    // SAFETY: the caller has the instruction set.
                    unsafe { V::transpose(&square, to) };
                    continue;
                }
                for (word, to) in to.chunks_exact_mut(V::LANES).enumerate() {
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
    unsafe fn pack_values<S: Simd<Vector = V>, V: Vector, W: Layout<S>>(&mut self) -> bool {
        let (first, head_dim) = (self.job.first, self.job.head_dim);
        let len = first + self.job.values.num_rows();
        let width = head_dim.next_multiple_of(V::LANES);
        let mut finite = true;
        for step in first / W::STEP..len.div_ceil(W::STEP).next_multiple_of(self.job.value_group) {
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
