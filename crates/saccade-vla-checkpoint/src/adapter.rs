//! Adapters that PEFT writes: files that change a base model. They are no model, and beside one they must not be ignored.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use crate::error::{Error, Result};
use crate::names::is_processor;
use crate::problem;
use crate::source::read_text;

/// The config of an adapter.
pub const ADAPTER_CONFIG: &str = "adapter_config.json";

/// The weights of an adapter.
pub const ADAPTER_WEIGHTS: &str = "adapter_model.safetensors";

/// Everything that tells an adapter; the last are weights of older releases of PEFT.
const FILES: [&str; 3] = [ADAPTER_CONFIG, ADAPTER_WEIGHTS, "adapter_model.bin"];

/// Whether a file of this name is an adapter's.
pub(crate) fn is_adapter(name: &str) -> bool {
    FILES.contains(&name)
}

/// The directory of the checkpoint `source`, which may be one file.
#[must_use]
pub fn directory_of(source: &Path) -> &Path {
    match source.parent() {
        _ if source.is_dir() => source,
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    }
}

/// That `source`, a directory or a file of weights, is no adapter, and that none is beside it.
pub(crate) fn refuse_adapter(source: &Path) -> Result<()> {
    let directory = directory_of(source);
    let there = |name: &&str| directory.join(name).is_file();
    let found: Vec<&str> = FILES.into_iter().filter(there).collect();
    if found.is_empty() {
        return Ok(());
    }
    let is_adapter_file = source.file_name().is_some_and(|name| name == ADAPTER_WEIGHTS);
    let weights = match source.is_dir() {
        true => weights_in(directory),
        false if is_adapter_file => None,
        false => Some(source.to_owned()),
    };
    let adapter = Described::of(directory);
    let (shown, merge) = (directory.display(), adapter.merge(directory));
    Err(Error::Checkpoint(match weights {
        None => problem!(
            "source"; "{shown} is {}, not a model: merge it into its base with `{merge}`", adapter.what
        ),
        Some(weights) => problem!(
            "source";
            "{shown} holds a model ({}) and beside it {}: if the weights do not contain it yet, merge the two \
             with `{merge}`; if they do, remove {}",
            weights.file_name().unwrap_or_default().display(), adapter.what, found.join(", ")
        ),
    }))
}

/// That lerobot does not take the directory of `source` for an adapter.
pub(crate) fn refuse_use_peft(source: &Path) -> Result<()> {
    let directory = directory_of(source);
    let config = object(&directory.join("config.json"));
    match config.get("use_peft") {
        None | Some(Value::Null | Value::Bool(false)) => return Ok(()),
        Some(_) => {}
    }
    let adapter = Described::of(directory);
    Err(Error::Checkpoint(problem!(
        "source";
        "{}: use_peft in config.json: lerobot takes this directory for {} and does not read the weights of a model in it: merge the two \
         with `{}`; if the weights are merged already, set use_peft to false and remove {}",
        directory.display(), adapter.what, adapter.merge(directory), FILES.join(", ")
    )))
}

/// What a message says of an adapter.
struct Described {
    what: String,
    base: Option<String>,
}

impl Described {
    /// The adapter in `directory`; as much of its config as can be read.
    fn of(directory: &Path) -> Self {
        let config = object(&directory.join(ADAPTER_CONFIG));
        let text = |key: &str| config.get(key).and_then(Value::as_str).map(str::to_owned);
        let kind = match text("peft_type").as_deref() {
            None | Some("LORA") => "a LoRA adapter".to_owned(),
            Some(other) => format!("an adapter of PEFT's type {other}"),
        };
        let base = text("base_model_name_or_path").filter(|base| !base.is_empty());
        Self {
            what: match &base {
                Some(base) => format!("{kind} of {base}"),
                None => kind,
            },
            base,
        }
    }

    /// The command that merges it.
    fn merge(&self, directory: &Path) -> String {
        format!(
            "saccade convert {} --adapter {} --out MERGED",
            self.base.as_deref().unwrap_or("BASE"),
            directory.display()
        )
    }
}

/// The object in a JSON file; empty for everything else, of which those that need the file will say what is wrong.
fn object(path: &Path) -> Map<String, Value> {
    let text = read_text("source", path).unwrap_or_default();
    match serde_json::from_str(&text) {
        Ok(Value::Object(object)) => object,
        _ => Map::new(),
    }
}

/// A file of weights in `directory` that is no adapter's.
fn weights_in(directory: &Path) -> Option<PathBuf> {
    let entries = std::fs::read_dir(directory).ok()?;
    let mut names: Vec<_> = entries
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .collect();
    names.sort();
    let is_weights = |name: &&String| {
        (name.ends_with(".safetensors") || name.ends_with(".safetensors.index.json"))
            && !is_adapter(name)
            && !is_processor(name)
    };
    names.iter().find(is_weights).map(PathBuf::from)
}
