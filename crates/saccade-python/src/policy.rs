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
            let features = features.into_iter().map(|features| features.0).collect();
            PolicyContext {
                context: context.0,
                features,
            }
        });
        let encoded = call(py, || self.0.encode(&observations, previous.as_ref()))?;
        let features = encoded.features.into_iter().map(BackboneFeatures);
        Ok((Context(encoded.context), features.collect()))
    }
}
