//! Finding values in the text of a JSON file, so that some can be changed and every other character stays.

use std::ops::Range;

use serde_json::value::RawValue;

use crate::error::{Error, Result, problem};
use saccade_vla_checkpoint::UniqueMap;

/// A value in a config.
pub(crate) struct Found<'a> {
    /// The keys that lead to it, with dots between them.
    pub path: String,
    pub key: String,
    pub value: &'a RawValue,
}

/// All values of the objects in `value`, which is at `path`.
pub(crate) fn find<'a>(path: &str, value: &'a RawValue, found: &mut Vec<Found<'a>>) -> Result<()> {
    let broken = |error: serde_json::Error| Error::Checkpoint(problem!("config"; "{path}: {error}"));
    match value.get().as_bytes().first() {
        Some(b'{') => {
            let object: UniqueMap<&RawValue> = serde_json::from_str(value.get()).map_err(broken)?;
            for (key, value) in object.0 {
                let path = match path {
                    "" => key.clone(),
                    _ => format!("{path}.{key}"),
                };
                find(&path, value, found)?;
                found.push(Found { path, key, value });
            }
        }
        Some(b'[') => {
            let array: Vec<&RawValue> = serde_json::from_str(value.get()).map_err(broken)?;
            for (index, value) in array.into_iter().enumerate() {
                find(&format!("{path}[{index}]"), value, found)?;
            }
        }
        _ => {}
    }
    Ok(())
}

/// Where in `text` the entry of an object with this `key` is, given where its `value` is, with the comma that goes with it; none if the key is
/// written with escapes.
pub(crate) fn entry(text: &str, value: &Range<usize>, key: &str) -> Option<Range<usize>> {
    let before = text[..value.start].trim_end().strip_suffix(':')?.trim_end();
    let before = before.strip_suffix('"')?.strip_suffix(key)?.strip_suffix('"')?;
    let before = before.trim_end();
    let after = text[value.end..].trim_start();
    Some(match after.strip_prefix(',') {
        Some(after) => before.len()..text.len() - after.len(),
        None => before.trim_end_matches(',').len()..value.end,
    })
}

/// The position in `text` of a value that was read from it.
pub(crate) fn span(text: &str, value: &RawValue) -> Range<usize> {
    let start = value.get().as_ptr() as usize - text.as_ptr() as usize;
    start..start + value.get().len()
}
