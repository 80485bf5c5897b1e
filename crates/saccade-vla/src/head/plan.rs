//! The tensors of a head without the head: what its checkpoint must hold, and in which order it is read.

use saccade_vla_checkpoint::TensorSpec;

use super::embodiments::Embodiments;
use super::layers::HeadLayers;
use super::state_dropout::STATE_DROPOUT;
use crate::config::HeadConfig;
use crate::error::Result;
use crate::nn::source::planner::{Plan, plan};

/// Name, without a prefix, and shape of every tensor that a head's checkpoint must hold.
///
/// # Errors
/// [`Error::Interrupted`](crate::Error::Interrupted) if the call was stopped by
/// [`interruptible`](crate::interruptible).
pub fn tensor_shapes(config: &HeadConfig) -> Result<Vec<(String, Vec<usize>)>> {
    let tensors = tensor_specs(config)?.into_iter();
    Ok(tensors
        // A head without future tokens may come with an empty tensor of them, and need not.
        .filter(|tensor| !tensor.shape.contains(&0))
        .map(|tensor| (tensor.name, tensor.shape))
        .collect())
}

/// The tensors that must fit a head of this config where `has` finds them: those that it needs, and what it
/// reads if it is there.
pub(crate) fn specs_of(config: &HeadConfig, has: impl Fn(&str) -> bool) -> Result<Vec<TensorSpec>> {
    let mut specs = tensor_specs(config)?;
    if has(STATE_DROPOUT) {
        specs.push(TensorSpec::plain(STATE_DROPOUT, &[config.num_embodiments]));
    }
    Ok(specs)
}

/// Every tensor that a checkpoint of a head of this config must hold, by its name without a prefix.
pub(crate) fn tensor_specs(config: &HeadConfig) -> Result<Vec<TensorSpec>> {
    // Any embodiment: they have the same tensors.
    Ok(head_plan(config, &[0])?.specs)
}

/// The tensors of a head with these embodiments, in the order in which it is built.
pub(super) fn head_plan(config: &HeadConfig, ids: &[usize]) -> Result<Plan> {
    let count = config.num_embodiments;
    plan(|weights| HeadLayers::new(weights, config, Embodiments { ids, count }))
}

/// True if a head of this config may come with a tensor `name`, without a prefix, of this shape, that only
/// its training uses: the forks' logarithms of loss weights, and what N1.6 puts in place of a state that it
/// hides.
pub(crate) fn is_unused(config: &HeadConfig, name: &str, shape: &[usize]) -> bool {
    match name {
        "mask_token" => shape == [1, 1, config.width],
        _ => name.starts_with("task_log_sigma.") && shape.iter().all(|&size| size == 1),
    }
}
