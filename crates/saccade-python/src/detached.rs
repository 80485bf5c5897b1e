//! The one way from Python into the core: without the interpreter, with signals handled and panics caught.

use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind};

use pyo3::prelude::*;
use saccade_vla::interruptible;

use crate::error::{bug, raise};

/// Runs `work` without the interpreter. Its error, or its panic, becomes an exception once the interpreter is held again: whatever locks `work`
/// took are then released, so that no lock of the core is ever held by a thread that waits for the interpreter.
///
/// On the main thread, the only one on which Python handles signals, the core asks every 20 ms or so whether to go on, and Python's signal
/// handlers run then. What one raises, such as `KeyboardInterrupt`, ends the work and is raised.
pub(crate) fn call<T: Send>(
    py: Python<'_>,
    work: impl FnOnce() -> saccade_vla::Result<T> + Send,
) -> PyResult<T> {
    let handles_signals = is_main_thread(py);
    // A panic leaves nothing half-changed behind that a later call sees: heads are immutable, and a workspace that was in use is dropped.
    let outcome = py.detach(|| {
        catch_unwind(AssertUnwindSafe(|| {
            if !handles_signals {
                return (work(), None);
            }
            let raised = RefCell::new(None);
            let is_signalled = || match Python::attach(|py| py.check_signals()) {
                Ok(()) => false,
                Err(error) => {
                    raised.replace(Some(error));
                    true
                }
            };
            let result = interruptible(&is_signalled, work);
            (result, raised.into_inner())
        }))
    });
    match outcome {
        Ok((_, Some(raised))) => Err(raised),
        Ok((result, None)) => result.map_err(raise),
        Err(panic) => Err(bug(&*panic)),
    }
}

/// Whether this is Python's main thread. Asked once for each thread, and again after a fork, which makes the forking thread the main one.
fn is_main_thread(py: Python<'_>) -> bool {
    thread_local! {
        static KNOWN: Cell<Option<(u32, bool)>> = const { Cell::new(None) };
    }
    let process = std::process::id();
    match KNOWN.get() {
        Some((known, is_main)) if known == process => is_main,
        _ => {
            let is_main = ask_whether_main(py).unwrap_or(false);
            KNOWN.set(Some((process, is_main)));
            is_main
        }
    }
}

fn ask_whether_main(py: Python<'_>) -> PyResult<bool> {
    let threading = py.import("threading")?;
    let current: u64 = threading.call_method0("get_ident")?.extract()?;
    let main: u64 = threading
        .call_method0("main_thread")?
        .getattr("ident")?
        .extract()?;
    Ok(current == main)
}

/// Panics as a bug in the core would: for the test of what becomes of it.
#[pyfunction]
pub(crate) fn panic_in_core(py: Python<'_>, message: String) -> PyResult<()> {
    call(py, || panic!("{message}"))
}
