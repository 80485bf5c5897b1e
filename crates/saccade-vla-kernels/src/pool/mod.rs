//! The private thread pool: one loop over tasks, shared by the caller and by workers that live as long as the process.
//!
//! No thread is started until a call wants more than one. A call puts a [`Job`] on its own stack, offers it in one of a few slots, wakes
//! workers, and takes tasks itself. Tasks are dealt from one counter: whichever thread is free takes the next, so a slow core gets fewer of
//! them. Near the end a worker that is so slow that the others are done without it takes no more. The caller never waits for a
//! worker that has not begun. When no task is left it closes the slot, and waits only for the workers that are still inside.
//!
//! On a machine with more runnable threads than cores, a worker can lose its core within a task; the caller then waits for a tick of the
//! scheduler (4 ms here). It sleeps while it waits, as idle workers do. On Linux a sleeping thread keeps its share of processor time, and
//! runs soon after it is woken, so that caller and workers tend to run at the same time and to pause at the same time. Measured on 2 cores with 2
//! busy processes, 328 tasks of 60 us in 5 loops: 2.12 times as long as alone, where 2.0 is the fair share; 2.5 with a caller that spins and
//! yields.

mod interrupt;
#[cfg(all(test, loom))]
mod models;
mod place;
mod slot;
mod sync;
mod workers;

use std::cell::Cell;
use std::marker::PhantomData;
use std::panic::resume_unwind;
use std::ptr::null_mut;
use std::sync::atomic::{AtomicPtr, Ordering};

pub(crate) use interrupt::is_stopped;
pub use interrupt::{Interrupted, interrupted, interruptible};
#[cfg(feature = "peak")]
pub(crate) use workers::has_room_for_thread;

use interrupt::Scope;
use workers::Workers;

/// The most threads that a call can have: a guard against absurd requests.
pub const MAX_THREADS: usize = 1024;

thread_local! {
    /// Whether this thread is running a task: a loop inside runs on this thread alone.
    static INSIDE: Cell<bool> = const { Cell::new(false) };
    /// How many guards of [`stay_on_this_thread`] there are.
    static STAYS: Cell<usize> = const { Cell::new(0) };
}

/// The workers of this process; null before anyone needed some. Never freed.
static WORKERS: AtomicPtr<Workers> = AtomicPtr::new(null_mut());

/// The workers, made at first use; none where forks would go unnoticed. No lock is involved: in a child of `fork` a lock
/// could be held by a thread that does not exist there.
fn workers() -> Option<&'static Workers> {
    loop {
        // SAFETY: null, or workers that were leaked below.
        if let Some(workers) = unsafe { WORKERS.load(Ordering::Acquire).as_ref() } {
            return Some(workers);
        }
        if !forks::are_noticed() {
            return None;
        }
        let fresh = Box::into_raw(Box::new(Workers::new()));
        if WORKERS
            .compare_exchange(null_mut(), fresh, Ordering::AcqRel, Ordering::Acquire)
            .is_err()
        {
            // SAFETY: another thread was faster; nobody has seen these.
            drop(unsafe { Box::from_raw(fresh) });
        }
    }
}

/// Forks: a child has the memory of the workers but not their threads, so it gets new ones when it needs some.
#[cfg(all(unix, not(saccade_portable)))]
mod forks {
    use std::ptr::null_mut;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::WORKERS;

    /// Whether children of this process will know that they are. A process id would not do: it is used again.
    pub(super) fn are_noticed() -> bool {
        static NOTICED: AtomicBool = AtomicBool::new(false);
        if !NOTICED.load(Ordering::Acquire) {
            // SAFETY: the handler only stores to an atomic, which may be done in a child of a process with threads. Of two
            // handlers the second does nothing.
            let status = unsafe { libc::pthread_atfork(None, None, Some(forget)) };
            NOTICED.store(status == 0, Ordering::Release);
        }
        NOTICED.load(Ordering::Acquire)
    }

    extern "C" fn forget() {
        WORKERS.store(null_mut(), Ordering::Release);
    }
}

/// Where there are no forks, or no system calls.
#[cfg(not(all(unix, not(saccade_portable))))]
mod forks {
    pub(super) fn are_noticed() -> bool {
        true
    }
}

/// Runs `f(task)` for every `task` in `0..tasks`, on up to `threads` threads of which the caller is one.
///
/// Tasks are dealt one by one to threads that are free. With one thread, one task, within a task of another loop, or while there is a
/// guard of [`stay_on_this_thread`], everything runs on the calling thread and nothing is started. The pool belongs to the process
/// and may be used from many threads at once, after `fork`, and with more threads than there are cores. Once its threads
/// run, a call allocates nothing.
///
/// Within [`interruptible`], once it is to stop, the remaining tasks do not run.
///
/// # Panics
/// If a task panics: with the first panic, once all other tasks are done.
///
/// ```
/// use std::sync::atomic::{AtomicUsize, Ordering};
/// let sum = AtomicUsize::new(0);
/// saccade_vla_kernels::parallel_for(2, 5, &|task| {
///     sum.fetch_add(task, Ordering::Relaxed);
/// });
/// assert_eq!(sum.into_inner(), 10);
/// ```
pub fn parallel_for(threads: usize, tasks: usize, f: &(dyn Fn(usize) + Sync)) {
    /// Makes the calling thread one that is running no task.
    struct Outside;

    impl Drop for Outside {
        fn drop(&mut self) {
            INSIDE.set(false);
        }
    }

    let threads = usable(threads).min(tasks).min(MAX_THREADS);
    let workers = if threads > 1 { workers() } else { None };
    Scope::with_current(|scope| match (workers, scope) {
        (None, None) => (0..tasks).for_each(f),
        (None, Some(scope)) => (0..tasks).take_while(|_| !scope.asks_to_stop()).for_each(f),
        (Some(workers), _) => {
            workers.start(threads - 1, || INSIDE.set(true));
            INSIDE.set(true);
            let outside = Outside;
            let asks_to_stop = || scope.is_some_and(Scope::asks_to_stop);
            let outcome = workers.run(threads - 1, tasks, f, scope.map(Scope::flag), asks_to_stop);
            drop(outside);
            if let Err(panic) = outcome {
                resume_unwind(panic);
            }
        }
    });
}

/// The loops that the calling thread starts run on this thread alone, as within a task, until what this returns is dropped.
///
/// For a caller that computes several things at the same time, one on each of its threads. Where every loop is short this is faster than all
/// threads in every loop: nothing waits for the last task of a loop.
///
/// ```
/// use saccade_vla_kernels::{parallel_for, stay_on_this_thread};
/// let _alone = stay_on_this_thread();
/// let here = std::thread::current().id();
/// parallel_for(2, 8, &|_| assert_eq!(std::thread::current().id(), here));
/// ```
pub fn stay_on_this_thread() -> StayOnThisThread {
    STAYS.set(STAYS.get() + 1);
    StayOnThisThread(PhantomData)
}

/// The guard of [`stay_on_this_thread`]. It belongs to the thread that made it; of several, the last one dropped ends it.
#[derive(Debug)]
#[must_use = "loops use other threads again once it is dropped"]
pub struct StayOnThisThread(PhantomData<*const ()>);

impl Drop for StayOnThisThread {
    fn drop(&mut self) {
        STAYS.set(STAYS.get() - 1);
    }
}

/// How many of `threads` threads a loop of the calling thread can have.
pub(crate) fn usable(threads: usize) -> usize {
    if INSIDE.get() || STAYS.get() > 0 {
        1
    } else {
        threads
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;

    /// Told without a clock: a worker that is slow to start must not look like one that is not asked.
    #[test]
    fn a_loop_within_a_task_or_a_guard_has_one_thread() {
        parallel_for(2, 8, &|_| assert_eq!(usable(8), 1));
        let (first, second) = (stay_on_this_thread(), stay_on_this_thread());
        drop(first);
        assert_eq!(usable(8), 1);
        drop(second);
        assert_eq!(usable(8), 8);
    }
}
