//! Memory of calls, kept for later calls.

use std::sync::Mutex;

use crate::error::{Error, Result};

/// Workspaces that are not in use.
///
/// The list is never waited for: a thread that finds its lock taken makes a workspace of its own, so that callers never stop each other, and a
/// fork that copies a taken lock leaves the child slower, not stuck.
pub(crate) struct Workspaces<W>(Mutex<Vec<W>>);

impl<W> Workspaces<W> {
    pub(crate) fn new() -> Self {
        Self(Mutex::new(Vec::new()))
    }

    /// Runs `call` with a kept workspace, or with a new one.
    pub(crate) fn with<R>(
        &self,
        new: impl FnOnce() -> W,
        call: impl FnOnce(&mut W) -> Result<R>,
    ) -> Result<R> {
        let kept = self.0.try_lock().ok().and_then(|mut kept| kept.pop());
        let mut workspace = kept.unwrap_or_else(new);
        let result = call(&mut workspace);
        // One that grew until memory ran out is not kept.
        if !matches!(result, Err(Error::Memory { .. }))
            && let Ok(mut kept) = self.0.try_lock()
        {
            kept.push(workspace);
        }
        result
    }
}
