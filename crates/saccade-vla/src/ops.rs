//! Calls of kernels: their interruption, and their refusals as errors.

use saccade_vla_kernels::{AllocError, KernelError};

use crate::error::{Error, Result};
use crate::profile::{Part, counted};

/// Runs `work`, and asks `poll` every 20 ms or so whether to stop it.
///
/// `poll` is called on this thread, between the tasks of every kernel that `work` calls, between blocks and
/// between tensors. Once it returns true, `work` ends soon, however large it is. A head, a layer or a
/// checkpoint that was in use stays usable.
///
/// # Errors
/// [`Error::Interrupted`] if `poll` returned true, otherwise those of `work`.
///
/// ```
/// use saccade_vla::{Error, interruptible};
/// assert_eq!(interruptible(&|| false, || Ok(7)).unwrap(), 7);
/// let stopped = interruptible(&|| true, || Err::<(), _>(Error::Interrupted));
/// assert!(matches!(stopped, Err(Error::Interrupted)));
/// ```
pub fn interruptible<R>(poll: &dyn Fn() -> bool, work: impl FnOnce() -> Result<R>) -> Result<R> {
    saccade_vla_kernels::interruptible(poll, work).unwrap_or(Err(Error::Interrupted))
}

/// Checks that no [`interruptible`] call that this code runs in was cancelled.
///
/// # Errors
/// [`Error::Interrupted`] if one was: results of kernels since then are not to be used.
pub(crate) fn check_interrupted() -> Result<()> {
    if saccade_vla_kernels::interrupted() {
        return Err(Error::Interrupted);
    }
    Ok(())
}

/// Calls a kernel whose work is `(multiply_adds, bytes)`, counted under `part`.
///
/// # Errors
/// [`Error::Interrupted`] if the call was to stop: the result is then not to be used.
pub(crate) fn kernel<R>(part: Option<Part>, work: (usize, usize), call: impl FnOnce() -> R) -> Result<R> {
    let result = counted(part, work, call);
    check_interrupted()?;
    Ok(result)
}

/// The error for memory that a kernel was refused.
pub(crate) fn refused(what: &'static str) -> impl Fn(AllocError) -> Error {
    move |AllocError { bytes }| Error::Memory { what, bytes }
}

/// The error for a layer that was not packed.
pub(crate) fn packing_error(error: KernelError) -> Error {
    match error {
        KernelError::Alloc(error) => refused("weights")(error),
        KernelError::Interrupted(_) => Error::Interrupted,
        other => Error::Packing(other),
    }
}
