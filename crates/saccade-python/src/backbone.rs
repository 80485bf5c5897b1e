//! `saccade._saccade.Backbone` and its features.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArrayDyn, PyReadonlyArrayDyn};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use saccade_vla::{BackboneConfig, BackboneInputs, BackboneKeep, BackboneLoadOptions, OwnedArray, Precision};

use crate::arrays::{
    Mask, Named, PyTensors, optional_view, owned_to_numpy, row_to_numpy, set_fields, to_numpy, view,
};
use crate::detached::call;

/// The fields of a `saccade.BackboneInputs`.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct PyInputs<'py> {
    pixel_values: Vec<PyReadonlyArrayDyn<'py, f32>>,
    input_ids: PyReadonlyArrayDyn<'py, i64>,
    attention_mask: Mask,
    image_grid_thw: Option<PyReadonlyArrayDyn<'py, i64>>,
}

impl PyInputs<'_> {
    fn view(&self) -> PyResult<BackboneInputs<'_>> {
        let pixel_values = self.pixel_values.iter().map(view).collect::<PyResult<_>>()?;
        Ok(BackboneInputs {
            pixel_values,
            input_ids: view(&self.input_ids)?,
            attention_mask: Some(self.attention_mask.view()?),
            image_grid_thw: optional_view(&self.image_grid_thw)?,
        })
    }
}

#[derive(Clone)]
#[pyclass(frozen, from_py_object, module = "saccade._saccade")]
pub(crate) struct BackboneFeatures(pub(crate) Arc<saccade_vla::BackboneFeatures>);

#[pymethods]
impl BackboneFeatures {
    #[getter]
    fn nbytes(&self) -> usize {
        self.0.nbytes()
    }

    /// `(batch, tokens)` of the features.
    #[getter]
    fn shape(&self) -> (usize, usize) {
        (self.0.batch(), self.0.num_tokens())
    }

    /// The most views of a prompt.
    #[getter]
    fn num_views(&self) -> usize {
        let views = (0..self.0.batch()).map(|prompt| self.0.views(prompt).count());
        views.max().unwrap_or(0)
    }

    /// `(batch, tokens, width)`.
    fn features<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let shape = [self.0.batch(), self.0.num_tokens(), self.0.feature_dim()];
        to_numpy(py, call(py, || self.0.all_features())?, &shape)
    }

    /// `(batch, tokens)`: the attention mask as it was given, and which tokens are those of views.
    fn masks<'py>(&self, py: Python<'py>) -> PyResult<[Bound<'py, PyArrayDyn<bool>>; 2]> {
        let (attended, image) = call(py, || self.0.masks())?;
        Ok([owned_to_numpy(py, attended)?, owned_to_numpy(py, image)?])
    }

    /// For each prompt the places of the image tokens of its views.
    fn views<'py>(&self, py: Python<'py>) -> Vec<Vec<Bound<'py, PyArrayDyn<i64>>>> {
        let places = |view: &[usize]| row_to_numpy(py, view.iter().map(|&place| place as i64).collect());
        let prompts = 0..self.0.batch();
        prompts
            .map(|prompt| self.0.views(prompt).map(places).collect())
            .collect()
    }
}

/// Rows by layer, and by prompt and view the patches and the tokens.
type PyBackboneRecord<'py> = (
    Vec<Bound<'py, PyArrayDyn<f32>>>,
    Vec<Vec<Bound<'py, PyArrayDyn<f32>>>>,
    Vec<Vec<Bound<'py, PyArrayDyn<f32>>>>,
);

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct Backbone(pub(crate) Arc<saccade_vla::Backbone>);

#[pymethods]
impl Backbone {
    #[staticmethod]
    fn load(
        py: Python<'_>,
        source: PathBuf,
        config: Option<String>,
        precision: Named<Precision>,
        num_threads: Option<usize>,
    ) -> PyResult<Self> {
        let options = BackboneLoadOptions {
            config,
            precision: precision.0,
            num_threads,
        };
        call(py, || saccade_vla::Backbone::load(&source, &options)).map(|made| Self(Arc::new(made)))
    }

    #[staticmethod]
    fn from_tensors(
        py: Python<'_>,
        tensors: PyTensors<'_>,
        config: Option<String>,
        precision: Named<Precision>,
        num_threads: Option<usize>,
    ) -> PyResult<Self> {
        let options = BackboneLoadOptions {
            config,
            precision: precision.0,
            num_threads,
        };
        let views = tensors.views()?;
        call(py, || saccade_vla::Backbone::from_tensors(&views, &options)).map(|made| Self(Arc::new(made)))
    }

    fn config<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        backbone_config_dict(py, self.0.config())
    }

    #[getter]
    fn num_threads(&self) -> usize {
        self.0.engine().threads
    }

    #[getter]
    fn precision(&self) -> String {
        self.0.engine().precision.to_string()
    }

    #[getter]
    fn isa(&self) -> String {
        self.0.engine().isa.to_string()
    }

    #[getter]
    fn nbytes(&self) -> usize {
        self.0.nbytes()
    }

    /// Features of each of the inputs, and what was recorded of each.
    fn encode<'py>(
        &self,
        py: Python<'py>,
        inputs: Vec<PyInputs<'py>>,
        previous: Vec<BackboneFeatures>,
        hidden: bool,
        vision: bool,
        image_tokens: bool,
    ) -> PyResult<Vec<(BackboneFeatures, PyBackboneRecord<'py>)>> {
        let views = inputs.iter().map(PyInputs::view).collect::<PyResult<Vec<_>>>()?;
        let previous: Vec<_> = previous.iter().map(|features| &*features.0).collect();
        let keep = BackboneKeep {
            hidden,
            vision,
            image_tokens,
        };
        let encoded = call(py, || self.0.encode(&views, &previous, keep))?;
        let features = encoded.into_iter().map(|mut features| {
            let recorded = features.take_recorded();
            let array = |array: OwnedArray| owned_to_numpy(py, array);
            let arrays = |given: Vec<OwnedArray>| given.into_iter().map(array).collect::<PyResult<Vec<_>>>();
            let nested =
                |given: Vec<Vec<OwnedArray>>| given.into_iter().map(arrays).collect::<PyResult<Vec<_>>>();
            let record = (
                arrays(recorded.hidden)?,
                nested(recorded.vision)?,
                nested(recorded.image_tokens)?,
            );
            Ok((BackboneFeatures(Arc::new(features)), record))
        });
        features.collect()
    }
}

/// A backbone in a checkpoint, before it is loaded.
#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct BackboneCheckpoint(saccade_vla::BackboneCheckpoint);

#[pymethods]
impl BackboneCheckpoint {
    #[staticmethod]
    fn open(py: Python<'_>, source: PathBuf, config: Option<String>) -> PyResult<Self> {
        let open = || saccade_vla::BackboneCheckpoint::open(&source, config.as_deref());
        call(py, open).map(Self)
    }

    fn config<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        backbone_config_dict(py, self.0.config())
    }

    #[getter]
    fn prefix(&self) -> &'static str {
        self.0.prefix()
    }

    fn nbytes(&self, py: Python<'_>, precision: Named<Precision>) -> PyResult<usize> {
        call(py, || self.0.nbytes(precision.0))
    }
}

fn backbone_config_dict<'py>(py: Python<'py>, config: &BackboneConfig) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    let (vision, language) = (&config.vision, &config.language);
    dict.set_item("version", config.version.name())?;
    dict.set_item("feature_dim", config.feature_dim())?;
    set_fields!(dict, config; image_token_id project_to_dim);
    set_fields!(dict, language;
        width num_layers num_heads num_kv_heads head_dim hidden_dim vocab_size rope_theta norm_eps has_final_norm);
    set_fields!(dict, vision; patch_size num_positions merge connector_layers image_size);
    dict.set_item("vision_width", vision.width)?;
    dict.set_item("vision_num_layers", vision.num_layers)?;
    dict.set_item("vision_num_heads", vision.num_heads)?;
    dict.set_item("vision_head_dim", vision.head_dim)?;
    dict.set_item("vision_hidden_dim", vision.hidden_dim)?;
    dict.set_item("vision_norm_eps", vision.norm_eps)?;
    let mrope_section = language.mrope_section.map(|section| PyTuple::new(py, section));
    dict.set_item("mrope_section", mrope_section.transpose()?)?;
    dict.set_item("deepstack", PyTuple::new(py, &vision.deepstack)?)?;
    Ok(dict)
}
