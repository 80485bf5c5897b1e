//! The weight files of a directory, and what its index says is in them.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use crate::adapter::is_adapter;
use crate::error::{Error, Result};
use crate::names::is_processor;
use crate::names::plain_name;
use crate::problem;
use crate::source::read_text;
use crate::unique_map::UniqueMap;

/// The file that transformers and lerobot look for first: beside it they read neither an index nor other files.
const SINGLE: &str = "model.safetensors";

/// The `.safetensors` files of a directory.
pub(crate) struct WeightFiles {
    pub files: Vec<PathBuf>,
    /// The file in which the index places each tensor; empty without an index.
    pub weight_map: Vec<(String, PathBuf)>,
}

impl WeightFiles {
    /// `model.safetensors` alone if it is there, as in transformers and lerobot; or else those that the directory's index
    /// (`*.safetensors.index.json`) names; or else all that are no processor's statistics.
    pub(crate) fn of(directory: &Path) -> Result<Self> {
        let bad =
            |problem: String| Error::Checkpoint(problem!("source"; "{}: {problem}", directory.display()));
        let all: Vec<OsString> = std::fs::read_dir(directory)
            .and_then(|entries| entries.map(|entry| Ok(entry?.file_name())).collect())
            .map_err(|error| Error::reading("source", directory, error))?;
        let mut names = Vec::new();
        for name in all {
            match name.into_string() {
                Ok(name) => names.push(name),
                // If it were skipped silently, its tensors would be missing for no visible reason.
                Err(name) if name.to_string_lossy().contains(".safetensors") => {
                    return Err(bad(format!("the name {} is not UTF-8", name.to_string_lossy())));
                }
                Err(_) => {}
            }
        }
        names.sort();
        if names.iter().any(|name| name == SINGLE) {
            return Ok(Self {
                files: vec![directory.join(SINGLE)],
                weight_map: Vec::new(),
            });
        }
        let mut indexes = names
            .iter()
            .filter(|name| name.ends_with(".safetensors.index.json"));
        let files: Vec<PathBuf> = names
            .iter()
            .filter(|name| name.ends_with(".safetensors") && !is_processor(name) && !is_adapter(name))
            .map(|name| directory.join(name))
            .collect();
        match (indexes.next(), indexes.next()) {
            (None, _) if files.is_empty() => Err(bad("expected at least one .safetensors file".to_owned())),
            (None, _) => Ok(Self {
                files,
                weight_map: Vec::new(),
            }),
            (Some(index), None) => Self::from_index(directory, &directory.join(index)),
            (Some(first), Some(second)) => Err(bad(format!("expected one index, got {first} and {second}"))),
        }
    }

    fn from_index(directory: &Path, path: &Path) -> Result<Self> {
        #[derive(serde::Deserialize)]
        struct Index {
            weight_map: UniqueMap<String>,
        }
        let bad = |problem: String| Error::Checkpoint(problem!("source"; "{}: {problem}", path.display()));
        let text = read_text("source", path)?;
        let index: Index = serde_json::from_str(&text).map_err(|source| Error::Json {
            what: "source",
            path: path.to_owned(),
            source: source.into(),
        })?;
        let mut files = BTreeSet::new();
        let mut weight_map = Vec::new();
        for (name, shard) in index.weight_map.0 {
            // A name with a folder in it could point anywhere on the disk.
            if Path::new(&shard).file_name() != Some(shard.as_ref()) {
                return Err(bad(format!(
                    "{name} is said to be in `{shard}`, expected a file name in the same directory"
                )));
            }
            files.insert(directory.join(&shard));
            weight_map.push((plain_name(&name).into_owned(), directory.join(shard)));
        }
        if files.is_empty() {
            return Err(bad("weight_map names no tensor".to_owned()));
        }
        Ok(Self {
            files: files.into_iter().collect(),
            weight_map,
        })
    }
}
