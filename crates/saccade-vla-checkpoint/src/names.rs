//! Names of tensors, without what wrappers of a model add to them, and of the files that hold no weights.

use std::borrow::Cow;

/// What `torch.compile` puts in front of the names of the module that it wraps.
const COMPILED: &str = "_orig_mod";

/// What `DistributedDataParallel` puts in front of all names.
const DISTRIBUTED: &str = "module";

/// A tensor's name in the model that was wrapped: without `_orig_mod.` anywhere along the path, and without `module.` at its front.
#[must_use]
pub fn plain_name(name: &str) -> Cow<'_, str> {
    let is_wrapped = |name: &str| name.split('.').any(|part| part == COMPILED);
    if !is_wrapped(name) && !name.starts_with("module.") {
        return Cow::Borrowed(name);
    }
    let (modules, tensor) = name.rsplit_once('.').unwrap_or(("", name));
    let mut path: Vec<&str> = modules.split('.').filter(|part| *part != COMPILED).collect();
    let wrappers = path.iter().take_while(|part| **part == DISTRIBUTED).count();
    path.drain(..wrappers);
    path.push(tensor);
    Cow::Owned(path.join("."))
}

/// Where lerobot keeps the statistics of its processors.
const PROCESSORS: [&str; 2] = ["policy_preprocessor", "policy_postprocessor"];

/// Whether a file of this name holds statistics in the weights' format.
pub(crate) fn is_processor(name: &str) -> bool {
    PROCESSORS.iter().any(|start| name.starts_with(start))
}
