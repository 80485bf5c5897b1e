//! Keys and values in the layout that the tiles read: packed, appended to, replaced from a key on.

use std::sync::atomic::{AtomicBool, Ordering};

use super::pack::{Head, PackBf16, PackF32};
use crate::aligned::{AlignedBuffer, AllocError, elements};
use crate::isa::Isa;
use crate::parts::threads_and_tasks;
use crate::pool::parallel_for;
use crate::rows::{Rows, RowsMut, SharedRows};
use crate::tiles::{MAX_ROWS, TILE};
use crate::weights::Element;

/// Keys and values of one sequence, all heads, in the layout that [`attention`](crate::attention()) reads: a
/// KV cache.
///
/// ```
/// use saccade_vla_kernels::{Element, Isa, PackedKeyValues, Rows};
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
    /// `[head][vector of keys][step of head_dim][lane]`; lanes beyond the last key are zero. A word is an
    /// f32, or a pair of bf16, the even element in its low half: then a step is two elements, and an odd
    /// `head_dim` is padded with zero. In tiles the steps of keys, and the steps of `head_dim`, are padded to
    /// multiples of 16.
    keys: AlignedBuffer<u32>,
    /// `[head][step of keys][head_dim]`, each row padded with zeros to whole vectors; words as in `keys`,
    /// pairs being of two keys.
    values: AlignedBuffer<u32>,
    /// Zero times any value is zero: removed keys need no care in the product.
    finite: bool,
}

impl PackedKeyValues {
    /// An empty KV cache. Keys and values will be stored as `element`s: as they come, or rounded to bfloat16
    /// in half the memory.
    ///
    /// # Panics
    /// If this CPU lacks `isa`, `head_dim` is 0, `num_kv_heads * head_dim` is more than memory can have, or
    /// `element` is neither [`Element::F32`] nor [`Element::Bf16`].
    #[must_use]
    pub fn new(isa: Isa, element: Element, num_kv_heads: usize, head_dim: usize) -> Self {
        assert!(head_dim > 0, "head_dim: expected at least 1");
        // The sizes of a head and of all of them are multiplied without checks from here on, and padded by
        // less than the 2 bits left.
        assert!(
            num_kv_heads
                .max(1)
                .checked_mul(head_dim)
                .is_some_and(|width| width <= usize::MAX >> 2),
            "num_kv_heads, head_dim: expected sizes whose product memory can have, got {num_kv_heads} and {head_dim}"
        );
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

    /// Replaces what is held by `keys` and `values`, `(len, num_kv_heads * head_dim)` each, row-major with
    /// any row stride. Memory is claimed only if this needs more than ever before.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory; nothing is held then.
    ///
    /// # Panics
    /// If a shape does not fit.
    pub fn pack(&mut self, threads: usize, keys: Rows<'_>, values: Rows<'_>) -> Result<(), AllocError> {
        (self.len, self.capacity) = (0, 0);
        self.finite = true;
        let (keys_size, values_size) = self.sizes_of_head(keys.num_rows())?;
        grow(&mut self.keys, elements(self.num_kv_heads, keys_size)?)?;
        grow(&mut self.values, elements(self.num_kv_heads, values_size)?)?;
        (self.len, self.capacity) = (keys.num_rows(), keys.num_rows());
        self.pack_from(threads, 0, keys, values);
        Ok(())
    }

    /// Replaces the keys and values from number `first` on, all of them to the end, as [`Self::pack`] does;
    /// those before it stay.
    ///
    /// # Panics
    /// If a shape does not fit.
    pub fn pack_from(&mut self, threads: usize, first: usize, keys: Rows<'_>, values: Rows<'_>) {
        let width = self.num_kv_heads * self.head_dim;
        let rows = keys.num_rows();
        assert_eq!(
            first.checked_add(rows),
            Some(self.len),
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
        let (key_steps, value_group) = (self.key_steps(), self.value_group());
        let (isa, element, heads, head_dim) = (self.isa, self.element, self.num_kv_heads, self.head_dim);
        let keys_to = SharedRows::new(RowsMut::strided(&mut self.keys, heads, keys_size, keys_size));
        let values_to = SharedRows::new(RowsMut::strided(
            &mut self.values,
            heads,
            values_size,
            values_size,
        ));
        let finite = AtomicBool::new(true);
        // Keys and values.
        let (threads, _) = threads_and_tasks(threads, rows.saturating_mul(2), width, heads);
        parallel_for(threads, heads, &|head| {
            // SAFETY: each head is one task, which runs once.
            let (mut keys_to, mut values_to) = unsafe {
                (
                    keys_to.block(head..head + 1, 0..keys_size),
                    values_to.block(head..head + 1, 0..values_size),
                )
            };
            let columns = head * head_dim..(head + 1) * head_dim;
            let head = Head {
                keys: keys.columns(columns.clone()),
                values: values.columns(columns),
                first,
                key_steps,
                value_group,
                keys_to: keys_to.row_mut(0),
                values_to: values_to.row_mut(0),
            };
            let head_is_finite = match element {
                Element::Bf16 => isa.run(&mut PackBf16(head)),
                _ => isa.run(&mut PackF32(head)),
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
        let first = self.len;
        let len = first
            .checked_add(keys.num_rows())
            .ok_or(AllocError { bytes: usize::MAX })?;
        if len > self.capacity {
            self.reserve(len.max(self.capacity.saturating_mul(2)))?;
        }
        self.len = len;
        self.pack_from(threads, first, keys, values);
        Ok(())
    }

    /// Makes room for `capacity` keys, so that [`Self::append`] allocates nothing up to there.
    ///
    /// [`Self::pack`] keeps the memory, but not the room: reserving again then allocates nothing.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory; what was held then stays.
    pub fn reserve(&mut self, capacity: usize) -> Result<(), AllocError> {
        if capacity <= self.capacity {
            return Ok(());
        }
        let (old_keys, old_values) = self.sizes_of_head(self.capacity)?;
        let (keys, values) = self.sizes_of_head(capacity)?;
        let num_kv_heads = self.num_kv_heads;
        // Both before either is changed.
        let larger_keys = larger(&self.keys, elements(num_kv_heads, keys)?)?;
        let larger_values = larger(&self.values, elements(num_kv_heads, values)?)?;
        if let Some(larger) = larger_keys {
            self.keys = larger;
        }
        if let Some(larger) = larger_values {
            self.values = larger;
        }
        spread(&mut self.keys, num_kv_heads, old_keys, keys);
        spread(&mut self.values, num_kv_heads, old_values, values);
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

    /// A copy of the first `len` keys and values, with room for `capacity`.
    ///
    /// # Errors
    /// [`AllocError`] if there is not enough memory.
    ///
    /// # Panics
    /// If there are fewer keys, or no room for `len`.
    pub fn try_clone_first(&self, len: usize, capacity: usize) -> Result<Self, AllocError> {
        assert!(
            len <= self.len && len <= capacity,
            "len: expected at most {} keys and room for them, got {len} in {capacity}",
            self.len
        );
        let mut copy = Self::new(self.isa, self.element, self.num_kv_heads, self.head_dim);
        copy.reserve(capacity)?;
        (copy.len, copy.finite) = (len, self.finite);
        let lanes = self.isa.vectors().lanes;
        let (panel, width) = (self.keys_of_head(lanes), self.value_width());
        for head in 0..self.num_kv_heads {
            let (keys, values) = (self.head_keys(head), self.head_values(head));
            let (keys_size, values_size) = (copy.keys_of_head(capacity), copy.values_of_head(capacity));
            let keys_to = &mut copy.keys[head * keys_size..][..keys_size];
            let values_to = &mut copy.values[head * values_size..][..values_size];
            let (whole, rest) = (len / lanes * panel, len % lanes);
            keys_to[..whole].copy_from_slice(&keys[..whole]);
            if rest > 0 {
                // Lanes of later keys stay zero.
                let (to, from) = (&mut keys_to[whole..][..panel], &keys[whole..][..panel]);
                for (to, from) in to.chunks_exact_mut(lanes).zip(from.chunks_exact(lanes)) {
                    to[..rest].copy_from_slice(&from[..rest]);
                }
            }
            let steps = len.div_ceil(self.step()) * width;
            values_to[..steps].copy_from_slice(&values[..steps]);
            if !len.is_multiple_of(self.step()) {
                // A word holds two keys: of the last one, a half may stay zero.
                values_to[steps - width..steps]
                    .iter_mut()
                    .for_each(|word| *word &= 0xffff);
            }
        }
        Ok(copy)
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
        capacity.next_multiple_of(self.isa.vectors().lanes) * self.key_steps()
    }

    /// Words of one head's values, where there is room for `capacity` of them.
    fn values_of_head(&self, capacity: usize) -> usize {
        capacity
            .div_ceil(self.step())
            .next_multiple_of(self.value_group())
            * self.value_width()
    }

    /// Words of one head's keys and of its values, where there is room for `capacity` of them.
    fn sizes_of_head(&self, capacity: usize) -> Result<(usize, usize), AllocError> {
        // More than padding adds, also to few keys.
        let padded = capacity.checked_next_multiple_of(2 * TILE);
        let padded = padded.ok_or(AllocError { bytes: usize::MAX })?;
        elements(padded, self.value_width().saturating_mul(4))?;
        Ok((self.keys_of_head(capacity), self.values_of_head(capacity)))
    }

    /// Whether they are multiplied in tiles: then words are padded to whole ones.
    fn is_tiled(&self) -> bool {
        self.element == Element::Bf16 && self.isa.has_tiles()
    }

    /// Steps of `head_dim` in the keys, padded with zeros to whole tiles.
    pub(super) fn key_steps(&self) -> usize {
        let steps = self.head_dim.div_ceil(self.step());
        if self.is_tiled() {
            steps.next_multiple_of(TILE)
        } else {
            steps
        }
    }

    /// Steps of keys that values are padded to, with zeros.
    fn value_group(&self) -> usize {
        if self.is_tiled() { TILE } else { 1 }
    }

    /// Queries that are taken together at most.
    pub(super) fn tile_rows(&self) -> usize {
        if self.is_tiled() {
            MAX_ROWS
        } else {
            self.isa.vectors().tile_rows
        }
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

fn grow(buffer: &mut AlignedBuffer<u32>, len: usize) -> Result<(), AllocError> {
    if buffer.len() < len {
        // The old one goes first: both need not fit.
        *buffer = AlignedBuffer::empty();
        *buffer = AlignedBuffer::zeroed(len)?;
    }
    Ok(())
}

/// A copy of at least `len` words, where `buffer` has fewer.
fn larger(buffer: &AlignedBuffer<u32>, len: usize) -> Result<Option<AlignedBuffer<u32>>, AllocError> {
    if buffer.len() >= len {
        return Ok(None);
    }
    let mut copy = AlignedBuffer::zeroed(len)?;
    copy[..buffer.len()].copy_from_slice(buffer);
    Ok(Some(copy))
}

/// Moves `count` parts of `old` words each to multiples of `new`, which is more.
fn spread(buffer: &mut [u32], count: usize, old: usize, new: usize) {
    for index in (1..count).rev() {
        buffer.copy_within(index * old..(index + 1) * old, index * new);
    }
}
