//! Memory whose size a caller decides: asked for, never assumed. What the system refuses is
//! [`Error::Memory`]; what takes long can be interrupted.

use saccade_vla_kernels::{AlignedVec, Rows, RowsMut};

use crate::array;
use crate::error::{Error, Result};
use crate::ops::{check_interrupted, refused};

/// Makes room for `len` elements in all.
pub(crate) fn reserve<T>(what: &'static str, buffer: &mut Vec<T>, len: usize) -> Result<()> {
    let more = len.saturating_sub(buffer.len());
    buffer.try_reserve_exact(more).map_err(|_| Error::Memory {
        what,
        bytes: len.saturating_mul(size_of::<T>()),
    })
}

/// An empty vector with room for `len` elements.
pub(crate) fn reserved<T>(what: &'static str, len: usize) -> Result<Vec<T>> {
    let mut buffer = Vec::new();
    reserve(what, &mut buffer, len)?;
    Ok(buffer)
}

/// `len` times `value`.
pub(crate) fn filled<T: Clone>(what: &'static str, len: usize, value: T) -> Result<Vec<T>> {
    let mut buffer = reserved(what, len)?;
    in_stretches(0, len, |len| buffer.resize(len, value.clone()))?;
    Ok(buffer)
}

/// Elements written between two checks for interruption: the system hands out pages as they are first
/// touched, some four gigabytes in a second.
const TOGETHER: usize = 1 << 24;

/// Calls `resize` with greater and greater lengths from `held` on, the last of which is `len`.
fn in_stretches(mut held: usize, len: usize, mut resize: impl FnMut(usize)) -> Result<()> {
    while held + TOGETHER < len {
        check_interrupted()?;
        held += TOGETHER;
        resize(held);
    }
    resize(len);
    Ok(())
}

/// The elements of `values`, of which there are `len`.
pub(crate) fn collected<T>(
    what: &'static str,
    len: usize,
    values: impl IntoIterator<Item = T>,
) -> Result<Vec<T>> {
    let mut buffer = reserved(what, len)?;
    buffer.extend(values);
    Ok(buffer)
}

/// A copy of rows.
pub(crate) fn copied(what: &'static str, rows: Rows<'_>) -> Result<Vec<f32>> {
    let mut buffer = reserved(what, rows.num_rows() * rows.num_columns())?;
    rows.iter().for_each(|row| buffer.extend_from_slice(row));
    Ok(buffer)
}

/// Memory for rows of one call, kept for later calls. The rows are there to be written: what they hold at
/// first depends on earlier calls.
#[derive(Default)]
pub(crate) struct Scratch {
    memory: AlignedVec,
    num_rows: usize,
    num_columns: usize,
}

impl Scratch {
    /// Gives the rows this shape.
    pub(crate) fn rows(&mut self, num_rows: usize, num_columns: usize) -> Result<RowsMut<'_>> {
        self.slice(product("activations", &[num_rows, num_columns])?)?;
        (self.num_rows, self.num_columns) = (num_rows, num_columns);
        Ok(self.as_rows_mut())
    }

    /// Gives it this many elements, as one row.
    pub(crate) fn slice(&mut self, len: usize) -> Result<&mut [f32]> {
        (self.num_rows, self.num_columns) = (0, 0);
        self.memory.reserve(len).map_err(refused("activations"))?;
        in_stretches(self.memory.len(), len, |len| self.memory.resize(len))?;
        (self.num_rows, self.num_columns) = (1, len);
        Ok(&mut self.memory)
    }

    /// The rows as they were last shaped.
    pub(crate) fn as_rows(&self) -> Rows<'_> {
        Rows::strided(&self.memory, self.num_rows, self.num_columns, self.num_columns)
    }

    /// The rows as they were last shaped, to be written.
    pub(crate) fn as_rows_mut(&mut self) -> RowsMut<'_> {
        RowsMut::strided(
            &mut self.memory,
            self.num_rows,
            self.num_columns,
            self.num_columns,
        )
    }

    /// The elements of all rows, to be written.
    pub(crate) fn as_mut_slice(&mut self) -> &mut [f32] {
        &mut self.memory
    }

    /// The elements of all rows.
    pub(crate) fn as_slice(&self) -> &[f32] {
        &self.memory
    }
}

/// The product of `sizes`.
///
/// # Errors
/// [`Error::Memory`] if it is beyond what can be addressed.
pub(crate) fn product(what: &'static str, sizes: &[usize]) -> Result<usize> {
    array::product(sizes).ok_or(Error::Memory {
        what,
        bytes: usize::MAX,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_says_how_much_was_asked_for() {
        let error = filled("features", usize::MAX / 8, 0.0_f32).unwrap_err();
        let expected = format!("features: cannot allocate {} bytes of memory", usize::MAX / 8 * 4);
        assert!(error.to_string().starts_with(&expected), "{error}");
        let mut scratch = Scratch::default();
        let error = scratch.slice(usize::MAX / 8).unwrap_err();
        let expected = format!(
            "activations: cannot allocate {} bytes of memory",
            usize::MAX / 8 * 4
        );
        assert!(error.to_string().starts_with(&expected), "{error}");
        assert_eq!(scratch.slice(3).unwrap(), [0.0; 3], "usable afterwards");
    }

    #[test]
    fn scratch_rows_keep_their_shape() {
        let mut scratch = Scratch::default();
        scratch.rows(2, 3).unwrap().row_mut(1).fill(5.0);
        assert_eq!(
            (scratch.as_rows().num_rows(), scratch.as_rows().row(1)),
            (2, &[5.0; 3][..])
        );
        assert!(scratch.rows(usize::MAX, 2).is_err());
        assert_eq!(scratch.rows(4, 0).unwrap().num_rows(), 4);
    }

    #[test]
    fn filling_stops_when_asked_to() {
        let len = 3 * TOGETHER + 5;
        assert_eq!(filled("features", len, 1_u8).unwrap().len(), len);
        assert!(is_stopped(|| filled("features", len, 1_u8).map(drop)));
    }

    #[test]
    fn sizing_stops_when_asked_to() {
        let (mut scratch, len) = (Scratch::default(), TOGETHER + 5);
        assert!(is_stopped(|| scratch.slice(len).map(drop)));
        assert!(scratch.as_slice().is_empty(), "before anything is written");
        assert_eq!(scratch.slice(len).unwrap().len(), len);
    }

    /// True if a cancelled `work` gives up.
    fn is_stopped(work: impl FnOnce() -> Result<()>) -> bool {
        let stopped = crate::interruptible(&|| true, || {
            std::thread::sleep(std::time::Duration::from_millis(30));
            work()
        });
        matches!(stopped, Err(Error::Interrupted))
    }

    #[test]
    fn products_do_not_wrap() {
        assert_eq!(product("noise", &[2, 3, 4]).unwrap(), 24);
        assert_eq!(product("noise", &[]).unwrap(), 1);
        assert!(product("noise", &[usize::MAX, 2]).is_err());
    }
}
