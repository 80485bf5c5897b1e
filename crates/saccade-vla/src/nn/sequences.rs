//! Rows of several sequences.

use std::ops::Range;

use saccade_vla_kernels::Rows;

/// Rows of sequences of one length, one sequence after the other.
#[derive(Clone, Copy)]
pub(crate) struct Sequences<'a> {
    pub rows: Rows<'a>,
    pub count: usize,
    /// Rows of each.
    pub len: usize,
}

impl<'a> Sequences<'a> {
    /// `rows` as `count` sequences.
    ///
    /// # Panics
    /// If they are not whole sequences.
    pub(crate) fn new(rows: Rows<'a>, count: usize) -> Self {
        let len = rows.num_rows() / count;
        assert_eq!(len * count, rows.num_rows(), "rows of {count} sequences");
        Self { rows, count, len }
    }

    /// The rows of some of the sequences.
    pub(crate) fn range(&self, sequences: Range<usize>) -> Range<usize> {
        sequences.start * self.len..sequences.end * self.len
    }

    /// The rows of each run of neighbouring sequences with the same one of `keys`, one for each sequence;
    /// `is_same` says which are.
    pub(crate) fn runs<'k, K>(
        &self,
        keys: &'k [K],
        is_same: impl Fn(&K, &K) -> bool,
    ) -> impl Iterator<Item = (&'k K, Range<usize>)> {
        let (len, mut first) = (self.len, 0);
        keys.chunk_by(is_same).map(move |run| {
            let rows = first..first + run.len() * len;
            first = rows.end;
            (&run[0], rows)
        })
    }
}
