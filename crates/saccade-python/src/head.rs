//! `saccade._saccade.ActionHead`.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArrayDyn, PyReadonlyArrayDyn, PyReadwriteArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use saccade_vla::{
    Chunking, FeatureBatch, Features, Group, Guidance, Integrator, Keep, LoadOptions, NoisyActions,
    Precision, Sampling, TraceOptions,
};

use crate::arrays::{Mask, Named, PyTensors, copied_to_numpy, optional_view, owned_to_numpy, view, view_mut};
use crate::backbone::BackboneFeatures;
use crate::config::config_dict;
use crate::context::Context;
use crate::detached::call;
use crate::error::raise;
use crate::intervention::{PyIntervention, PyRecorded, interventions, recorded};

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct ActionHead(pub(crate) Arc<saccade_vla::ActionHead>);

#[pymethods]
impl ActionHead {
    #[staticmethod]
    #[allow(clippy::too_many_arguments)]
    fn load(
        py: Python<'_>,
        source: PathBuf,
        config: Option<String>,
        embodiment_ids: Option<Vec<i64>>,
        action_horizon: Option<usize>,
        num_states: Option<usize>,
        precision: Named<Precision>,
        num_threads: Option<usize>,
    ) -> PyResult<Self> {
        let options = LoadOptions {
            config,
            embodiment_ids,
            action_horizon,
            num_states,
            precision: precision.0,
            num_threads,
        };
        call(py, || saccade_vla::ActionHead::load(&source, &options)).map(|made| Self(Arc::new(made)))
    }

    #[staticmethod]
    fn from_tensors(
        py: Python<'_>,
        tensors: PyTensors<'_>,
        config: String,
        embodiment_ids: Option<Vec<i64>>,
        num_states: Option<usize>,
        precision: Named<Precision>,
        num_threads: Option<usize>,
    ) -> PyResult<Self> {
        let options = LoadOptions {
            config: Some(config),
            embodiment_ids,
            num_states,
            precision: precision.0,
            num_threads,
            ..LoadOptions::default()
        };
        let views = tensors.views()?;
        call(py, || saccade_vla::ActionHead::from_tensors(&views, &options)).map(|made| Self(Arc::new(made)))
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
        copied_to_numpy(py, "future_tokens", tokens.data(), tokens.shape())
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

    fn warmup(
        &self,
        py: Python<'_>,
        num_vl_tokens: usize,
        batch: usize,
        num_samples: Option<usize>,
        future_refresh: Option<usize>,
    ) -> PyResult<()> {
        call(py, || {
            self.0.warmup(num_vl_tokens, batch, num_samples, future_refresh)
        })
    }

    #[allow(clippy::too_many_arguments)]
    fn encode<'py>(
        &self,
        py: Python<'py>,
        backbone_features: PyReadonlyArrayDyn<'_, f32>,
        attention_mask: Option<Mask>,
        image_mask: Option<Mask>,
        drop_vl: Option<Mask>,
        attention: bool,
        hidden: bool,
    ) -> PyResult<(Context, PyRecorded<'py>)> {
        let features = Features {
            backbone_features: view(&backbone_features)?,
            attention_mask: Mask::optional_view(&attention_mask)?,
            image_mask: Mask::optional_view(&image_mask)?,
            drop_vl: Mask::optional_view(&drop_vl)?,
            record: Keep { attention, hidden },
        };
        let mut context = call(py, || self.0.encode(&features))?;
        let kept = recorded(py, context.take_recorded())?;
        Ok((Context(Arc::new(context)), kept))
    }

    /// The context of features that a backbone of saccade's made.
    fn encode_features(&self, py: Python<'_>, features: Vec<BackboneFeatures>) -> PyResult<Context> {
        let features: Vec<_> = features.iter().map(|features| &*features.0).collect();
        let context = call(py, || self.0.encode(&FeatureBatch::new(&features)?.as_features()))?;
        Ok(Context(Arc::new(context)))
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
        guidance: Option<(f64, PyRef<'_, Context>)>,
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
        let guidance = guidance.map(|(weight, without)| (weight, Arc::clone(&without.0)));
        let guidance = guidance
            .as_ref()
            .map(|&(weight, ref without)| Guidance { without, weight });
        let interventions = interventions(intervention)?;
        let sampling = Sampling {
            num_steps,
            integrator: Integrator::from_name(integrator).map_err(raise)?,
            num_samples,
            future_refresh,
            chunking,
            guidance,
            interventions: &interventions,
        };
        call(py, || {
            self.0
                .sample(context, state, embodiment_id, noise, &sampling, out)
        })
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
        let sampling = Sampling {
            num_steps,
            interventions: &interventions,
            ..Sampling::default()
        };
        let record = Keep { attention, hidden };
        let options = TraceOptions {
            record,
            blocks,
            steps,
            max_bytes,
        };
        let trace = call(py, || {
            self.0
                .trace(context, state, embodiment_id, noise, &sampling, &options)
        })?;
        let rows = PyDict::new(py);
        for group in [Group::State, Group::Future, Group::Action] {
            let range = trace.groups.range(group);
            rows.set_item(group.name(), (range.start, range.end))?;
        }
        let actions = owned_to_numpy(py, trace.actions)?;
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
        call(py, || {
            self.0
                .velocity(context, state, embodiment_id, noisy, &interventions, out)
        })
    }
}
