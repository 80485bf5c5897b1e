//! Memory of calls, kept for later calls.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::error::{Error, Result};

/// Workspaces that are not in use, at most as many as there were calls at the same time.
///
/// The list is never waited for: a thread that finds its lock taken makes a workspace of its own, so that
/// callers never stop each other, and a fork that copies a taken lock leaves the child slower, not stuck.
pub(crate) struct Workspaces<W> {
    kept: Mutex<Vec<W>>,
    calls: AtomicUsize,
    most_calls: AtomicUsize,
}

impl<W> Workspaces<W> {
    pub(crate) fn new() -> Self {
        Self {
            kept: Mutex::new(Vec::new()),
            calls: AtomicUsize::new(0),
            most_calls: AtomicUsize::new(0),
        }
    }

    /// Runs `call` with a kept workspace, or with a new one.
    pub(crate) fn with<R>(
        &self,
        new: impl FnOnce() -> W,
        call: impl FnOnce(&mut W) -> Result<R>,
    ) -> Result<R> {
        let running = Running::new(self);
        let kept = self.kept.try_lock().ok().and_then(|mut kept| kept.pop());
        let mut workspace = kept.unwrap_or_else(new);
        let result = call(&mut workspace);
        drop(running);
        // One that grew until memory ran out is not kept. Neither is one that was made only because the lock
        // was taken.
        if !matches!(result, Err(Error::Memory { .. }))
            && let Ok(mut kept) = self.kept.try_lock()
            && kept.len() + self.calls.load(Ordering::Relaxed) < self.most_calls.load(Ordering::Relaxed)
        {
            kept.push(workspace);
        }
        result
    }
}

/// A call, counted until it ends, by a panic too.
struct Running<'a>(&'a AtomicUsize);

impl<'a> Running<'a> {
    fn new<W>(workspaces: &'a Workspaces<W>) -> Self {
        let calls = workspaces.calls.fetch_add(1, Ordering::Relaxed) + 1;
        workspaces.most_calls.fetch_max(calls, Ordering::Relaxed);
        Self(&workspaces.calls)
    }
}

impl Drop for Running<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use super::*;

    fn kept(workspaces: &Workspaces<()>) -> usize {
        workspaces.kept.lock().unwrap().len()
    }

    #[test]
    fn a_lock_that_is_often_taken_leaves_no_more_workspaces_than_calls() {
        let workspaces = Workspaces::new();
        workspaces.with(|| (), |()| Ok(())).unwrap();
        for _ in 0..10 {
            let taken = RefCell::new(Some(workspaces.kept.lock().unwrap()));
            let new = || drop(taken.take());
            workspaces.with(new, |()| Ok(())).unwrap();
        }
        assert_eq!(kept(&workspaces), 1);
    }

    #[test]
    fn each_of_the_calls_at_the_same_time_leaves_its_own() {
        let workspaces = Workspaces::new();
        let inner = |()| workspaces.with(|| (), |()| Ok(()));
        for _ in 0..3 {
            workspaces.with(|| (), |()| inner(())).unwrap();
            assert_eq!(kept(&workspaces), 2);
        }
    }
}
