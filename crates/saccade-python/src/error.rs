//! What goes wrong in the core, as Python exceptions.

use std::any::Any;

use pyo3::exceptions::{PyFileNotFoundError, PyMemoryError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyType;
use saccade_vla::{Error, ErrorKind};

/// Advice for Python users about an error of the core, whose own words are for every language.
fn hint(error: &Error) -> Option<&'static str> {
    match (error.argument()?, error.kind()) {
        ("state", ErrorKind::Shape | ErrorKind::Input) => Some("saccade.Normalizer converts a robot's state"),
        ("attention_mask", ErrorKind::Input) => {
            Some("in Python: attention_mask=None, or drop_vl=~attention_mask")
        }
        _ => None,
    }
}

/// The exception of `saccade.errors` for an error of the core.
pub(crate) fn raise(error: Error) -> PyErr {
    static SHAPE: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    static INPUT: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    static CHECKPOINT: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    let mut message = error.to_string();
    if let Some(hint) = hint(&error) {
        message = format!("{message}; {hint}");
    }
    match error.kind() {
        ErrorKind::NotFound => PyFileNotFoundError::new_err(message),
        ErrorKind::Memory => PyMemoryError::new_err(message),
        ErrorKind::Shape => exception(&SHAPE, "ShapeError", message),
        ErrorKind::Checkpoint | ErrorKind::Output => exception(&CHECKPOINT, "CheckpointError", message),
        _ => exception(&INPUT, "InputError", message),
    }
}

/// The exception for a panic: always a bug of saccade, which must reach a user as an error that can be caught and reported.
pub(crate) fn bug(panic: &(dyn Any + Send)) -> PyErr {
    static BASE: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    let message = format!(
        "this is a bug in saccade; please report it with the call that led to it: {}",
        text.unwrap_or("a panic without a message")
    );
    exception(&BASE, "SaccadeError", message)
}

/// The exception class of `saccade.errors` with this name, with `message`.
fn exception(class: &'static PyOnceLock<Py<PyType>>, name: &str, message: String) -> PyErr {
    Python::attach(|py| {
        let class = class.import(py, "saccade.errors", name);
        class.map_or_else(|error| error, |class| PyErr::from_type(class.clone(), message))
    })
}
