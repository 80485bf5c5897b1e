//! Calls of kernels: their interruption, and their refusals as errors; work of several threads.

use std::sync::Mutex;

use saccade_vla_kernels::{AllocError, KernelError, parallel_for};

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

/// What `work` returns for each of the tasks `0..tasks`, in their order, on up to `threads` threads.
///
/// # Errors
/// [`Error::Interrupted`] if the call was to stop; otherwise the error of the first task that has one.
pub(crate) fn in_parallel<R: Send>(
    threads: usize,
    tasks: usize,
    work: impl Fn(usize) -> Result<R> + Sync,
) -> Result<Vec<R>> {
    let results: Vec<Mutex<Option<Result<R>>>> = (0..tasks).map(|_| Mutex::new(None)).collect();
    parallel_for(threads, tasks, &|task| {
        *results[task].try_lock().expect("each is one task") = Some(work(task));
    });
    check_interrupted()?;
    let result = |result: Mutex<Option<Result<R>>>| {
        let result = result.into_inner().expect("a task that panics ends the call");
        result.expect("every task ran")
    };
    results.into_iter().map(result).collect()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::bail;

    fn odd(task: usize) -> Result<usize> {
        if task.is_multiple_of(2) {
            bail!(Input, "task"; expected "an odd one"; got "{task}");
        }
        Ok(10 * task)
    }

    #[test]
    fn results_stand_in_the_order_of_the_tasks() {
        for threads in [1, 3] {
            for tasks in [0, 1, 20] {
                let results = in_parallel(threads, tasks, |task| odd(2 * task + 1)).unwrap();
                let expected: Vec<_> = (0..tasks).map(|task| 10 * (2 * task + 1)).collect();
                assert_eq!(results, expected);
            }
        }
    }

    #[test]
    fn the_error_is_that_of_the_first_task_that_has_one() {
        let error = in_parallel(3, 20, |task| odd(task + 5)).unwrap_err();
        assert!(error.to_string().contains("got 6"), "{error}");
    }

    #[test]
    fn work_that_is_to_stop_ends_as_interrupted() {
        let stopped = interruptible(&|| true, || in_parallel(3, 20, odd));
        assert!(matches!(stopped, Err(Error::Interrupted)), "{stopped:?}");
    }
}
