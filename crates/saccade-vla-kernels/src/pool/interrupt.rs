//! Interruption: a caller's question whether to go on, asked between tasks, and the flag that stops the loops of that caller.

use std::cell::Cell;
use std::time::{Duration, Instant};

use super::sync::{AtomicBool, Ordering};

/// A caller is asked at most this often: the question may take a lock of an interpreter.
const EVERY: Duration = Duration::from_millis(20);

/// The caller of [`interruptible`] has asked for an end before the work was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("interrupted")]
pub struct Interrupted;

/// One call of [`interruptible`], on the caller's stack.
pub(super) struct Scope<'a> {
    poll: &'a dyn Fn() -> bool,
    asked: Cell<Instant>,
    stop: AtomicBool,
    /// The scope that this one is in.
    outer: Option<&'a Scope<'a>>,
}

thread_local! {
    /// The innermost scope of this thread. It does not live as long as its type says: it is used through
    /// [`Scope::with_current`] only.
    static SCOPE: Cell<Option<&'static Scope<'static>>> = const { Cell::new(None) };
}

impl Scope<'_> {
    /// Calls `f` with the innermost scope of this thread, which lives as long as the call.
    pub(super) fn with_current<R>(f: impl FnOnce(Option<&Scope<'_>>) -> R) -> R {
        f(SCOPE.get())
    }

    /// Whether loops are to stop. Asks the caller if it was not asked lately.
    pub(super) fn asks_to_stop(&self) -> bool {
        if self.stop.load(Ordering::Relaxed) {
            return true;
        }
        let outer = self.outer.is_some_and(Scope::asks_to_stop);
        if !outer && self.asked.get().elapsed() < EVERY {
            return false;
        }
        // Before the question as well as after it: the answer may need loops of its own, and may take long.
        self.asked.set(Instant::now());
        let stop = outer || (self.poll)();
        self.asked.set(Instant::now());
        if stop {
            self.stop.store(true, Ordering::Relaxed);
        }
        stop
    }

    /// Set once loops are to stop; workers look at it.
    pub(super) fn flag(&self) -> &AtomicBool {
        &self.stop
    }
}

/// Whether loops of this thread have been stopped, so that some of their tasks may not have run. Asks nobody.
pub(crate) fn is_stopped() -> bool {
    Scope::with_current(|scope| scope.is_some_and(|scope| scope.stop.load(Ordering::Relaxed)))
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
    struct Leave(Option<&'static Scope<'static>>);

    impl Drop for Leave {
        fn drop(&mut self) {
            SCOPE.set(self.0);
        }
    }

    let outer = SCOPE.get();
    let scope = Scope {
        poll,
        asked: Cell::new(Instant::now()),
        stop: AtomicBool::new(false),
        outer,
    };
    // SAFETY: only lifetimes change. The reference is used by calls within `work` alone: `leave` takes it away when that
    // ends, also by a panic, and before the scope does.
    let current = unsafe { std::mem::transmute::<&Scope<'_>, &'static Scope<'static>>(&scope) };
    let leave = Leave(outer);
    SCOPE.set(Some(current));
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
    Scope::with_current(|scope| scope.is_some_and(Scope::asks_to_stop))
}
