//! Checkpoints with another number of future tokens.
//!
//! Copies of a token, each with the logarithm of their number taken off its key's logit in every self-attention block, are together what the
//! token was (spec I2), and so is one token in place of equal ones with the logarithm of their number added. No published layout has a place
//! for such a bias, so it stands in a key of saccade's own: exact in saccade, while other programs see plain copies.

use std::ops::Range;
use std::path::Path;

use serde_json::Value;
use serde_json::value::RawValue;

use crate::checkpoint::UniqueMap;
use crate::config::HeadConfig;
use crate::convert::Float;
use crate::error::{Error, Result};
use crate::head::plan::FUTURE_TOKENS;
use crate::rewrite::{RewriteOptions, Source, Written};
use crate::writer::OWN_CONFIG;

/// Merging compares every token with every other, and a chunk takes time in proportion to their number.
const MAX_TOKENS: usize = 4096;

/// Logarithms of sums of exponentials of logarithms are off by rounding; a bias of less says nothing.
const NO_BIAS: f64 = 1e-6;

/// The key of the number of future tokens in published configs, and that of saccade's own.
const COUNT_KEY: &str = "num_target_vision_tokens";
const OWN_KEY: &str = "saccade";
const BIAS_KEY: &str = "future_key_bias";

/// How a checkpoint is resized.
#[derive(Clone, Debug, Default)]
pub struct ResizeOptions {
    /// What is common to all rewriting.
    pub rewrite: RewriteOptions,
    /// Future tokens that the copy is to have.
    pub num_future_tokens: usize,
    /// Root mean square of what is added to the copies of tokens, as a part of that of all tokens; 0 adds nothing.
    pub perturbation: f64,
    /// Of what is added.
    pub seed: u64,
}

/// What [`resize`] wrote.
#[derive(Clone, Debug)]
pub struct ResizeReport {
    /// The files.
    pub written: Written,
    /// Future tokens of the source.
    pub num_before: usize,
    /// Future tokens of the copy.
    pub num_after: usize,
    /// For each token of the copy, which ones of the source it stands for: one if it is a copy, several if they were merged.
    pub sources: Vec<Vec<usize>>,
    /// What saccade adds to the logits of the tokens' keys; none if nothing.
    pub future_key_bias: Option<Vec<f32>>,
    /// Whether chunks of actions in saccade stay what they were, but for rounding.
    pub is_exact: bool,
    /// Whether the tokens are float32 now because the type that they had cannot hold the new ones.
    pub is_widened: bool,
    /// Root mean square of what was added to copies.
    pub perturbation_rms: f64,
}

/// Writes the checkpoint `source` to the directory `out` with another number of future tokens. Going up, tokens are copied in turn; going
/// down, the most similar are merged. All other tensors are copied bit for bit, and the number is changed wherever the config says it.
///
/// `progress(done, total)`, in bytes read, is called after each tensor; where it returns false, nothing is written.
///
/// # Errors
/// As [`ActionHead::load`](crate::ActionHead::load); [`Error::Checkpoint`] for a version without future tokens, a source that has none, one
/// whose config says different numbers, and tokens that are not finite; [`Error::Input`] for a number or a perturbation out of range, and if
/// `out` is there and `force` is not given, holds anything but such a checkpoint, or is the source; [`Error::Output`] if it cannot be
/// written.
pub fn resize(
    source: &Path,
    out: &Path,
    options: &ResizeOptions,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<ResizeReport> {
    let source = Source::open(source, options.rewrite.config.as_deref())?;
    let config = &source.config;
    let plan = plan(config, &source.given_config, options.num_future_tokens)?;
    let name = format!("{}{FUTURE_TOKENS}", source.prefix);
    let tokens = source.checkpoint.read(&name)?.into_f32();
    if let Some(bad) = tokens.iter().find(|value| !value.is_finite()) {
        return Err(Error::Checkpoint(format!(
            "source: {name} holds {bad}, expected finite numbers"
        )));
    }
    let no_bias = || vec![0.0; config.num_future_tokens];
    let bias = config.future_key_bias.clone().unwrap_or_else(no_bias);
    let mut resized = resized(&tokens, config.width, &bias, options.num_future_tokens);
    let perturbation_rms = resized.perturb(&tokens, config.num_future_tokens, options)?;

    let mut stored = source.as_it_is(&name)?;
    let dtype = Float::of(stored.dtype).expect("the tokens are checked to be floating point");
    let is_widened = resized.tokens.iter().any(|&value| dtype.round(value) != value);
    let dtype = if is_widened { Float::F32 } else { dtype };
    (stored.dtype, stored.shape) = (dtype.dtype(), vec![options.num_future_tokens, config.width]);
    let mut bytes = Vec::new();
    dtype.write(&resized.tokens, &mut bytes);

    let mut planned = Vec::new();
    for other in source.names(&options.rewrite) {
        if other != name {
            planned.push(source.as_it_is(other)?);
        }
    }
    planned.push(stored);
    let (config_text, own) = plan.config(resized.bias.as_deref());
    let small = [
        ("config.json", Some(config_text.as_str())),
        (OWN_CONFIG, own.as_deref()),
    ];
    let rewrite = &options.rewrite;
    let written = source.write(out, rewrite, &small, planned, &mut progress, |other, writer| {
        if other == name {
            writer.tensor(&name, &bytes)
        } else {
            source.copy(other, writer)
        }
    })?;
    Ok(ResizeReport {
        written,
        num_before: config.num_future_tokens,
        num_after: options.num_future_tokens,
        is_exact: resized.is_exact && perturbation_rms == 0.0,
        sources: resized.sources,
        future_key_bias: resized.bias,
        is_widened,
        perturbation_rms,
    })
}

/// What changes in a checkpoint's config: what can be said without its tensors.
pub(crate) struct Plan {
    given: String,
    count: usize,
    /// Where the number of future tokens stands.
    counts: Vec<Range<usize>>,
    /// The head's own object; none if the config has none, as lerobot's.
    head: Option<Object>,
}

/// An object in a config's text.
struct Object {
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
pub(crate) fn plan(config: &HeadConfig, given: &str, count: usize) -> Result<Plan> {
    let bad = |problem: String| Err(Error::Checkpoint(problem));
    let before = config.num_future_tokens;
    if config.version != "n1.5" {
        return bad(format!(
            "source: GR00T {} has no future tokens, so there is no number of them to change",
            config.version.to_uppercase()
        ));
    }
    if before == 0 {
        return bad(
            "source: it has no future tokens: there is nothing to copy, and new ones would have to be trained".to_owned(),
        );
    }
    if count > MAX_TOKENS {
        return Err(Error::Input(format!(
            "num_future_tokens: expected at most {MAX_TOKENS}, got {count}"
        )));
    }
    if before > MAX_TOKENS {
        return bad(format!(
            "source: it has {before} future tokens, expected at most {MAX_TOKENS}"
        ));
    }
    let mut places = Vec::new();
    let whole: &RawValue = serde_json::from_str(given)
        .map_err(|error| Error::Checkpoint(format!("config: not valid JSON: {error}")))?;
    find("", whole, &mut places)?;
    let counts: Vec<&Place<'_>> = places.iter().filter(|place| place.key == COUNT_KEY).collect();
    let others: Vec<String> = counts
        .iter()
        .filter(|place| serde_json::from_str::<usize>(place.value.get()).ok() != Some(before))
        .map(|place| format!("{} is {}", place.path, place.value.get()))
        .collect();
    if !others.is_empty() {
        return bad(format!(
            "config: {}, but the head has {before} future tokens",
            others.join("; ")
        ));
    }
    let head = places
        .iter()
        .find(|place| place.path == "action_head_cfg")
        .map(|place| place.value)
        .or_else(|| (!places.iter().any(|place| place.path == "type")).then_some(whole));
    let in_head = |key: &str, head: &RawValue| {
        let path = if std::ptr::eq(head, whole) {
            key.to_owned()
        } else {
            format!("action_head_cfg.{key}")
        };
        places.iter().find(|place| place.path == path)
    };
    Ok(Plan {
        given: given.to_owned(),
        count,
        counts: counts.iter().map(|place| span(given, place.value)).collect(),
        head: head.map(|head| Object {
            range: span(given, head),
            has_count: in_head(COUNT_KEY, head).is_some(),
            own: in_head(OWN_KEY, head).map(|place| {
                let object = serde_json::from_str(place.value.get()).unwrap_or_default();
                (span(given, place.value), object)
            }),
        }),
    })
}

impl Plan {
    /// The text of the new `config.json`, and that of a file of saccade's own beside it if the bias has no place in there.
    pub(crate) fn config(&self, bias: Option<&[f32]>) -> (String, Option<String>) {
        let count = self.count.to_string();
        let mut edits: Vec<(Range<usize>, String)> = self
            .counts
            .iter()
            .map(|range| (range.clone(), count.clone()))
            .collect();
        let own = bias.map(|bias| serde_json::json!({ BIAS_KEY: bias }));
        let mut beside = None;
        match &self.head {
            None => beside = own.map(|own| format!("{own:#}\n")),
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
                        edits.push(match entry(&self.given, range) {
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
        (text, beside)
    }
}

/// A value in a config.
struct Place<'a> {
    /// The keys that lead to it, with dots between them.
    path: String,
    key: String,
    value: &'a RawValue,
}

/// All values of the objects in `value`, which is at `path`.
fn find<'a>(path: &str, value: &'a RawValue, places: &mut Vec<Place<'a>>) -> Result<()> {
    let broken = |error: serde_json::Error| Error::Checkpoint(format!("config: {path}: {error}"));
    match value.get().as_bytes().first() {
        Some(b'{') => {
            let object: UniqueMap<&RawValue> = serde_json::from_str(value.get()).map_err(broken)?;
            for (key, value) in object.0 {
                let path = match path {
                    "" => key.clone(),
                    _ => format!("{path}.{key}"),
                };
                find(&path, value, places)?;
                places.push(Place { path, key, value });
            }
        }
        Some(b'[') => {
            let array: Vec<&RawValue> = serde_json::from_str(value.get()).map_err(broken)?;
            for (index, value) in array.into_iter().enumerate() {
                find(&format!("{path}[{index}]"), value, places)?;
            }
        }
        _ => {}
    }
    Ok(())
}

/// Where in `text` saccade's own key and its `value` stand, with the comma that goes with them; none if the key is written with escapes.
fn entry(text: &str, value: &Range<usize>) -> Option<Range<usize>> {
    let before = text[..value.start].trim_end().strip_suffix(':')?.trim_end();
    let before = before
        .strip_suffix('"')?
        .strip_suffix(OWN_KEY)?
        .strip_suffix('"')?;
    let before = before.trim_end();
    let after = text[value.end..].trim_start();
    Some(match after.strip_prefix(',') {
        Some(after) => before.len()..text.len() - after.len(),
        None => before.trim_end_matches(',').len()..value.end,
    })
}

/// Where in `text` the value stands that was read from it.
fn span(text: &str, value: &RawValue) -> Range<usize> {
    let start = value.get().as_ptr() as usize - text.as_ptr() as usize;
    start..start + value.get().len()
}

/// Future tokens of another number.
pub(crate) struct Resized {
    /// `(count, width)`.
    pub tokens: Vec<f32>,
    /// `(count)`; none if all are zero.
    pub bias: Option<Vec<f32>>,
    pub sources: Vec<Vec<usize>>,
    pub is_exact: bool,
}

/// `count` tokens in place of `tokens`, rows of `width`, which have `bias` on their keys.
pub(crate) fn resized(tokens: &[f32], width: usize, bias: &[f32], count: usize) -> Resized {
    let before = bias.len();
    let sources: Vec<Vec<usize>> = if count >= before {
        (0..count).map(|index| vec![index % before]).collect()
    } else {
        merged(tokens, width, bias, count)
    };
    let row = |index: usize| &tokens[index * width..(index + 1) * width];
    let mut resized = Resized {
        tokens: Vec::with_capacity(count * width),
        bias: None,
        is_exact: count > 0
            && sources
                .iter()
                .all(|group| group.iter().all(|&one| row(one) == row(group[0]))),
        sources,
    };
    let mut biases = Vec::with_capacity(count);
    for group in &resized.sources {
        let copies = match count >= before {
            true => count / before + usize::from(group[0] < count % before),
            false => 1,
        };
        let weights: Vec<f64> = group.iter().map(|&one| f64::from(bias[one]).exp()).collect();
        let total: f64 = weights.iter().sum();
        biases.push((total / copies as f64).ln());
        if group.iter().all(|&one| row(one) == row(group[0])) {
            resized.tokens.extend(row(group[0]));
            continue;
        }
        resized.tokens.extend((0..width).map(|column| {
            let terms = group.iter().zip(&weights);
            let sum: f64 = terms
                .map(|(&one, weight)| weight * f64::from(row(one)[column]))
                .sum();
            (sum / total) as f32
        }));
    }
    if biases.iter().any(|bias| bias.abs() > NO_BIAS) {
        resized.bias = Some(biases.into_iter().map(|bias| bias as f32).collect());
    }
    resized
}

/// Which tokens are merged so that `count` are left: always the two groups that are most alike in direction, larger groups later. Each block
/// normalises its rows, so that how long a token is says little.
fn merged(tokens: &[f32], width: usize, bias: &[f32], count: usize) -> Vec<Vec<usize>> {
    if count == 0 {
        return Vec::new();
    }
    struct Group {
        members: Vec<usize>,
        weight: f64,
        /// The weighted sum of the members' directions.
        sum: Vec<f64>,
    }
    let direction = |index: usize| {
        let row = tokens[index * width..(index + 1) * width]
            .iter()
            .map(|&value| f64::from(value));
        let norm = row.clone().map(|value| value * value).sum::<f64>().sqrt();
        let norm = if norm > 0.0 { norm } else { 1.0 };
        row.map(|value| value / norm).collect::<Vec<f64>>()
    };
    // What merging adds to the weighted squared distances of directions from their group's mean.
    let cost = |a: &Group, b: &Group| {
        let both = a.sum.iter().zip(&b.sum);
        let squared: f64 = both.map(|(x, y)| (x / a.weight - y / b.weight).powi(2)).sum();
        squared * a.weight * b.weight / (a.weight + b.weight)
    };
    let mut groups: Vec<Option<Group>> = (0..bias.len())
        .map(|index| {
            let weight = f64::from(bias[index]).exp();
            Some(Group {
                members: vec![index],
                weight,
                sum: direction(index).into_iter().map(|value| weight * value).collect(),
            })
        })
        .collect();
    // Of each group the cheapest one after it.
    let cheapest = |groups: &[Option<Group>], index: usize| {
        let group = groups[index].as_ref()?;
        let mut best: Option<(f64, usize)> = None;
        for (other, candidate) in groups.iter().enumerate().skip(index + 1) {
            let Some(candidate) = candidate else { continue };
            let cost = cost(group, candidate);
            if best.is_none_or(|(least, _)| cost < least) {
                best = Some((cost, other));
            }
        }
        best
    };
    let mut best: Vec<Option<(f64, usize)>> =
        (0..groups.len()).map(|index| cheapest(&groups, index)).collect();
    for _ in count..groups.len() {
        let found = best
            .iter()
            .enumerate()
            .filter_map(|(index, one)| one.map(|(cost, other)| (cost, index, other)));
        let (_, first, second) = found
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .expect("there are more groups than are wanted");
        let taken = groups[second].take().expect("it was there to be found");
        let group = groups[first].as_mut().expect("it was there to be found");
        group.members.extend(taken.members);
        group.members.sort_unstable();
        group.weight += taken.weight;
        for (sum, more) in group.sum.iter_mut().zip(taken.sum) {
            *sum += more;
        }
        best[second] = None;
        for index in 0..groups.len() {
            let is_stale = best[index].is_some_and(|(_, other)| other == first || other == second);
            if is_stale || index == first {
                best[index] = cheapest(&groups, index);
            } else if index < first
                && let (Some(one), Some(changed)) = (&groups[index], &groups[first])
            {
                let cost = cost(one, changed);
                if best[index].is_none_or(|(least, other)| (cost, first) < (least, other)) {
                    best[index] = Some((cost, first));
                }
            }
        }
    }
    groups.into_iter().flatten().map(|group| group.members).collect()
}

impl Resized {
    /// Adds noise to the copies, which are the rows from number `before` on; returns its root mean square.
    fn perturb(&mut self, tokens: &[f32], before: usize, options: &ResizeOptions) -> Result<f64> {
        let amount = options.perturbation;
        if !(amount.is_finite() && amount >= 0.0) {
            return Err(Error::Input(format!(
                "perturbation: expected a finite number of at least 0, got {amount}"
            )));
        }
        if amount == 0.0 {
            return Ok(0.0);
        }
        let count = self.sources.len();
        if count <= before {
            return Err(Error::Input(format!(
                "perturbation: copies are perturbed, and of {before} future tokens {count} have none"
            )));
        }
        let squares: f64 = tokens.iter().map(|&value| f64::from(value).powi(2)).sum();
        let scale = amount * (squares / tokens.len() as f64).sqrt();
        let mut state = options.seed;
        let width = tokens.len() / before;
        let mut added = 0.0;
        for value in &mut self.tokens[before * width..] {
            // Uniform, since that is the same on every machine; of variance 1 between these ends.
            let noise = (2.0 * uniform(&mut state) - 1.0) * 3.0_f64.sqrt();
            added += (scale * noise).powi(2);
            *value = (f64::from(*value) + scale * noise) as f32;
        }
        if self.tokens.iter().any(|value| !value.is_finite()) {
            return Err(Error::Input(format!(
                "perturbation: {amount} makes tokens that float32 cannot hold"
            )));
        }
        Ok((added / ((count - before) * width) as f64).sqrt())
    }
}

/// SplitMix64: the next number from 0 to 1.
fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut bits = *state;
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((bits ^ (bits >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: &str = r#"{
  "action_head_cfg": {
    "action_dim": 3, "action_horizon": 5, "add_pos_embed": true, "backbone_embedding_dim": 8, "hidden_size": 7,
    "input_embedding_dim": 12, "max_state_dim": 6, "noise_s": 0.99900000000000000001, "num_inference_timesteps": 4,
    "num_target_vision_tokens": 4, "num_timestep_buckets": 1000, "use_vlln": false,
    "diffusion_model_cfg": {"num_layers": 2, "num_attention_heads": 3, "attention_head_dim": 4, "positional_embeddings": null, "cross_attention_dim": 8, "interleave_self_attention": true}
  },
  "model_type": "gr00t_n1_5", "extra": [{"num_target_vision_tokens": 4}]
}"#;

    fn planned(given: &str, count: usize) -> Result<Plan> {
        plan(&HeadConfig::from_json(given)?, given, count)
    }

    #[test]
    fn all_of_a_config_but_the_number_stays_as_it_is_written() {
        let (text, beside) = planned(CONFIG, 9).unwrap().config(None);
        assert_eq!(
            text,
            CONFIG.replace("num_target_vision_tokens\": 4", "num_target_vision_tokens\": 9")
        );
        assert_eq!(beside, None);
    }

    #[test]
    fn a_bias_comes_and_goes() {
        let (with, _) = planned(CONFIG, 2).unwrap().config(Some(&[0.5, -1.0]));
        let config = HeadConfig::from_json(&with).unwrap();
        assert_eq!(
            (config.num_future_tokens, config.future_key_bias),
            (2, Some(vec![0.5, -1.0]))
        );
        let (other, _) = planned(&with, 1).unwrap().config(Some(&[0.25]));
        assert_eq!(
            HeadConfig::from_json(&other).unwrap().future_key_bias,
            Some(vec![0.25])
        );
        let (back, _) = planned(&other, 4).unwrap().config(None);
        assert_eq!(back, CONFIG);
        // Wherever the key stands.
        for written in [
            CONFIG.replace(
                "\"use_vlln\": false,",
                "\"saccade\" :\t{\"future_key_bias\": null} , \"use_vlln\": false,",
            ),
            CONFIG.replace(
                "\"interleave_self_attention\": true}",
                "\"interleave_self_attention\": true}\n, \"saccade\": {}",
            ),
        ] {
            let (back, _) = planned(&written, 4).unwrap().config(None);
            let value: Value = serde_json::from_str(&back).unwrap();
            assert_eq!(value, serde_json::from_str::<Value>(CONFIG).unwrap(), "{back}");
        }
    }

    #[test]
    fn a_number_that_the_config_leaves_out_is_written() {
        let given = CONFIG.replace("\"num_target_vision_tokens\": 4, ", "");
        let config = HeadConfig::from_json(&given).unwrap();
        assert_eq!(config.num_future_tokens, 32);
        let given = given.replace("{\"num_target_vision_tokens\": 4}", "");
        let (text, _) = plan(&config, &given, 40).unwrap().config(None);
        assert_eq!(HeadConfig::from_json(&text).unwrap().num_future_tokens, 40);
    }

    #[test]
    fn numbers_that_disagree_are_all_listed() {
        let given = CONFIG.replace(
            "[{\"num_target_vision_tokens\": 4}]",
            "[{\"num_target_vision_tokens\": 32}]",
        );
        let error = planned(&given, 9).err().unwrap().to_string();
        assert!(
            error.contains("extra[0].num_target_vision_tokens is 32"),
            "{error}"
        );
        assert!(error.contains("4 future tokens"), "{error}");
    }

    #[test]
    fn a_config_without_a_head_is_left_alone() {
        let config = HeadConfig::from_json(CONFIG).unwrap();
        let given = "{\"type\": \"groot\", \"chunk_size\": 50}";
        let plan = plan(&config, given, 8).unwrap();
        assert_eq!(plan.config(None), (given.to_owned(), None));
        let (text, beside) = plan.config(Some(&[0.5]));
        assert_eq!(text, given);
        let beside: Value = serde_json::from_str(&beside.unwrap()).unwrap();
        assert_eq!(beside, serde_json::json!({"future_key_bias": [0.5]}));
    }

    /// What a token adds to the softmax of any query, and what it is: tokens and weights as a sum over equal rows.
    fn mass(tokens: &[f32], width: usize, bias: Option<&[f32]>) -> Vec<(Vec<u32>, f64)> {
        let mut found: std::collections::BTreeMap<Vec<u32>, f64> = Default::default();
        for (index, row) in tokens.chunks_exact(width).enumerate() {
            let weight = bias.map_or(1.0, |bias| f64::from(bias[index]).exp());
            *found
                .entry(row.iter().map(|value| value.to_bits()).collect())
                .or_default() += weight;
        }
        found.into_iter().collect()
    }

    proptest::proptest! {
        #[test]
        fn copies_weigh_what_the_token_did_and_merge_again(
            before in 1usize..9,
            more in 0usize..30,
            width in 1usize..7,
            seed: u64,
        ) {
            let mut state = seed;
            let mut number = || uniform(&mut state) as f32 - 0.5;
            let tokens: Vec<f32> = (0..before * width).map(|_| number()).collect();
            let bias: Vec<f32> = (0..before).map(|_| number()).collect();
            let grown = resized(&tokens, width, &bias, before + more);
            proptest::prop_assert!(grown.is_exact);
            proptest::prop_assert_eq!(&grown.tokens[..before * width], &tokens[..]);
            let (was, is) = (mass(&tokens, width, Some(&bias)), mass(&grown.tokens, width, grown.bias.as_deref()));
            for ((row, was), (other, is)) in was.iter().zip(&is) {
                proptest::prop_assert_eq!(row, other);
                proptest::prop_assert!((was - is).abs() < 1e-6 * was, "{} {}", was, is);
            }
            let all_zero = vec![0.0; before + more];
            let shrunk = resized(&grown.tokens, width, grown.bias.as_deref().unwrap_or(&all_zero), before);
            // Rows of one element have one of two directions: merging those of different lengths is as good.
            if width > 1 {
                proptest::prop_assert!(shrunk.is_exact);
                proptest::prop_assert_eq!(&shrunk.tokens, &tokens);
                for (was, is) in bias.iter().zip(shrunk.bias.unwrap_or(vec![0.0; before])) {
                    proptest::prop_assert!((was - is).abs() < 2e-6, "{} {}", was, is);
                }
            }
        }
    }
}
