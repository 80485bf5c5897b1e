//! Which embodiments a checkpoint still has.

use saccade_vla_checkpoint::Checkpoint;

use crate::error::{Error, Result};

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
