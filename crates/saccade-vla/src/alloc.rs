//! Memory whose size a caller decides: asked for, never assumed.

use saccade_vla_kernels::Activations;

use crate::error::{Error, Result};
use crate::ops::{check_interrupted, refused};

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
/// [`Error::Memory`] if the system refuses it, [`Error::Interrupted`].
pub(crate) fn filled<T: Clone>(what: &'static str, len: usize, value: T) -> Result<Vec<T>> {
    let mut buffer = Vec::new();
    reserve(what, &mut buffer, len)?;
    in_stretches(0, len, |len| buffer.resize(len, value.clone()))?;
    Ok(buffer)
}

/// Elements that are written between two looks at whether the call is to stop: the system hands out pages as they are first touched, some
/// four gigabytes in a second.
const TOGETHER: usize = 1 << 24;

/// Calls `resize` with greater and greater lengths from `held` on, the last of which is `len`.
///
/// # Errors
/// [`Error::Interrupted`].
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

/// Sets the length of a buffer that keeps its memory from call to call, for elements that are then written: what they are before depends on
/// earlier calls.
///
/// # Errors
/// [`Error::Memory`] if the system refuses it, [`Error::Interrupted`].
pub(crate) fn sized(buffer: &mut Activations, len: usize) -> Result<&mut [f32]> {
    buffer.reserve(len).map_err(refused("activations"))?;
    in_stretches(buffer.len(), len, |len| buffer.resize(len))?;
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
        let error = sized(&mut buffer, usize::MAX / 8).unwrap_err();
        let expected = format!("activations: cannot allocate {} bytes of memory", usize::MAX);
        assert!(error.to_string().starts_with(&expected), "{error}");
        assert_eq!(sized(&mut buffer, 3).unwrap(), [0.0; 3], "usable afterwards");
    }

    #[test]
    fn filling_stops_when_asked_to() {
        let len = 3 * TOGETHER + 5;
        assert_eq!(filled("features", len, 1_u8).unwrap().len(), len);
        assert!(is_stopped(|| filled("features", len, 1_u8).map(drop)));
    }

    #[test]
    fn sizing_stops_when_asked_to() {
        let (mut buffer, len) = (Activations::new(), TOGETHER + 5);
        assert!(is_stopped(|| sized(&mut buffer, len).map(drop)));
        assert!(buffer.is_empty(), "before anything is written");
        assert_eq!(sized(&mut buffer, len).unwrap().len(), len);
    }

    /// Whether `work` gives up if it is to.
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
