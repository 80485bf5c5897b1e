//! What this machine has, what it can do at most, and where the time of calls goes.

use pyo3::exceptions::PyMemoryError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use saccade_vla::peak::{self, PeakError};
use saccade_vla::{Arithmetic, CpuReport, Error, Isa, Part, Problem, Profile, Profiling};

use crate::detached::call;
use crate::error::raise;

/// What this machine can do at most on `num_threads` threads; takes some tenths of a second for each instruction set
/// that is available or selected.
#[pyfunction]
pub(crate) fn measure_peaks(py: Python<'_>, num_threads: usize) -> PyResult<Bound<'_, PyDict>> {
    if num_threads == 0 {
        let problem = Problem::expected("num_threads", "at least 1", "0");
        return Err(raise(Error::Input(problem)));
    }
    let mut isas = Isa::available();
    let selected = selected()?;
    // Software tiles can be selected, and are not among those that are available.
    if !isas.contains(&selected) {
        isas.push(selected);
    }
    let (rates, kernels) = (PyDict::new(py), PyDict::new(py));
    for isa in isas {
        let (of_isa, kernels_of_isa) = (PyDict::new(py), PyDict::new(py));
        for (name, arithmetic) in [
            ("float32", Arithmetic::Float32),
            ("bfloat16", Arithmetic::Bfloat16),
            ("int8", Arithmetic::Int8),
            ("int4", Arithmetic::Int4),
        ] {
            let rate = peak_or_raise(call(py, || {
                Ok(peak::macs_per_second(isa, arithmetic, num_threads))
            })?)?;
            of_isa.set_item(name, rate)?;
            kernels_of_isa.set_item(name, peak::kernel_name(isa, arithmetic))?;
        }
        rates.set_item(isa.to_string(), of_isa)?;
        kernels.set_item(isa.to_string(), kernels_of_isa)?;
    }
    let peaks = PyDict::new(py);
    peaks.set_item("macs_per_second", rates)?;
    peaks.set_item("kernels", kernels)?;
    let (by_streams, mut fastest) = (PyDict::new(py), 0.0);
    for streams in peak::READ_STREAMS {
        let read = call(py, || Ok(peak::read_bytes_per_second(num_threads, streams)))?;
        let rate = peak_or_raise(read)?;
        by_streams.set_item(streams, rate)?;
        fastest = f64::max(fastest, rate);
    }
    peaks.set_item("read_bytes_per_second", fastest)?;
    peaks.set_item("read_bytes_per_second_by_streams", by_streams)?;
    peaks.set_item("clock_hz", call(py, || Ok(peak::clock_hz()))?)?;
    Ok(peaks)
}

/// A context in which calls of this thread compute on it alone, whatever number of threads a head or backbone has.
#[pyclass(unsendable, name = "stay_on_this_thread", module = "saccade._saccade")]
#[derive(Default)]
pub(crate) struct StayOnThisThread(Option<saccade_vla::StayOnThisThread>);

#[pymethods]
impl StayOnThisThread {
    #[new]
    fn new() -> Self {
        Self::default()
    }

    fn __enter__(&mut self) {
        self.0 = Some(saccade_vla::stay_on_this_thread());
    }

    #[pyo3(signature = (*_error))]
    fn __exit__(&mut self, _error: &Bound<'_, PyTuple>) {
        self.0 = None;
    }
}

/// The rate, or the exception for it: for memory that the system refused, or threads.
fn peak_or_raise(measured: Result<f64, PeakError>) -> PyResult<f64> {
    measured.map_err(|error| match error {
        PeakError::Alloc(error) => PyMemoryError::new_err(error.to_string()),
        error => raise(Error::Input(Problem::new("num_threads", error))),
    })
}

/// A context in which it is counted where the time of this thread's calls goes.
#[pyclass(unsendable, name = "profile", module = "saccade._saccade")]
#[derive(Default)]
pub(crate) struct PyProfile {
    profiling: Option<Profiling>,
    counted: Profile,
}

#[pymethods]
impl PyProfile {
    #[new]
    fn new() -> Self {
        Self::default()
    }

    fn __enter__(mut this: PyRefMut<'_, Self>) -> PyRefMut<'_, Self> {
        this.profiling = Some(Profile::start());
        this
    }

    #[pyo3(signature = (*_error))]
    fn __exit__(&mut self, _error: &Bound<'_, PyTuple>) {
        if let Some(profiling) = self.profiling.take() {
            self.counted = profiling.finish();
        }
    }

    /// `(calls, seconds, multiply_adds, bytes)` by part, once the context is left.
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        for part in Part::ALL {
            let counter = self.counted.part(part);
            let seconds = counter.time.as_secs_f64();
            dict.set_item(
                part.name(),
                (counter.calls, seconds, counter.multiply_adds, counter.bytes),
            )?;
        }
        Ok(dict)
    }

    /// The names of the kernels of linear layers by part, once the context is left.
    fn kernels<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        for part in Part::ALL {
            if let Some(kernel) = self.counted.part(part).kernel {
                dict.set_item(part.name(), kernel)?;
            }
        }
        Ok(dict)
    }
}

#[pyfunction]
pub(crate) fn available_isas() -> Vec<String> {
    Isa::available().iter().map(Isa::to_string).collect()
}

fn selected() -> PyResult<Isa> {
    Isa::from_env().map_err(|error| raise(error.into()))
}

#[pyfunction]
pub(crate) fn selected_isa() -> PyResult<String> {
    Ok(selected()?.to_string())
}

#[pyfunction]
pub(crate) fn dot_products() -> PyResult<Vec<&'static str>> {
    Ok(selected()?.dot_products())
}

/// `(family, rates, tiles)`: what decides which kernels are used.
#[pyfunction]
pub(crate) fn cpu_report() -> (String, String, String) {
    let CpuReport {
        family, rates, tiles, ..
    } = CpuReport::current();
    (family, rates, tiles)
}

#[pyfunction]
pub(crate) fn default_num_threads() -> PyResult<usize> {
    let threads = saccade_vla::default_num_threads();
    threads.map(usize::from).map_err(|error| raise(error.into()))
}
