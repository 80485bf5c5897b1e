//! `adapter_config.json`, read by an allow-list: a LoRA adapter whose rule is plain addition, or an error that names what is not.

use std::path::Path;

use regex::Regex;
use saccade_vla_checkpoint::ADAPTER_CONFIG;
use serde_json::Value;

use crate::config::{Object, asks_for_nothing, object_in};
use crate::error::{Error, Result, problem};

/// Keys without effect on the merged weights: where the base is, how it was trained, how the adapter was drawn.
const WITHOUT_EFFECT: [&str; 13] = [
    "auto_mapping",
    "base_model_name_or_path",
    "corda_config",
    "eva_config",
    "inference_mode",
    "init_lora_weights", // except those values that are refused
    "loftq_config",
    "lora_dropout",
    "megatron_core",
    "peft_version",
    "qalora_group_size",
    "revision",
    "task_type",
];

/// Keys that are read.
const READ: [&str; 12] = [
    "alpha_pattern",
    "bias",
    "exclude_modules",
    "layers_pattern",
    "layers_to_transform",
    "lora_alpha",
    "modules_to_save",
    "peft_type",
    "r",
    "rank_pattern",
    "target_modules",
    "use_rslora",
];

/// Ways to draw an adapter that leave the base as it is. The others subtract from it what the adapter begins with.
const DRAWS: [&str; 3] = ["gaussian", "orthogonal", "eva"];

/// Names of modules: their ends, or one regular expression for the whole name.
pub(super) enum Names {
    Ends(Vec<String>),
    Pattern(Regex),
}

impl Names {
    /// Whether `module` is one of them.
    pub(super) fn has(&self, module: &str) -> bool {
        match self {
            Self::Ends(ends) => ends.iter().any(|end| is_end(end, module)),
            Self::Pattern(pattern) => pattern.is_match(module),
        }
    }
}

/// Whether the path of `module` ends with `end`.
pub(super) fn is_end(end: &str, module: &str) -> bool {
    let rest = module.strip_suffix(end);
    rest.is_some_and(|rest| rest.is_empty() || rest.ends_with('.'))
}

/// Which of a stack of layers have an adapter.
struct Layers {
    indices: Vec<u64>,
    /// Each finds the index of a layer in the name of a module.
    patterns: Vec<Regex>,
}

/// What an adapter's config says.
pub(super) struct AdapterConfig {
    rank: u64,
    alpha: f64,
    use_rslora: bool,
    ranks: Vec<(Regex, u64)>,
    alphas: Vec<(Regex, f64)>,
    pub targets: Names,
    excluded: Option<Names>,
    layers: Option<Layers>,
    /// Ends of the names of modules that were trained whole.
    pub saved: Vec<String>,
}

impl AdapterConfig {
    /// Reads the config of the adapter in `directory`.
    ///
    /// # Errors
    /// [`Error::File`] if it is not there; [`Error::Checkpoint`] for a config of another rule than plain addition, with the key.
    pub(super) fn read(directory: &Path) -> Result<Self> {
        let config = object_in("adapter", &directory.join(ADAPTER_CONFIG))?;
        check_rule(&config)?;
        let rank = config.get("r").and_then(Value::as_u64).filter(|rank| *rank > 0);
        let targets = names(&config, "target_modules")?;
        Ok(Self {
            rank: rank.ok_or_else(|| differs(&config, "r", "a positive integer"))?,
            alpha: number(config.get("lora_alpha"))
                .ok_or_else(|| differs(&config, "lora_alpha", "a number"))?,
            use_rslora: config.get("use_rslora").is_some_and(|value| !is_unset(value)),
            ranks: by_pattern(&config, "rank_pattern", |value| {
                value.as_u64().filter(|rank| *rank > 0)
            })?,
            alphas: by_pattern(&config, "alpha_pattern", |value| number(Some(value)))?,
            targets: targets.ok_or_else(|| differs(&config, "target_modules", "names of modules"))?,
            excluded: names(&config, "exclude_modules")?,
            layers: layers(&config)?,
            saved: strings(&config, "modules_to_save")?,
        })
    }

    /// Whether PEFT puts an adapter on `module`.
    pub(super) fn adapts(&self, module: &str) -> bool {
        let is_excluded = self.excluded.as_ref().is_some_and(|names| names.has(module));
        let is_named = match &self.targets {
            // A name in full counts whatever its layer.
            Names::Ends(ends) if ends.iter().any(|end| end == module) => return !is_excluded,
            names => names.has(module),
        };
        let is_in_layers = self.layers.as_ref().is_none_or(|layers| {
            let found = layers
                .patterns
                .iter()
                .find_map(|pattern| pattern.captures(module));
            let index = found.and_then(|found| found[1].parse().ok());
            index.is_some_and(|index| layers.indices.contains(&index))
        });
        is_named && is_in_layers && !is_excluded
    }

    /// The rank of `module`, and what its product is multiplied by, as PEFT computes it.
    pub(super) fn scaling(&self, module: &str) -> (u64, f32) {
        let rank = first(&self.ranks, module).unwrap_or(self.rank);
        let alpha = first(&self.alphas, module).unwrap_or(self.alpha);
        let divisor = match self.use_rslora {
            true => (rank as f64).sqrt(),
            false => rank as f64,
        };
        (rank, (alpha / divisor) as f32)
    }
}

/// The value of the first pattern that fits.
fn first<T: Copy>(patterns: &[(Regex, T)], module: &str) -> Option<T> {
    let found = patterns.iter().find(|(pattern, _)| pattern.is_match(module));
    found.map(|(_, value)| *value)
}

/// That the config asks for nothing but the addition of products.
fn check_rule(config: &Object) -> Result<()> {
    if config.get("peft_type").and_then(Value::as_str) != Some("LORA") {
        return Err(differs(config, "peft_type", "\"LORA\""));
    }
    match config.get("bias") {
        None | Some(Value::Null) => {}
        Some(Value::String(bias)) if bias == "none" => {}
        Some(_) => return Err(differs(config, "bias", "\"none\"")),
    }
    match config.get("init_lora_weights") {
        None | Some(Value::Null | Value::Bool(_)) => {}
        Some(Value::String(draw)) if DRAWS.contains(&&**draw) => {}
        Some(_) => {
            return Err(differs(
                config,
                "init_lora_weights",
                "true, false, \"gaussian\", \"orthogonal\" or \"eva\": the others change the base too; save the adapter again with PEFT's \
                 path_initial_model_for_weight_conversion",
            ));
        }
    }
    for (key, value) in config {
        let is_known = WITHOUT_EFFECT.contains(&&**key) || READ.contains(&&**key);
        if !is_known && !is_unset(value) {
            return Err(differs(
                config,
                key,
                "it not to be set: what is added would not be the plain product",
            ));
        }
    }
    Ok(())
}

/// Whether a value switches nothing on.
fn is_unset(value: &Value) -> bool {
    asks_for_nothing(value) || value.as_f64() == Some(0.0)
}

fn number(value: Option<&Value>) -> Option<f64> {
    value.and_then(Value::as_f64).filter(|number| number.is_finite())
}

/// A list of strings; none if there is none.
fn strings(config: &Object, key: &str) -> Result<Vec<String>> {
    let unexpected = || differs(config, key, "a list of names");
    let list = match config.get(key) {
        None | Some(Value::Null) => return Ok(Vec::new()),
        Some(Value::Array(list)) => list,
        Some(_) => return Err(unexpected()),
    };
    let names = list
        .iter()
        .map(|name| name.as_str().filter(|name| !name.is_empty()).map(str::to_owned));
    names.collect::<Option<Vec<String>>>().ok_or_else(unexpected)
}

fn names(config: &Object, key: &str) -> Result<Option<Names>> {
    if config.get(key).is_none_or(is_unset) {
        return Ok(None);
    }
    Ok(Some(match config.get(key) {
        Some(Value::String(pattern)) => Names::Pattern(regex(key, pattern, &format!("^(?:{pattern})$"))?),
        _ => Names::Ends(strings(config, key)?),
    }))
}

fn by_pattern<T>(config: &Object, key: &str, read: impl Fn(&Value) -> Option<T>) -> Result<Vec<(Regex, T)>> {
    let patterns = match config.get(key) {
        None | Some(Value::Null) => return Ok(Vec::new()),
        Some(Value::Object(patterns)) => patterns,
        Some(_) => return Err(differs(config, key, "an object")),
    };
    let mut found = Vec::new();
    for (pattern, value) in patterns {
        let value = read(value).ok_or_else(|| {
            bad(&format!(
                "{key}: {pattern} is {value}, expected a positive number"
            ))
        })?;
        found.push((regex(key, pattern, &format!("^(?:.*\\.)?(?:{pattern})$"))?, value));
    }
    Ok(found)
}

fn layers(config: &Object) -> Result<Option<Layers>> {
    let indices = match config.get("layers_to_transform") {
        None | Some(Value::Null) => return Ok(None),
        Some(Value::Array(list)) if list.is_empty() => return Ok(None),
        Some(Value::Array(list)) => list.iter().map(Value::as_u64).collect(),
        Some(index) => index.as_u64().map(|index| vec![index]),
    };
    let indices: Option<Vec<u64>> = indices;
    let key = "layers_pattern";
    let given = match config.get(key) {
        Some(Value::String(one)) if !one.is_empty() => vec![one.clone()],
        Some(Value::String(_)) => Vec::new(),
        _ => strings(config, key)?,
    };
    let patterns = match given.is_empty() {
        true => vec![regex(key, "", r"^.*\.[^.]*\.(\d+)\.")?],
        false => {
            let named = |pattern: &String| regex(key, pattern, &format!("^.*\\.(?:{pattern})\\.(\\d+)\\."));
            given.iter().map(named).collect::<Result<_>>()?
        }
    };
    Ok(Some(Layers {
        indices: indices.ok_or_else(|| differs(config, "layers_to_transform", "indices of layers"))?,
        patterns,
    }))
}

/// The regular expression `whole`, which `pattern` of the config is in.
fn regex(key: &str, pattern: &str, whole: &str) -> Result<Regex> {
    Regex::new(whole).map_err(|_| {
        bad(&format!(
            "{key}: {pattern:?} is not a regular expression that saccade reads"
        ))
    })
}

fn differs(config: &Object, key: &str, expected: &str) -> Error {
    let given = config.get(key).unwrap_or(&Value::Null);
    bad(&format!("{key} is {given}, expected {expected}"))
}

fn bad(problem: &str) -> Error {
    Error::Checkpoint(problem!("adapter"; "{ADAPTER_CONFIG}: {problem}"))
}
