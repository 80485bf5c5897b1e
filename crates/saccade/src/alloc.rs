//! Memory whose size a caller decides: asked for, never assumed.

use crate::error::{Error, Result};
use crate::ops::check_interrupted;
use saccade_kernels::Activations;

/// Makes room for `len` elements in all.
///
/// # Errors
/// [`Error::Memory`] if the system refuses it.
pub(crate) fn reserve<T>(what: &'static str, buffer: &mut Vec<T>, len: usize) -> Result<()> {
    let more = len.saturating_sub(buffer.len());
    buffer.try_reserve_exact(more).map_err(|_| Error::Memory {
        what,
        bytes: len.saturating_mul(size_of::<T>()),
    })
}

/// `len` times `value`.
///
/// # Errors
/// [`Error::Memory`] if the system refuses it.
pub(crate) fn filled<T: Clone>(what: &'static str, len: usize, value: T) -> Result<Vec<T>> {
    let mut buffer = Vec::new();
    reserve(what, &mut buffer, len)?;
    fill(&mut buffer, len, value)?;
    Ok(buffer)
}

/// Elements that are written between two looks at whether the call is to stop: the system hands out pages as they are first touched, some
/// four gigabytes in a second.
const TOGETHER: usize = 1 << 24;

/// Sets the length of a buffer that has room for it.
fn fill<T: Clone>(buffer: &mut Vec<T>, len: usize, value: T) -> Result<()> {
    while buffer.len() + TOGETHER < len {
        check_interrupted()?;
        buffer.resize(buffer.len() + TOGETHER, value.clone());
    }
    buffer.resize(len, value);
    Ok(())
}

/// The elements of `values`, of which there are `len`.
///
/// # Errors
/// [`Error::Memory`] if the system refuses it.
pub(crate) fn collected<T>(
    what: &'static str,
    len: usize,
    values: impl IntoIterator<Item = T>,
) -> Result<Vec<T>> {
    let mut buffer = Vec::new();
    reserve(what, &mut buffer, len)?;
    buffer.extend(values);
    Ok(buffer)
}

/// Sets the length of a buffer that keeps its memory from call to call. New elements are zero.
///
/// # Errors
/// [`Error::Memory`] if the system refuses it.
pub(crate) fn sized(buffer: &mut Activations, len: usize) -> Result<&mut [f32]> {
    buffer.reserve(len).map_err(|_| Error::Memory {
        what: "activations",
        bytes: len.saturating_mul(size_of::<f32>()),
    })?;
    while buffer.len() + TOGETHER < len {
        check_interrupted()?;
        buffer.resize(buffer.len() + TOGETHER);
    }
    buffer.resize(len);
    Ok(buffer)
}

/// The product of `sizes`.
///
/// # Errors
/// [`Error::Memory`] if it is beyond what can be addressed.
pub(crate) fn product(what: &'static str, sizes: &[usize]) -> Result<usize> {
    let product = sizes
        .iter()
        .try_fold(1_usize, |product, &size| product.checked_mul(size));
    product.ok_or(Error::Memory {
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
        let mut buffer = Activations::new();
        sized(&mut buffer, 3).unwrap().fill(1.0);
        assert!(matches!(
            sized(&mut buffer, usize::MAX / 2),
            Err(Error::Memory { .. })
        ));
        assert_eq!(buffer[..], [1.0; 3], "left as it was");
    }

    #[test]
    fn filling_stops_when_asked_to() {
        let len = 3 * TOGETHER + 5;
        assert_eq!(filled("features", len, 1_u8).unwrap().len(), len);
        let stopped = crate::interruptible(&|| true, || {
            std::thread::sleep(std::time::Duration::from_millis(30));
            filled("features", len, 1_u8)
        });
        assert!(matches!(stopped, Err(Error::Interrupted)));
    }

    #[test]
    fn products_do_not_wrap() {
        assert_eq!(product("noise", &[2, 3, 4]).unwrap(), 24);
        assert_eq!(product("noise", &[]).unwrap(), 1);
        assert!(product("noise", &[usize::MAX, 2]).is_err());
    }
}
