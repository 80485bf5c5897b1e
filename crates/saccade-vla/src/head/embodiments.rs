//! The embodiments of a head: how many there are, and which are loaded.

use crate::error::{Error, Result, bail, ensure};

/// The embodiments of a checkpoint, of which some are in use.
#[derive(Clone, Copy)]
pub(crate) struct Embodiments<'a> {
    /// The ids in use, ascending.
    pub ids: &'a [usize],
    /// Their number in the checkpoint.
    pub count: usize,
}

/// The embodiments `ids`, ascending, of those that are there: the ones `kept`, or else all.
///
/// # Errors
/// [`Error::Input`] for an id that is not there, and for none at all.
pub(crate) fn chosen_embodiments(
    ids: Option<&[i64]>,
    kept: Option<&[i64]>,
    num_embodiments: usize,
) -> Result<Vec<usize>> {
    let Some(ids) = ids.or(kept) else {
        return Ok((0..num_embodiments).collect());
    };
    let mut chosen = Vec::with_capacity(ids.len());
    for &id in ids {
        match usize::try_from(id) {
            Ok(known) if known < num_embodiments && kept.is_none_or(|kept| kept.contains(&id)) => {
                chosen.push(known);
            }
            _ => {
                let expected = match kept {
                    None => format!("ids from 0 to {}", num_embodiments - 1),
                    Some(kept) => {
                        let kept: Vec<String> = kept.iter().map(i64::to_string).collect();
                        format!("some of {}, which alone are in this checkpoint", kept.join(", "))
                    }
                };
                bail!(Input, "embodiment_ids"; expected "{expected}"; got "{id}");
            }
        }
    }
    chosen.sort_unstable();
    chosen.dedup();
    ensure!(!chosen.is_empty(), Input, "embodiment_ids"; expected "at least one id"; got "none");
    Ok(chosen)
}
