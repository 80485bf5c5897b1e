//! A head in a checkpoint: which embodiments it has, and whether its tensors fit a config.

use saccade_checkpoint::{Checkpoint, spec};

use crate::config::HeadConfig;
use crate::error::{Error, Result};
use crate::head::plan::{is_unused, tensor_specs};

/// The metadata key of the embodiments that were kept when others were removed.
pub(crate) const KEPT_EMBODIMENTS: &str = "saccade_embodiment_ids";

/// The embodiments whose layers were kept when others were removed; none if all are there.
///
/// # Errors
/// [`Error::Checkpoint`] if the files' metadata list anything but numbers.
pub(crate) fn kept_embodiments(checkpoint: &Checkpoint) -> Result<Option<Vec<i64>>> {
    let Some(listed) = checkpoint.metadata().get(KEPT_EMBODIMENTS) else {
        return Ok(None);
    };
    let ids: std::result::Result<_, _> = listed.split(',').map(str::parse).collect();
    ids.map(Some).map_err(|_| {
        Error::Checkpoint(format!(
            "source: {KEPT_EMBODIMENTS} in the metadata is `{listed}`, expected numbers with commas between them"
        ))
    })
}

/// Checks that exactly the tensors of a head of this config are under `prefix`, each of the right shape and a readable type. What only
/// training uses may be there too.
///
/// # Errors
/// [`Error::Checkpoint`] that lists every tensor that is missing, unknown, of the wrong shape or of another type.
pub(crate) fn check(checkpoint: &Checkpoint, prefix: &str, config: &HeadConfig) -> Result<()> {
    let is_unused = |name: &str, shape: &[usize]| is_unused(config, name, shape);
    let problems = checkpoint.problems(prefix, &tensor_specs(config)?, is_unused);
    if problems.is_empty() {
        return Ok(());
    }
    Err(Error::Checkpoint(format!(
        "source: {}",
        spec::list(&problems, "the config")
    )))
}
