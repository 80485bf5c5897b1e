//! A head's config as a dict.

use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use saccade_vla::HeadConfig;

use crate::arrays::set_fields;
use crate::detached::call;

pub(crate) fn config_dict<'py>(py: Python<'py>, config: &HeadConfig) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("version", config.version.name())?;
    dict.set_item("mask_mode", config.mask_mode())?;
    let decoders = config.decoders.iter().map(|(name, width)| (name, *width));
    dict.set_item("decoders", PyTuple::new(py, decoders)?)?;
    let future_key_bias = config.future_key_bias.as_ref();
    let future_key_bias = future_key_bias.map(|bias| PyTuple::new(py, bias)).transpose()?;
    dict.set_item("future_key_bias", future_key_bias)?;
    set_fields!(dict, config;
        interleave_self_attention use_vlln add_pos_embed width num_layers num_heads head_dim context_dim
        attend_text_every_n_blocks vl_num_layers vl_num_heads vl_head_dim num_future_tokens action_horizon
        action_dim encoder_action_dim state_dim state_history num_states hidden_dim num_embodiments
        num_timestep_buckets num_steps max_positions);
    Ok(dict)
}

/// A config with the number of states in an observation, unless that is the config's own.
#[pyfunction]
#[pyo3(signature = (text, num_states=None))]
pub(crate) fn parse_config<'py>(
    py: Python<'py>,
    text: &str,
    num_states: Option<usize>,
) -> PyResult<Bound<'py, PyDict>> {
    let config = call(py, || {
        let config = HeadConfig::from_json(text)?;
        match num_states {
            Some(num_states) => config.with_num_states(num_states),
            None => Ok(config),
        }
    })?;
    config_dict(py, &config)
}

/// Name, without a prefix, and shape of every tensor of a head with this config.
#[pyfunction]
pub(crate) fn tensor_shapes(py: Python<'_>, text: &str) -> PyResult<Vec<(String, Vec<usize>)>> {
    call(py, || saccade_vla::tensor_shapes(&HeadConfig::from_json(text)?))
}
