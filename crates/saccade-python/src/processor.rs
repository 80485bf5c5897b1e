//! `saccade._saccade.Processor`: frames and words to the inputs of a backbone.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArrayDyn, PyReadonlyArrayDyn};
use pyo3::prelude::*;
use saccade_vla::{Frame, Observation, Preprocessing, ProcessorOptions, Tokenizer, TokenizerFiles};

use crate::arrays::{Named, owned_to_numpy, row_to_numpy, view};
use crate::detached::call;

/// A frame as the Python package gives it.
#[derive(FromPyObject)]
pub(crate) enum PyFrame<'py> {
    U8(PyReadonlyArrayDyn<'py, u8>),
    F32(PyReadonlyArrayDyn<'py, f32>),
    F64(PyReadonlyArrayDyn<'py, f64>),
}

impl PyFrame<'_> {
    fn view(&self) -> PyResult<Frame<'_>> {
        Ok(match self {
            Self::U8(array) => Frame::U8(view(array)?),
            Self::F32(array) => Frame::F32(view(array)?),
            Self::F64(array) => Frame::F64(view(array)?),
        })
    }
}

/// An observation as the Python package gives it.
#[derive(FromPyObject)]
pub(crate) struct PyObservation<'py>(
    /// The views, with their names if they have any.
    Vec<(Option<String>, PyFrame<'py>)>,
    /// Whether they are in the order of the prompt.
    bool,
    /// The instruction.
    Option<String>,
);

impl PyObservation<'_> {
    pub(crate) fn view(&self, plain_text: bool) -> PyResult<Observation<'_>> {
        let Self(views, is_ordered, instruction) = self;
        let views = views
            .iter()
            .map(|(name, frame)| Ok((name.as_deref(), frame.view()?)));
        Ok(Observation {
            views: views.collect::<PyResult<_>>()?,
            is_ordered: *is_ordered,
            instruction: instruction.as_deref(),
            plain_text,
        })
    }
}

/// Arrays of pixels, ids `(batch, length)`, mask, grids `(views, 3)`, names of views.
type PyPrepared<'py> = (
    Vec<Bound<'py, PyArrayDyn<f32>>>,
    Bound<'py, PyArrayDyn<i64>>,
    Bound<'py, PyArrayDyn<bool>>,
    Option<Bound<'py, PyArrayDyn<i64>>>,
    Option<Vec<String>>,
);

/// What a checkpoint says about its processor.
#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct ProcessorSource(saccade_vla::ProcessorSource);

#[pymethods]
impl ProcessorSource {
    #[new]
    fn new(py: Python<'_>, source: PathBuf) -> PyResult<Self> {
        call(py, || saccade_vla::ProcessorSource::open(&source)).map(Self)
    }

    #[getter]
    fn version(&self) -> &'static str {
        self.0.version().name()
    }

    #[getter]
    fn has_tokenizer(&self) -> bool {
        self.0.tokenizer().is_some()
    }

    #[getter]
    fn published(&self) -> Vec<&'static str> {
        self.0.published().to_vec()
    }

    #[getter]
    fn needed_files(&self) -> Vec<&'static str> {
        self.0.needed_files().to_vec()
    }
}

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct Processor(pub(crate) Arc<saccade_vla::Processor>);

#[pymethods]
impl Processor {
    #[new]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        version: &str,
        tokenizer: PathBuf,
        preprocessing: Option<Named<Preprocessing>>,
        image_size: Option<usize>,
        tokens_per_view: Option<usize>,
        plain_text: bool,
        options: Option<&str>,
    ) -> PyResult<Self> {
        let options = ProcessorOptions {
            preprocessing: preprocessing.map(|given| given.0),
            image_size,
            tokens_per_view,
            plain_text,
            options,
        };
        call(py, || {
            let tokenizer = Tokenizer::read(&TokenizerFiles::at(&tokenizer)?)?;
            saccade_vla::Processor::new(version.parse()?, tokenizer, &options)
        })
        .map(|made| Self(Arc::new(made)))
    }

    /// That of a checkpoint, with these files and this path, or its own, and with these options in place of its own.
    #[staticmethod]
    fn load(
        py: Python<'_>,
        source: &ProcessorSource,
        tokenizer: Option<PathBuf>,
        preprocessing: Option<Named<Preprocessing>>,
        options: Option<&str>,
    ) -> PyResult<Self> {
        let preprocessing = preprocessing.map(|given| given.0);
        call(py, || {
            let files = tokenizer.as_deref().map(TokenizerFiles::at).transpose()?;
            source.0.processor(files.as_ref(), preprocessing, options)
        })
        .map(|made| Self(Arc::new(made)))
    }

    #[getter]
    fn version(&self) -> &'static str {
        self.0.version().name()
    }

    #[getter]
    fn preprocessing(&self) -> &'static str {
        self.0.preprocessing().name()
    }

    #[getter]
    fn view_size(&self) -> Option<(usize, usize)> {
        self.0.view_size()
    }

    #[getter]
    fn num_tokens(&self) -> usize {
        self.0.num_tokens()
    }

    #[getter]
    fn image_token_id(&self) -> u32 {
        self.0.image_token_id()
    }

    fn frame<'py>(&self, py: Python<'py>, image: PyFrame<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let frame = image.view()?;
        owned_to_numpy(py, call(py, || self.0.view(frame))?.pixels)
    }

    fn tokens<'py>(&self, py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyArrayDyn<i64>>> {
        let ids = call(py, || self.0.tokens(text))?;
        Ok(row_to_numpy(py, ids.into_iter().map(i64::from).collect()))
    }

    fn texts(&self, py: Python<'_>, ids: Vec<i64>) -> PyResult<Vec<String>> {
        call(py, || self.0.texts(&ids))
    }

    fn process<'py>(
        &self,
        py: Python<'py>,
        observations: Vec<PyObservation<'py>>,
        plain_text: bool,
    ) -> PyResult<PyPrepared<'py>> {
        let observations = observations
            .iter()
            .map(|observation| observation.view(plain_text))
            .collect::<PyResult<Vec<_>>>()?;
        let prepared = call(py, || self.0.process(&observations))?;
        let pixels = prepared
            .pixel_values
            .into_iter()
            .map(|array| owned_to_numpy(py, array));
        let grid = prepared.image_grid_thw.map(|grid| owned_to_numpy(py, grid));
        Ok((
            pixels.collect::<PyResult<_>>()?,
            owned_to_numpy(py, prepared.input_ids)?,
            owned_to_numpy(py, prepared.attention_mask)?,
            grid.transpose()?,
            prepared.view_names,
        ))
    }
}
