//! The one way from Python into the core: without the interpreter, with panics caught.

use std::panic::{AssertUnwindSafe, catch_unwind};

use pyo3::prelude::*;

use crate::error::{bug, raise};

/// Runs `work` without the interpreter. Its error, or its panic, becomes an exception once the interpreter is held again: whatever locks `work`
/// took are then released, so that no lock of the core is ever held by a thread that waits for the interpreter.
pub(crate) fn call<T: Send>(py: Python<'_>, work: impl FnOnce() -> saccade::Result<T> + Send) -> PyResult<T> {
    // A panic leaves nothing half-changed behind that a later call sees: heads are immutable, and a workspace that was in use is dropped.
    match py.detach(|| catch_unwind(AssertUnwindSafe(work))) {
        Ok(result) => result.map_err(raise),
        Err(panic) => Err(bug(&*panic)),
    }
}

/// Panics as a bug in the core would: for the test of what becomes of it.
#[pyfunction]
pub(crate) fn panic_in_core(py: Python<'_>, message: String) -> PyResult<()> {
    call(py, || panic!("{message}"))
}
