//! Interruption: a caller's question whether to go on, asked between tasks, and the flag that stops the loops of that caller.

use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// A caller is asked at most this often: the question may take a lock of an interpreter.
const EVERY: Duration = Duration::from_millis(20);

/// The caller of [`interruptible`] has asked for an end before the work was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("interrupted")]
pub struct Interrupted;

/// One call of [`interruptible`], on the caller's stack.
pub(super) struct Scope {
    poll: *const dyn Fn() -> bool,
    asked: Cell<Instant>,
    stop: AtomicBool,
    /// The scope that this one is in; null if there is none.
    outer: *const Scope,
}

thread_local! {
    /// The innermost scope of this thread; null if there is none.
    static SCOPE: Cell<*const Scope> = const { Cell::new(std::ptr::null()) };
}

impl Scope {
    /// The innermost scope of this thread.
    pub(super) fn current<'a>() -> Option<&'a Self> {
        // SAFETY: null, or a scope in a frame of this thread's stack that has not returned: leaving it resets the pointer, also on panic.
        // No function keeps the reference for longer than a call within that frame.
        unsafe { SCOPE.get().as_ref() }
    }

    /// Whether loops are to stop. Asks the caller if it was not asked lately.
    pub(super) fn asks_to_stop(&self) -> bool {
        if self.stop.load(Ordering::Relaxed) {
            return true;
        }
        // SAFETY: an outer scope outlives the scopes within it.
        let outer = unsafe { self.outer.as_ref() }.is_some_and(Self::asks_to_stop);
        if !outer && self.asked.get().elapsed() < EVERY {
            return false;
        }
        // Before the question as well as after it: the answer may need loops of its own, and may take long.
        self.asked.set(Instant::now());
        // SAFETY: the function outlives its scope.
        let stop = outer || unsafe { (*self.poll)() };
        self.asked.set(Instant::now());
        if stop {
            self.stop.store(true, Ordering::Relaxed);
        }
        stop
    }

    /// What workers look at.
    pub(super) fn flag(&self) -> &AtomicBool {
        &self.stop
    }
}

/// Whether loops of this thread have been stopped, so that some of their tasks may not have run. Asks nobody.
pub(crate) fn is_stopped() -> bool {
    Scope::current().is_some_and(|scope| scope.stop.load(Ordering::Relaxed))
}

/// Runs `work` on this thread, and asks `poll` every 20 ms or so whether to stop it.
///
/// `poll` is called on this thread only: before and between the tasks of every [`parallel_for`](crate::parallel_for) that this thread
/// starts, and by [`interrupted`]. Once it returns true it is not called again, no thread begins another task of this thread's loops, and
/// further loops end without running, so that `work` returns soon. What the kernels have written by then is undefined in value, but
/// initialised. Calls may be nested: the inner call also stops when the outer one does. Without a call of this function, a loop
/// spends one load of a thread-local variable on it.
///
/// # Errors
/// [`Interrupted`] if `poll` returned true, in place of the result of `work`.
///
/// ```
/// use saccade_vla_kernels::{Interrupted, interrupted, interruptible};
/// assert_eq!(interruptible(&|| false, || 7), Ok(7));
/// let endless = || while !interrupted() {};
/// assert_eq!(interruptible(&|| true, endless), Err(Interrupted));
/// ```
pub fn interruptible<R>(poll: &dyn Fn() -> bool, work: impl FnOnce() -> R) -> Result<R, Interrupted> {
    /// Makes the outer scope the innermost one again.
    struct Leave(*const Scope);

    impl Drop for Leave {
        fn drop(&mut self) {
            SCOPE.set(self.0);
        }
    }

    let outer = SCOPE.get();
    // SAFETY: only the lifetime changes. The pointer is used through the scope, which ends in this function.
    let poll: *const (dyn Fn() -> bool + 'static) = unsafe { std::mem::transmute(poll) };
    let scope = Scope {
        poll,
        asked: Cell::new(Instant::now()),
        stop: AtomicBool::new(false),
        outer,
    };
    let leave = Leave(outer);
    SCOPE.set(&raw const scope);
    let result = work();
    drop(leave);
    if scope.stop.load(Ordering::Relaxed) {
        Err(Interrupted)
    } else {
        Ok(result)
    }
}

/// Whether an [`interruptible`] call that this code runs in is to stop: for code between two loops. Asks as they do.
#[must_use]
pub fn interrupted() -> bool {
    Scope::current().is_some_and(Scope::asks_to_stop)
}
