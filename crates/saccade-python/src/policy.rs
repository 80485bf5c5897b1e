//! `saccade._saccade.Policy`: processor, backbone and head in one call.

use std::sync::Arc;

use pyo3::prelude::*;
use saccade_vla::PolicyContext;

use crate::backbone::{Backbone, BackboneFeatures};
use crate::context::Context;
use crate::detached::call;
use crate::head::ActionHead;
use crate::processor::{Processor, PyObservation};

/// A context of the head, and the features of each observation that it was made from.
type PyPolicyContext = (Context, Vec<BackboneFeatures>);

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct Policy(saccade_vla::Policy);

#[pymethods]
impl Policy {
    #[new]
    fn new(processor: &Processor, backbone: &Backbone, head: &ActionHead) -> Self {
        Self(saccade_vla::Policy::new(
            Arc::clone(&processor.0),
            Arc::clone(&backbone.0),
            Arc::clone(&head.0),
        ))
    }

    fn encode<'py>(
        &self,
        py: Python<'py>,
        observations: Vec<(PyObservation<'py>, bool)>,
        previous: Option<PyPolicyContext>,
    ) -> PyResult<PyPolicyContext> {
        let observations = observations
            .iter()
            .map(|(observation, plain_text)| observation.view(*plain_text))
            .collect::<PyResult<Vec<_>>>()?;
        let previous = previous.map(|(context, features)| {
            PolicyContext::new(
                context.0,
                features.into_iter().map(|features| features.0).collect(),
            )
        });
        let encoded = call(py, || self.0.encode(&observations, previous.as_ref()))?;
        let features = encoded.features().iter().map(Arc::clone);
        Ok((
            Context(Arc::clone(encoded.context())),
            features.map(BackboneFeatures).collect(),
        ))
    }
}
