//! Work that several threads share, with a result for each of its tasks.

use std::sync::OnceLock;

use saccade_vla_kernels::parallel_for;

use crate::error::Result;
use crate::ops::check_interrupted;

/// What `work` returns for each of the tasks `0..tasks`, in their order, on up to `threads` threads.
///
/// Whether to stop is asked between tasks: one that has begun on another thread is finished first.
///
/// # Errors
/// [`Error::Interrupted`](crate::Error::Interrupted) if the call was to stop; otherwise the error of the first
/// task that has one.
pub(crate) fn in_parallel<R: Send + Sync>(
    threads: usize,
    tasks: usize,
    work: impl Fn(usize) -> Result<R> + Sync,
) -> Result<Vec<R>> {
    let results: Vec<OnceLock<Result<R>>> = (0..tasks).map(|_| OnceLock::new()).collect();
    parallel_for(threads, tasks, &|task| {
        results[task].get_or_init(|| work(task));
    });
    check_interrupted()?;
    let result = |cell: OnceLock<Result<R>>| cell.into_inner().expect("every task ran");
    results.into_iter().map(result).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    use super::*;
    use crate::error::{Error, bail};
    use crate::ops::interruptible;

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
        for threads in [1, 3] {
            let error = in_parallel(threads, 20, |task| odd(task + 5)).unwrap_err();
            assert!(error.to_string().contains("got 6"), "{error}");
        }
    }

    #[test]
    fn tasks_that_have_not_begun_do_not_run_once_the_call_is_to_stop() {
        for threads in [1, 3] {
            let ran = AtomicUsize::new(0);
            let stopped = interruptible(&|| true, || {
                std::thread::sleep(Duration::from_millis(30)); // until the caller is asked
                let result = in_parallel(threads, 1000, |task| {
                    ran.fetch_add(1, Ordering::Relaxed);
                    Ok(task)
                });
                assert!(matches!(result, Err(Error::Interrupted)), "{result:?}");
                result
            });
            assert!(stopped.is_err());
            assert!(ran.into_inner() < 1000);
        }
    }
}
