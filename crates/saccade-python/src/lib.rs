//! Python bindings of saccade: arrays become views, the interpreter is released, errors are mapped. No logic: what is checked is checked in
//! the `saccade` crate, what is converted is converted in the Python package.

#![deny(unsafe_code)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use numpy::{
    Element, IntoPyArray, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyReadwriteArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyFileNotFoundError, PyKeyboardInterrupt, PyMemoryError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyDict, PyTuple, PyType};
use saccade::{
    Arithmetic, Array, ArrayMut, Checkpoint, Chunking, ConvertOptions, ElementsRef, Error, Features, Group,
    Integrator, Isa, Keep, KeyOptions, LoadOptions, NoisyActions, OwnedArray, Part, Patch, Profile, Recorded,
    ResizeOptions, RewriteOptions, Sampling, TensorFacts, TensorView, TensorViews, Tokens, TraceOptions,
    Written, peak,
};

/// The exception class of `saccade.errors` with this name.
fn exception<'py>(
    py: Python<'py>,
    cell: &'static PyOnceLock<Py<PyType>>,
    name: &str,
) -> PyResult<&'py Bound<'py, PyType>> {
    cell.import(py, "saccade.errors", name)
}

fn raise(error: Error) -> PyErr {
    static SHAPE: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    static INPUT: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    static CHECKPOINT: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    let message = error.to_string();
    Python::attach(|py| {
        let class = match error {
            Error::NotFound { .. } => return PyFileNotFoundError::new_err(message),
            Error::Memory { .. } => return PyMemoryError::new_err(message),
            Error::Interrupted => return PyKeyboardInterrupt::new_err(()),
            Error::Shape(_) => exception(py, &SHAPE, "ShapeError"),
            Error::Checkpoint(_) | Error::Output(_) => exception(py, &CHECKPOINT, "CheckpointError"),
            _ => exception(py, &INPUT, "InputError"),
        };
        class.map_or_else(|error| error, |class| PyErr::from_type(class.clone(), message))
    })
}

/// A view of an array that the Python package made C-contiguous.
fn view<'a, T: Element>(array: &'a PyReadonlyArrayDyn<'_, T>) -> PyResult<Array<'a, T>> {
    Array::new(array.as_slice()?, array.shape()).map_err(raise)
}

/// As [`view`], to be written; `shape` is the array's.
fn view_mut<'a>(array: &'a mut PyReadwriteArrayDyn<'_, f32>, shape: &'a [usize]) -> PyResult<ArrayMut<'a>> {
    ArrayMut::new(array.as_slice_mut()?, shape).map_err(raise)
}

fn optional_view<'a, T: Element>(
    array: &'a Option<PyReadonlyArrayDyn<'_, T>>,
) -> PyResult<Option<Array<'a, T>>> {
    array.as_ref().map(view).transpose()
}

fn to_numpy<'py, T: Element>(
    py: Python<'py>,
    data: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    data.into_pyarray(py).reshape(shape.to_vec())
}

/// A group's name and indices.
type PyTokens = (String, Option<Vec<usize>>);

/// The fields of a `saccade.Intervention` by name, as its constructor normalised them; mappings are lists of their items.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct PyIntervention<'py> {
    cut: Vec<(PyTokens, PyTokens)>,
    key_bias: Vec<(PyTokens, PyReadonlyArrayDyn<'py, f32>)>,
    patch: Vec<((usize, usize), PyTokens, PyReadonlyArrayDyn<'py, f32>)>,
    future_tokens: Option<PyReadonlyArrayDyn<'py, f32>>,
    blocks: Option<Vec<usize>>,
    steps: Option<Vec<usize>>,
    heads: Option<Vec<usize>>,
}

fn tokens((name, indices): PyTokens) -> PyResult<Tokens> {
    let group = Group::from_name(&name).map_err(raise)?;
    Ok(Tokens { group, indices })
}

fn owned(array: &PyReadonlyArrayDyn<'_, f32>) -> PyResult<OwnedArray> {
    OwnedArray::new(array.as_slice()?.to_vec(), array.shape()).map_err(raise)
}

fn intervention(given: PyIntervention<'_>) -> PyResult<saccade::Intervention> {
    let cut = |(reader, source)| Ok((tokens(reader)?, tokens(source)?));
    let key_bias = |(keys, bias)| Ok((tokens(keys)?, owned(&bias)?));
    let patch = |((step, block), patched, rows)| {
        Ok(Patch {
            step,
            block,
            tokens: tokens(patched)?,
            rows: owned(&rows)?,
        })
    };
    Ok(saccade::Intervention {
        cut: given.cut.into_iter().map(cut).collect::<PyResult<_>>()?,
        key_bias: given
            .key_bias
            .into_iter()
            .map(key_bias)
            .collect::<PyResult<_>>()?,
        patch: given.patch.into_iter().map(patch).collect::<PyResult<_>>()?,
        future_tokens: given.future_tokens.as_ref().map(owned).transpose()?,
        blocks: given.blocks,
        steps: given.steps,
        heads: given.heads,
    })
}

fn interventions(given: Vec<PyIntervention<'_>>) -> PyResult<Vec<saccade::Intervention>> {
    given.into_iter().map(intervention).collect()
}

/// Attention and hidden rows, each by place.
type PyRecorded<'py> = (Bound<'py, PyDict>, Bound<'py, PyDict>);

fn recorded<'py, Place: IntoPyObject<'py>>(
    py: Python<'py>,
    recorded: Recorded<Place>,
) -> PyResult<PyRecorded<'py>> {
    let to_dict = |arrays: BTreeMap<Place, OwnedArray>| {
        let dict = PyDict::new(py);
        for (place, array) in arrays {
            let (data, shape) = array.into_parts();
            dict.set_item(place, to_numpy(py, data, &shape)?)?;
        }
        Ok::<_, PyErr>(dict)
    };
    Ok((to_dict(recorded.attention)?, to_dict(recorded.hidden)?))
}

fn config_dict<'py>(py: Python<'py>, config: &saccade::HeadConfig) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("version", &config.version)?;
    dict.set_item("mask_mode", config.mask_mode())?;
    let decoders = config.decoders.iter().map(|(name, width)| (name, *width));
    dict.set_item("decoders", PyTuple::new(py, decoders)?)?;
    let future_key_bias = config.future_key_bias.as_ref();
    let future_key_bias = future_key_bias.map(|bias| PyTuple::new(py, bias)).transpose()?;
    dict.set_item("future_key_bias", future_key_bias)?;
    for (name, flag) in [
        ("interleave_self_attention", config.interleave_self_attention),
        ("use_vlln", config.use_vlln),
        ("add_pos_embed", config.add_pos_embed),
    ] {
        dict.set_item(name, flag)?;
    }
    for (name, size) in [
        ("width", config.width),
        ("num_layers", config.num_layers),
        ("num_heads", config.num_heads),
        ("head_dim", config.head_dim),
        ("context_dim", config.context_dim),
        ("attend_text_every_n_blocks", config.attend_text_every_n_blocks),
        ("vl_num_layers", config.vl_num_layers),
        ("vl_num_heads", config.vl_num_heads),
        ("vl_head_dim", config.vl_head_dim),
        ("num_future_tokens", config.num_future_tokens),
        ("action_horizon", config.action_horizon),
        ("action_dim", config.action_dim),
        ("encoder_action_dim", config.encoder_action_dim),
        ("state_dim", config.state_dim),
        ("state_history", config.state_history),
        ("hidden_dim", config.hidden_dim),
        ("num_embodiments", config.num_embodiments),
        ("num_timestep_buckets", config.num_timestep_buckets),
        ("num_steps", config.num_steps),
        ("max_positions", config.max_positions),
    ] {
        dict.set_item(name, size)?;
    }
    Ok(dict)
}

/// A tensor as the Python package gives it: float32, or 16 bits with the name of what they are.
#[derive(FromPyObject)]
enum PyTensor<'py> {
    Float32(PyReadonlyArrayDyn<'py, f32>),
    Half((String, PyReadonlyArrayDyn<'py, u16>)),
}

fn held_tensors<'py>(tensors: &Bound<'py, PyDict>) -> PyResult<Vec<(String, PyTensor<'py>)>> {
    let held = tensors
        .iter()
        .map(|(name, tensor)| Ok((name.extract()?, tensor.extract()?)));
    held.collect()
}

fn tensor_views<'a>(held: &'a [(String, PyTensor<'_>)]) -> PyResult<TensorViews<'a>> {
    let view = |tensor: &'a PyTensor<'_>| {
        Ok::<_, PyErr>(match tensor {
            PyTensor::Float32(array) => {
                TensorView::new(array.shape(), ElementsRef::F32(array.as_slice()?)).map_err(raise)?
            }
            PyTensor::Half((dtype, array)) => {
                let bits = array.as_slice()?;
                let elements = match dtype.as_str() {
                    "bfloat16" => ElementsRef::Bf16(bits),
                    _ => ElementsRef::F16(bits),
                };
                TensorView::new(array.shape(), elements).map_err(raise)?
            }
        })
    };
    held.iter()
        .map(|(name, tensor)| Ok((name.clone(), view(tensor)?)))
        .collect()
}

#[pyclass(frozen, module = "saccade._saccade")]
struct Context(Arc<saccade::Context>);

#[pymethods]
impl Context {
    #[getter]
    fn batch(&self) -> usize {
        self.0.batch()
    }

    #[getter]
    fn num_vl_tokens(&self) -> usize {
        self.0.num_vl_tokens()
    }

    #[getter]
    fn nbytes(&self) -> usize {
        self.0.nbytes()
    }

    fn vl_embs<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let rows = self.0.batch() * self.0.num_vl_tokens();
        let data = self.0.vl_embs();
        to_numpy(
            py,
            data.to_vec(),
            &[self.0.batch(), self.0.num_vl_tokens(), data.len() / rows],
        )
    }

    fn image_mask<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArrayDyn<bool>>>> {
        let shape = [self.0.batch(), self.0.num_vl_tokens()];
        self.0
            .image_mask()
            .map(|mask| to_numpy(py, mask.to_vec(), &shape))
            .transpose()
    }
}

#[pyclass(frozen, module = "saccade._saccade")]
struct ActionHead(saccade::ActionHead);

#[pymethods]
impl ActionHead {
    #[staticmethod]
    fn load(
        py: Python<'_>,
        source: PathBuf,
        config: Option<String>,
        embodiment_ids: Option<Vec<i64>>,
        precision: &str,
        num_threads: Option<usize>,
    ) -> PyResult<Self> {
        let options = LoadOptions::default()
            .with_config(config)
            .with_embodiment_ids(embodiment_ids)
            .with_precision(precision.parse().map_err(raise)?)
            .with_num_threads(num_threads);
        py.detach(|| saccade::ActionHead::load(&source, &options))
            .map(Self)
            .map_err(raise)
    }

    #[staticmethod]
    fn from_tensors(
        py: Python<'_>,
        tensors: &Bound<'_, PyDict>,
        config: String,
        embodiment_ids: Option<Vec<i64>>,
        precision: &str,
        num_threads: Option<usize>,
    ) -> PyResult<Self> {
        let options = LoadOptions::default()
            .with_config(config)
            .with_embodiment_ids(embodiment_ids)
            .with_precision(precision.parse().map_err(raise)?)
            .with_num_threads(num_threads);
        let held = held_tensors(tensors)?;
        let views = tensor_views(&held)?;
        py.detach(|| saccade::ActionHead::from_tensors(&views, &options))
            .map(Self)
            .map_err(raise)
    }

    fn config<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        config_dict(py, self.0.config())
    }

    #[getter]
    fn embodiment_ids(&self) -> Vec<usize> {
        self.0.embodiment_ids().to_vec()
    }

    fn future_tokens<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let tokens = self.0.future_tokens();
        to_numpy(py, tokens.data().to_vec(), tokens.shape())
    }

    #[getter]
    fn num_threads(&self) -> usize {
        self.0.num_threads()
    }

    #[getter]
    fn precision(&self) -> String {
        self.0.precision().to_string()
    }

    #[getter]
    fn isa(&self) -> String {
        self.0.isa().to_string()
    }

    #[getter]
    fn nbytes(&self) -> usize {
        self.0.nbytes()
    }

    fn warmup(
        &self,
        py: Python<'_>,
        num_vl_tokens: usize,
        batch: usize,
        num_samples: Option<usize>,
        future_refresh: Option<usize>,
    ) -> PyResult<()> {
        py.detach(|| self.0.warmup(num_vl_tokens, batch, num_samples, future_refresh))
            .map_err(raise)
    }

    #[allow(clippy::too_many_arguments)]
    fn encode<'py>(
        &self,
        py: Python<'py>,
        backbone_features: PyReadonlyArrayDyn<'_, f32>,
        attention_mask: Option<PyReadonlyArrayDyn<'_, bool>>,
        image_mask: Option<PyReadonlyArrayDyn<'_, bool>>,
        drop_vl: Option<PyReadonlyArrayDyn<'_, bool>>,
        attention: bool,
        hidden: bool,
    ) -> PyResult<(Context, PyRecorded<'py>)> {
        let features = Features::new(view(&backbone_features)?)
            .with_attention_mask(optional_view(&attention_mask)?)
            .with_image_mask(optional_view(&image_mask)?)
            .with_drop_vl(optional_view(&drop_vl)?)
            .with_record(Keep { attention, hidden });
        let mut context = py.detach(|| self.0.encode(&features)).map_err(raise)?;
        let kept = recorded(py, context.take_recorded())?;
        Ok((Context(Arc::new(context)), kept))
    }

    #[allow(clippy::too_many_arguments)]
    fn sample(
        &self,
        py: Python<'_>,
        context: &Context,
        state: PyReadonlyArrayDyn<'_, f32>,
        embodiment_id: PyReadonlyArrayDyn<'_, i64>,
        noise: PyReadonlyArrayDyn<'_, f32>,
        num_steps: Option<usize>,
        integrator: &str,
        num_samples: Option<usize>,
        future_refresh: Option<usize>,
        previous_chunk: Option<PyReadonlyArrayDyn<'_, f32>>,
        chunking: Option<(usize, usize, f64, Option<usize>)>,
        intervention: Vec<PyIntervention<'_>>,
        mut out: PyReadwriteArrayDyn<'_, f32>,
    ) -> PyResult<()> {
        let (state, embodiment_id, noise) = (view(&state)?, view(&embodiment_id)?, view(&noise)?);
        let shape = out.shape().to_vec();
        let (context, out) = (&context.0, view_mut(&mut out, &shape)?);
        let chunking = optional_view(&previous_chunk)?.zip(chunking).map(
            |(previous_chunk, (overlap, frozen, ramp_rate, horizon))| Chunking {
                previous_chunk,
                overlap,
                frozen,
                ramp_rate,
                horizon,
            },
        );
        let interventions = interventions(intervention)?;
        let sampling = Sampling::default()
            .with_num_steps(num_steps)
            .with_integrator(Integrator::from_name(integrator).map_err(raise)?)
            .with_num_samples(num_samples)
            .with_future_refresh(future_refresh)
            .with_chunking(chunking)
            .with_interventions(&interventions);
        py.detach(|| {
            self.0
                .sample(context, state, embodiment_id, noise, &sampling, out)
        })
        .map_err(raise)
    }

    #[allow(clippy::too_many_arguments)]
    fn trace<'py>(
        &self,
        py: Python<'py>,
        context: &Context,
        state: PyReadonlyArrayDyn<'_, f32>,
        embodiment_id: PyReadonlyArrayDyn<'_, i64>,
        noise: PyReadonlyArrayDyn<'_, f32>,
        num_steps: Option<usize>,
        intervention: Vec<PyIntervention<'_>>,
        attention: bool,
        hidden: bool,
        blocks: Option<Vec<usize>>,
        steps: Option<Vec<usize>>,
        max_bytes: u64,
    ) -> PyResult<(PyRecorded<'py>, Bound<'py, PyDict>, Bound<'py, PyArrayDyn<f32>>)> {
        let (state, embodiment_id, noise) = (view(&state)?, view(&embodiment_id)?, view(&noise)?);
        let context = &context.0;
        let interventions = interventions(intervention)?;
        let sampling = Sampling::default()
            .with_num_steps(num_steps)
            .with_interventions(&interventions);
        let options = TraceOptions::new(Keep { attention, hidden })
            .with_blocks(blocks)
            .with_steps(steps)
            .with_max_bytes(max_bytes);
        let trace = py
            .detach(|| {
                self.0
                    .trace(context, state, embodiment_id, noise, &sampling, &options)
            })
            .map_err(raise)?;
        let rows = PyDict::new(py);
        for group in [Group::State, Group::Future, Group::Action] {
            let range = trace.groups.range(group);
            rows.set_item(group.name(), (range.start, range.end))?;
        }
        let (actions, shape) = trace.actions.into_parts();
        let actions = to_numpy(py, actions, &shape)?;
        Ok((recorded(py, trace.recorded)?, rows, actions))
    }

    #[allow(clippy::too_many_arguments)]
    fn velocity(
        &self,
        py: Python<'_>,
        context: &Context,
        state: PyReadonlyArrayDyn<'_, f32>,
        embodiment_id: PyReadonlyArrayDyn<'_, i64>,
        actions: PyReadonlyArrayDyn<'_, f32>,
        timestep: PyReadonlyArrayDyn<'_, i64>,
        intervention: Vec<PyIntervention<'_>>,
        mut out: PyReadwriteArrayDyn<'_, f32>,
    ) -> PyResult<()> {
        let (state, embodiment_id) = (view(&state)?, view(&embodiment_id)?);
        let noisy = NoisyActions {
            actions: view(&actions)?,
            timestep: view(&timestep)?,
        };
        let shape = out.shape().to_vec();
        let (context, out) = (&context.0, view_mut(&mut out, &shape)?);
        let interventions = interventions(intervention)?;
        py.detach(|| {
            self.0
                .velocity(context, state, embodiment_id, noisy, &interventions, out)
        })
        .map_err(raise)
    }
}

#[pyclass(frozen, module = "saccade._saccade")]
struct KeyValues(saccade::KeyValues);

#[pymethods]
impl KeyValues {
    #[getter]
    fn batch(&self) -> usize {
        self.0.batch()
    }

    #[getter]
    fn num_vl_tokens(&self) -> usize {
        self.0.num_vl_tokens()
    }

    #[getter]
    fn nbytes(&self) -> usize {
        self.0.nbytes()
    }
}

#[pyclass(frozen, module = "saccade._saccade")]
struct CrossAttention(saccade::CrossAttention);

#[pymethods]
impl CrossAttention {
    #[new]
    fn new(py: Python<'_>, tensors: &Bound<'_, PyDict>, num_heads: usize, precision: &str) -> PyResult<Self> {
        let precision = precision.parse().map_err(raise)?;
        let held = held_tensors(tensors)?;
        let views = tensor_views(&held)?;
        py.detach(|| saccade::CrossAttention::new(&views, num_heads, precision, None))
            .map(Self)
            .map_err(raise)
    }

    #[getter]
    fn width(&self) -> usize {
        self.0.width()
    }

    #[getter]
    fn context_dim(&self) -> usize {
        self.0.context_dim()
    }

    #[getter]
    fn num_heads(&self) -> usize {
        self.0.num_heads()
    }

    #[getter]
    fn precision(&self) -> String {
        self.0.precision().to_string()
    }

    #[getter]
    fn nbytes(&self) -> usize {
        self.0.nbytes()
    }

    fn project(
        &self,
        py: Python<'_>,
        encoder_hidden_states: PyReadonlyArrayDyn<'_, f32>,
    ) -> PyResult<KeyValues> {
        let states = view(&encoder_hidden_states)?;
        py.detach(|| self.0.project(states)).map(KeyValues).map_err(raise)
    }

    #[allow(clippy::too_many_arguments)]
    fn attend(
        &self,
        py: Python<'_>,
        hidden_states: PyReadonlyArrayDyn<'_, f32>,
        kv: &KeyValues,
        key_mask: Option<PyReadonlyArrayDyn<'_, bool>>,
        key_bias: Option<PyReadonlyArrayDyn<'_, f32>>,
        mut weights: Option<PyReadwriteArrayDyn<'_, f32>>,
        mut out: PyReadwriteArrayDyn<'_, f32>,
    ) -> PyResult<()> {
        let hidden_states = view(&hidden_states)?;
        let keys = KeyOptions::default()
            .with_key_mask(optional_view(&key_mask)?)
            .with_key_bias(optional_view(&key_bias)?);
        let weights_shape = weights.as_ref().map(|weights| weights.shape().to_vec());
        let weights = match (&mut weights, &weights_shape) {
            (Some(weights), Some(shape)) => Some(view_mut(weights, shape)?),
            _ => None,
        };
        let shape = out.shape().to_vec();
        let (kv, out) = (&kv.0, view_mut(&mut out, &shape)?);
        py.detach(|| self.0.attend(hidden_states, kv, keys, weights, out))
            .map_err(raise)
    }
}

#[pyfunction]
fn parse_config<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyDict>> {
    config_dict(py, &saccade::HeadConfig::from_json(text).map_err(raise)?)
}

/// Name, without a prefix, and shape of every tensor of a head with this config.
#[pyfunction]
fn tensor_shapes(text: &str) -> PyResult<Vec<(String, Vec<usize>)>> {
    let config = saccade::HeadConfig::from_json(text).map_err(raise)?;
    Ok(saccade::tensor_shapes(&config))
}

/// What this machine can do at most on `num_threads` threads; takes some tenths of a second for each instruction set.
#[pyfunction]
fn measure_peaks(py: Python<'_>, num_threads: usize) -> PyResult<Bound<'_, PyDict>> {
    if num_threads == 0 {
        return Err(raise(Error::Input(
            "num_threads: expected at least 1, got 0".to_owned(),
        )));
    }
    let rates = PyDict::new(py);
    for isa in Isa::available() {
        let of_isa = PyDict::new(py);
        for (name, arithmetic) in [
            ("float32", Arithmetic::Float32),
            ("bfloat16", Arithmetic::Bfloat16),
            ("int8", Arithmetic::Int8),
        ] {
            let rate = py.detach(|| peak::macs_per_second(isa, arithmetic, num_threads));
            of_isa.set_item(name, rate)?;
        }
        rates.set_item(isa.to_string(), of_isa)?;
    }
    let peaks = PyDict::new(py);
    peaks.set_item("macs_per_second", rates)?;
    let read = py.detach(|| peak::read_bytes_per_second(num_threads));
    let read = read.map_err(|error| pyo3::exceptions::PyMemoryError::new_err(error.to_string()))?;
    peaks.set_item("read_bytes_per_second", read)?;
    peaks.set_item("clock_hz", py.detach(peak::clock_hz))?;
    Ok(peaks)
}

/// Begins to count where the time of this thread's calls goes.
#[pyfunction]
fn start_profile() {
    Profile::start();
}

/// Ends it: `(calls, seconds, multiply_adds, bytes)` by part.
#[pyfunction]
fn take_profile(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let profile = Profile::take().unwrap_or_default();
    let dict = PyDict::new(py);
    for part in Part::ALL {
        let counter = profile.part(part);
        dict.set_item(
            part.name(),
            (
                counter.calls,
                counter.time.as_secs_f64(),
                counter.multiply_adds,
                counter.bytes,
            ),
        )?;
    }
    Ok(dict)
}

#[pyfunction]
fn read_tensors<'py>(py: Python<'py>, source: PathBuf, prefix: &str) -> PyResult<Bound<'py, PyDict>> {
    let checkpoint = Checkpoint::open(&source).map_err(raise)?;
    let dict = PyDict::new(py);
    for name in checkpoint.names().filter(|name| name.starts_with(prefix)) {
        let data = checkpoint.read_f32(name).map_err(raise)?;
        let shape = checkpoint
            .shape(name)
            .expect("the name is one of the checkpoint's");
        dict.set_item(&name[prefix.len()..], to_numpy(py, data, shape)?)?;
    }
    Ok(dict)
}

/// Name, type, shape and bytes in the file of a tensor.
type PyTensorFacts = (String, String, Vec<usize>, u64);

/// An open checkpoint and what it is. Behind a lock, since threads share the place in its files.
#[pyclass(frozen, module = "saccade._saccade")]
struct Published(Mutex<saccade::Published>);

impl Published {
    fn lock(&self) -> MutexGuard<'_, saccade::Published> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[pymethods]
impl Published {
    #[staticmethod]
    fn open(py: Python<'_>, source: PathBuf, config: Option<String>) -> PyResult<Self> {
        py.detach(|| saccade::Published::open(&source, config.as_deref()))
            .map(|published| Self(Mutex::new(published)))
            .map_err(raise)
    }

    fn config<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        config_dict(py, &self.lock().config)
    }

    #[getter]
    fn config_json(&self) -> String {
        self.lock().config_json.clone()
    }

    #[getter]
    fn layout(&self) -> String {
        self.lock().layout.to_string()
    }

    #[getter]
    fn prefix(&self) -> &'static str {
        self.lock().prefix
    }

    #[getter]
    fn evidence(&self) -> Vec<String> {
        self.lock().evidence.clone()
    }

    #[getter]
    fn files(&self) -> Vec<PathBuf> {
        self.lock().files().map(PathBuf::from).collect()
    }

    /// The embodiments that are left, if others were taken out.
    fn kept_embodiments(&self) -> PyResult<Option<Vec<i64>>> {
        self.lock().checkpoint.kept_embodiments().map_err(raise)
    }

    fn tensors(&self) -> Vec<PyTensorFacts> {
        let fields = |tensor: TensorFacts| (tensor.name, tensor.dtype, tensor.shape, tensor.nbytes);
        self.lock().tensors().map(fields).collect()
    }

    fn check(&self) -> PyResult<()> {
        self.lock().check().map_err(raise)
    }

    /// A tensor as float32, or one slice of its first axis.
    fn read<'py>(
        &self,
        py: Python<'py>,
        name: &str,
        index: Option<usize>,
    ) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let (data, shape) = py.detach(|| {
            let published = self.lock();
            let checkpoint = &published.checkpoint;
            let shape = checkpoint.shape(name).unwrap_or_default().to_vec();
            let elements = match index {
                None => checkpoint.read(name),
                Some(index) => checkpoint.read_slices(name, index..index.saturating_add(1)),
            };
            elements
                .map(|elements| (elements.into_f32(), shape))
                .map_err(raise)
        })?;
        to_numpy(py, data, &shape[usize::from(index.is_some())..])
    }

    fn nbytes(&self, py: Python<'_>, precision: &str, num_embodiments: usize) -> PyResult<usize> {
        let precision = precision.parse().map_err(raise)?;
        py.detach(|| self.lock().nbytes(precision, num_embodiments))
            .map_err(raise)
    }
}

/// What `quantize`, `convert` and `resize` have in common.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct PyRewrite {
    source: PathBuf,
    out: PathBuf,
    config: Option<String>,
    head_only: bool,
    force: bool,
    metadata: BTreeMap<String, String>,
    max_shard_bytes: Option<u64>,
    /// Called with bytes done and bytes in all after each tensor; what it raises stops the work and is raised.
    progress: Option<Py<PyAny>>,
}

impl PyRewrite {
    /// Runs `work(source, out, options, progress)` without the interpreter.
    fn run<R: Send>(
        self,
        py: Python<'_>,
        work: impl FnOnce(&Path, &Path, RewriteOptions, &mut dyn FnMut(u64, u64) -> bool) -> saccade::Result<R>
        + Send,
    ) -> PyResult<R> {
        let options = RewriteOptions {
            config: self.config,
            head_only: self.head_only,
            force: self.force,
            metadata: self.metadata,
            max_shard_bytes: self.max_shard_bytes,
        };
        let mut raised = None;
        let result = py.detach(|| {
            work(&self.source, &self.out, options, &mut |done, total| {
                let told = Python::attach(|py| {
                    py.check_signals()?;
                    self.progress
                        .as_ref()
                        .map_or(Ok(()), |progress| progress.call1(py, (done, total)).map(|_| ()))
                });
                told.map_err(|error| raised = Some(error)).is_ok()
            })
        });
        result.map_err(|error| raised.unwrap_or_else(|| raise(error)))
    }
}

fn written_dict(py: Python<'_>, written: Written) -> PyResult<Bound<'_, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("files", written.files)?;
    dict.set_item("carried", written.carried)?;
    dict.set_item("left", written.left)?;
    dict.set_item("num_dropped", written.num_dropped)?;
    Ok(dict)
}

#[pyfunction]
fn quantize<'py>(py: Python<'py>, rewrite: PyRewrite) -> PyResult<Bound<'py, PyDict>> {
    let report = rewrite.run(py, |source, out, options, progress| {
        saccade::quantize(source, out, &options, progress)
    })?;
    let dict = written_dict(py, report.written)?;
    dict.set_item("num_quantized", report.num_quantized)?;
    dict.set_item("num_copied", report.num_copied)?;
    dict.set_item("head_bytes_before", report.head_bytes_before)?;
    dict.set_item("head_bytes_after", report.head_bytes_after)?;
    Ok(dict)
}

#[pyfunction]
fn convert<'py>(
    py: Python<'py>,
    rewrite: PyRewrite,
    embodiment_ids: Option<Vec<i64>>,
    dtype: Option<String>,
) -> PyResult<Bound<'py, PyDict>> {
    let dtype = dtype.map(|name| name.parse()).transpose().map_err(raise)?;
    let report = rewrite.run(py, |source, out, rewrite, progress| {
        let options = ConvertOptions {
            rewrite,
            embodiment_ids,
            dtype,
        };
        saccade::convert(source, out, &options, progress)
    })?;
    let dict = written_dict(py, report.written)?;
    dict.set_item("num_converted", report.num_converted)?;
    dict.set_item("num_rounded", report.num_rounded)?;
    dict.set_item("largest_error", report.largest_error)?;
    dict.set_item("largest_error_in", report.largest_error_in)?;
    dict.set_item("largest_relative_error", report.largest_relative_error)?;
    dict.set_item("embodiment_ids", report.embodiment_ids)?;
    dict.set_item("zeroed_bytes", report.zeroed_bytes)?;
    dict.set_item("bytes_before", report.bytes_before)?;
    dict.set_item("bytes_after", report.bytes_after)?;
    Ok(dict)
}

#[pyfunction]
fn resize<'py>(
    py: Python<'py>,
    rewrite: PyRewrite,
    num_future_tokens: usize,
    perturbation: f64,
    seed: u64,
) -> PyResult<Bound<'py, PyDict>> {
    let report = rewrite.run(py, |source, out, rewrite, progress| {
        let options = ResizeOptions {
            rewrite,
            num_future_tokens,
            perturbation,
            seed,
        };
        saccade::resize(source, out, &options, progress)
    })?;
    let dict = written_dict(py, report.written)?;
    dict.set_item("num_before", report.num_before)?;
    dict.set_item("num_after", report.num_after)?;
    dict.set_item("sources", report.sources)?;
    dict.set_item("future_key_bias", report.future_key_bias)?;
    dict.set_item("is_exact", report.is_exact)?;
    dict.set_item("is_widened", report.is_widened)?;
    dict.set_item("perturbation_rms", report.perturbation_rms)?;
    Ok(dict)
}

#[pyfunction]
fn available_isas() -> Vec<String> {
    Isa::available().iter().map(Isa::to_string).collect()
}

#[pyfunction]
fn selected_isa() -> PyResult<String> {
    Isa::from_env()
        .map(|isa| isa.to_string())
        .map_err(|error| raise(Error::Input(error.to_string())))
}

#[pyfunction]
fn dot_products() -> PyResult<Vec<&'static str>> {
    Isa::from_env()
        .map(Isa::dot_products)
        .map_err(|error| raise(Error::Input(error.to_string())))
}

#[pyfunction]
fn default_num_threads() -> PyResult<usize> {
    let threads = saccade::default_num_threads();
    threads
        .map(usize::from)
        .map_err(|error| raise(Error::Input(error.to_string())))
}

#[pymodule(gil_used = false)]
mod _saccade {
    #[pymodule_export]
    use super::{ActionHead, Context, CrossAttention, KeyValues, Published};
    #[pymodule_export]
    use super::{
        available_isas, convert, default_num_threads, dot_products, measure_peaks, parse_config, quantize,
        read_tensors, resize, selected_isa, start_profile, take_profile, tensor_shapes,
    };

    #[pymodule_export]
    #[allow(non_upper_case_globals)]
    const __version__: &str = env!("CARGO_PKG_VERSION");
}
