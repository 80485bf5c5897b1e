//! The one way from Python into the core: without the interpreter, with panics caught.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};

use pyo3::prelude::*;
use saccade::interruptible;

use crate::error::{bug, raise};

/// Runs `work` without the interpreter. Python's signal handlers run every 20 ms or so; what one raises, such as `KeyboardInterrupt`, ends the
/// work and is raised. Its error, or its panic, becomes an exception once the interpreter is held again: whatever locks `work`
/// took are then released, so that no lock of the core is ever held by a thread that waits for the interpreter.
pub(crate) fn call<T: Send>(py: Python<'_>, work: impl FnOnce() -> saccade::Result<T> + Send) -> PyResult<T> {
    // A panic leaves nothing half-changed behind that a later call sees: heads are immutable, and a workspace that was in use is dropped.
    let mut raised = None;
    let result = py.detach(|| {
        let cell = Cell::new(None);
        let poll = || match Python::attach(|py| py.check_signals()) {
            Ok(()) => false,
            Err(error) => {
                cell.set(Some(error));
                true
            }
        };
        let result = catch_unwind(AssertUnwindSafe(|| interruptible(&poll, work)));
        raised = cell.take();
        result
    });
    match result {
        Ok(result) => result.map_err(|error| raised.unwrap_or_else(|| raise(error))),
        Err(panic) => Err(bug(&*panic)),
    }
}

/// Panics as a bug in the core would: for the test of what becomes of it.
#[pyfunction]
pub(crate) fn panic_in_core(py: Python<'_>, message: String) -> PyResult<()> {
    call(py, || panic!("{message}"))
}
