//! What changes in a checkpoint's config when it gets another number of future tokens.

use std::ops::Range;

use serde_json::Value;
use serde_json::value::RawValue;

use crate::config::{HEAD_KEY, HeadConfig, OWN_KEY};
use crate::error::{Error, Result, ensure};
use crate::release::Feature;
use crate::rewrite::json_edit::{Found, entry, find, span};

/// Merging compares every token with every other, and a chunk takes time in proportion to their number.
const MAX_TOKENS: usize = 4096;

/// The key of the number of future tokens in published configs.
const COUNT_KEY: &str = "num_target_vision_tokens";

/// The key of their biases in saccade's own part of a config.
const BIAS_KEY: &str = "future_key_bias";

/// The text of a config, which holds the head's, for `num_future_tokens` tokens without biases; all else is as it is written.
///
/// # Errors
/// [`Error::Checkpoint`] for a config that is broken, says different numbers or is of a version without future tokens; [`Error::Input`] for a
/// number out of range.
pub fn resized_config(config_json: &str, num_future_tokens: usize) -> Result<String> {
    let config = HeadConfig::from_json(config_json)?;
    Ok(config_edit(&config, config_json, num_future_tokens)?
        .config(None)
        .0)
}

/// What changes in a checkpoint's config: what can be said without its tensors.
pub(super) struct ConfigEdit {
    given: String,
    count: usize,
    /// Where the number of future tokens is.
    counts: Vec<Range<usize>>,
    /// The head's own object; none if the config has none, as lerobot's.
    head: Option<HeadObject>,
}

/// An object in a config's text.
struct HeadObject {
    range: Range<usize>,
    has_count: bool,
    /// Where saccade's own key has its value, and the object that it is.
    own: Option<(Range<usize>, serde_json::Map<String, Value>)>,
}

/// How the config `given`, which is `config`, becomes one of `count` future tokens.
///
/// # Errors
/// [`Error::Checkpoint`] for a version without future tokens, a head that has none, and numbers that contradict each other;
/// [`Error::Input`] for a count out of range.
pub(super) fn config_edit(config: &HeadConfig, given: &str, count: usize) -> Result<ConfigEdit> {
    let before = config.num_future_tokens;
    ensure!(
        config.version.has(Feature::FutureTokens), Checkpoint, "source";
        "GR00T {} has no future tokens, so there is no number of them to change", config.version
    );
    ensure!(
        before != 0, Checkpoint, "source";
        "it has no future tokens: there is nothing to copy, and new ones would have to be trained"
    );
    ensure!(count <= MAX_TOKENS, Input, "num_future_tokens"; expected "at most {MAX_TOKENS}"; got "{count}");
    ensure!(
        before <= MAX_TOKENS, Checkpoint, "source"; "it has {before} future tokens, expected at most {MAX_TOKENS}"
    );
    let mut found = Vec::new();
    let whole: &RawValue = serde_json::from_str(given).map_err(|source| Error::json("config", source))?;
    find("", whole, &mut found)?;
    let counts: Vec<&Found<'_>> = found.iter().filter(|place| place.key == COUNT_KEY).collect();
    let others: Vec<String> = counts
        .iter()
        .filter(|place| serde_json::from_str::<usize>(place.value.get()).ok() != Some(before))
        .map(|place| format!("{} is {}", place.path, place.value.get()))
        .collect();
    ensure!(
        others.is_empty(), Checkpoint, "config";
        "{}, but the head has {before} future tokens", others.join("; ")
    );
    let head = found
        .iter()
        .find(|place| place.path == HEAD_KEY)
        .map(|place| place.value)
        .or_else(|| (!found.iter().any(|place| place.path == "type")).then_some(whole));
    let in_head = |key: &str, head: &RawValue| {
        let path = match std::ptr::eq(head, whole) {
            true => key.to_owned(),
            false => format!("{HEAD_KEY}.{key}"),
        };
        found.iter().find(|place| place.path == path)
    };
    Ok(ConfigEdit {
        given: given.to_owned(),
        count,
        counts: counts.iter().map(|place| span(given, place.value)).collect(),
        head: head.map(|head| HeadObject {
            range: span(given, head),
            has_count: in_head(COUNT_KEY, head).is_some(),
            own: in_head(OWN_KEY, head).map(|place| {
                let object = serde_json::from_str(place.value.get()).unwrap_or_default();
                (span(given, place.value), object)
            }),
        }),
    })
}

impl ConfigEdit {
    /// The text of the new `config.json`, and that of a file of saccade's own if the bias has no place in it.
    pub(super) fn config(&self, bias: Option<&[f32]>) -> (String, Option<String>) {
        let count = self.count.to_string();
        let mut edits: Vec<(Range<usize>, String)> = self
            .counts
            .iter()
            .map(|range| (range.clone(), count.clone()))
            .collect();
        let own = bias.map(|bias| serde_json::json!({ BIAS_KEY: bias }));
        let mut own_file = None;
        match &self.head {
            None => own_file = own.map(|own| format!("{own:#}\n")),
            Some(head) => {
                // New keys come first, spaced as the first one is.
                let start = head.range.start + 1;
                let rest = &self.given[start..head.range.end];
                let space = &rest[..rest.len() - rest.trim_start().len()];
                let mut first = String::new();
                if !head.has_count {
                    first += &format!("{space}\"{COUNT_KEY}\": {count},");
                }
                match (&head.own, own) {
                    (Some((range, object)), own) => {
                        let mut object = object.clone();
                        object.remove(BIAS_KEY);
                        object.extend(own.and_then(|own| own.as_object().cloned()).into_iter().flatten());
                        edits.push(match entry(&self.given, range, OWN_KEY) {
                            Some(entry) if object.is_empty() => (entry, String::new()),
                            _ => (range.clone(), Value::Object(object).to_string()),
                        });
                    }
                    (None, Some(own)) => first += &format!("{space}\"{OWN_KEY}\": {own},"),
                    (None, None) => {}
                }
                edits.push((start..start, first));
            }
        }
        edits.sort_by_key(|(range, _)| range.start);
        let mut text = self.given.clone();
        for (range, new) in edits.into_iter().rev() {
            text.replace_range(range, &new);
        }
        (text, own_file)
    }
}
