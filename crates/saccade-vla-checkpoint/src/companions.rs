//! The files next to a checkpoint's weights that belong to it: statistics, processors, tokenizers, licences. The programs that read the
//! source need them, so a copy has them too, byte for byte.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use crate::adapter::{ADAPTER_CONFIG, directory_of, is_adapter};
use crate::error::{Error, Result};
use crate::names::is_processor;
use crate::source::open_regular;

/// The part of a config that is saccade's own, for layouts whose `config.json` takes no other keys.
pub const OWN_CONFIG: &str = "saccade.json";

/// What ends the name of a file that belongs to a checkpoint.
const ENDINGS: [&str; 10] = [
    "json", "jsonl", "txt", "model", "jinja", "yaml", "yml", "md", "py", "toml",
];

/// What ends the name of a file of weights; a folder with one is another checkpoint.
const WEIGHTS: [&str; 7] = ["safetensors", "bin", "pt", "pth", "ckpt", "gguf", "onnx"];

/// Files, in the folders below, that describe robots: statistics, keys, cameras, ids.
const ROBOTS: [&str; 5] = [
    "processor_config.json",
    "statistics.json",
    "dataset_statistics.json",
    "embodiment_id.json",
    "metadata.json",
];
const ROBOT_FOLDERS: [&str; 3] = ["", "processor", "experiment_cfg"];

/// A tokenizer has 15 MB.
const MAX_BYTES: u64 = 1 << 28;

/// The published ones have a dozen.
const MAX_FILES: usize = 1000;

/// No published checkpoint has folders in folders in folders.
const MAX_DEPTH: usize = 4;

/// The files next to a checkpoint's weights; by default none.
#[derive(Default)]
pub struct Companions {
    root: PathBuf,
    /// What is copied, by the path in the copy: where it is.
    carried: BTreeMap<PathBuf, PathBuf>,
    /// What is not.
    left: Vec<PathBuf>,
}

impl Companions {
    /// Those of `source`, a checkpoint with the files `weights`. Next to a source that is a single file, only saccade's own part of the config
    /// counts: the other files may belong to anything.
    ///
    /// # Errors
    /// [`Error::NotFound`] and [`Error::Unreadable`] for a directory that cannot be listed.
    pub fn of<'a>(source: &Path, weights: impl Iterator<Item = &'a Path>) -> Result<Self> {
        let root = directory_of(source);
        let mut companions = Self {
            root: root.to_owned(),
            ..Self::default()
        };
        if source.is_dir() {
            let weights: BTreeSet<&Path> = weights.collect();
            companions.add_folder(Path::new(""), &weights)?;
        } else if root.join(OWN_CONFIG).is_file() {
            companions
                .carried
                .insert(PathBuf::from(OWN_CONFIG), root.join(OWN_CONFIG));
        }
        Ok(companions)
    }

    fn add_folder(&mut self, folder: &Path, weights: &BTreeSet<&Path>) -> Result<()> {
        let from = self.root.join(folder);
        let unreadable = |error: std::io::Error| Error::reading("source", &from, error);
        let entries = std::fs::read_dir(&from).map_err(unreadable)?;
        let mut names = entries
            .map(|entry| Ok(entry?.file_name()))
            .collect::<std::io::Result<Vec<_>>>()
            .map_err(unreadable)?;
        names.sort();
        for name in names {
            let path = folder.join(&name);
            let from = self.root.join(&path);
            let Some(name) = name.to_str() else {
                self.left.push(path);
                continue;
            };
            let is_top = folder.as_os_str().is_empty();
            let is_written = is_top && (name == "config.json" || name.ends_with(".safetensors.index.json"));
            if name.starts_with('.') || is_written || weights.contains(from.as_path()) {
                continue;
            }
            // What a link leads to counts, except that folders could then hold themselves.
            let Ok(metadata) = std::fs::metadata(&from) else {
                self.left.push(path);
                continue;
            };
            if metadata.is_dir() && !from.is_symlink() && self.is_part(&path) {
                self.add_folder(&path, weights)?;
            } else if metadata.is_file()
                && metadata.len() <= MAX_BYTES
                && belongs(name)
                && self.carried.len() < MAX_FILES
            {
                self.carried.insert(path, from);
            } else {
                self.left.push(path);
            }
        }
        Ok(())
    }

    /// Whether a folder is part of the checkpoint and not another one.
    fn is_part(&self, folder: &Path) -> bool {
        let is_weights =
            |entry: std::fs::DirEntry| ending(&entry.path()).is_some_and(|one| WEIGHTS.contains(&&*one));
        folder.components().count() <= MAX_DEPTH
            && std::fs::read_dir(self.root.join(folder))
                .is_ok_and(|entries| !entries.flatten().any(is_weights))
    }

    /// These together with the files of the adapter in `directory`, which take the place of those of the same name. If it has files that describe
    /// robots, the others of that kind are left: they would describe the robots of the base. The files of an adapter alone are not copied.
    /// `is_beside` says that the directory is the checkpoint's own.
    ///
    /// # Errors
    /// As [`Companions::of`].
    pub fn with_adapter(mut self, directory: &Path, is_beside: bool) -> Result<Self> {
        if !is_beside {
            let mut other = Self::of(directory, std::iter::empty())?;
            // PEFT's own description of the adapter.
            other.carried.remove(Path::new("README.md"));
            if other.carried.keys().any(|path| describes_robots(path)) {
                self.carried.retain(|path, _| !describes_robots(path));
            }
            self.carried.extend(other.carried);
            self.left.extend(other.left);
        }
        self.carried.remove(Path::new(ADAPTER_CONFIG));
        self.left.retain(|path| !path.to_str().is_some_and(is_adapter));
        Ok(self)
    }

    /// All of them but `file`, which is written separately.
    #[must_use]
    pub fn without(mut self, file: &str) -> Self {
        self.carried.remove(Path::new(file));
        self
    }

    /// What is copied, by the path from the checkpoint's directory.
    #[must_use]
    pub fn all_paths(&self) -> BTreeSet<PathBuf> {
        self.carried.keys().cloned().collect()
    }

    /// What is not copied: other weights, states of an optimizer, other checkpoints.
    #[must_use]
    pub fn left(&self) -> &[PathBuf] {
        &self.left
    }

    pub(crate) fn copy_to(&self, directory: &Path) -> Result<()> {
        for (path, from) in &self.carried {
            let to = directory.join(path);
            let source = open_regular(from).map_err(|error| Error::reading("source", from, error))?;
            let folder = to.parent().expect("a path in a directory has a parent");
            let copy = || {
                std::fs::create_dir_all(folder)?;
                let mut copy = File::create_new(&to)?;
                // Of a file that grows for ever, no more than it had when it was found.
                std::io::copy(&mut source.take(MAX_BYTES), &mut copy)?;
                copy.sync_all()
            };
            copy().map_err(|error| Error::writing(&to, error))?;
        }
        Ok(())
    }
}

/// Whether the file at `path` of a checkpoint describes robots.
fn describes_robots(path: &Path) -> bool {
    let (Some(name), Some(folder)) = (path.file_name().and_then(|name| name.to_str()), path.parent()) else {
        return false;
    };
    ROBOT_FOLDERS.iter().any(|one| folder == Path::new(one)) && (ROBOTS.contains(&name) || is_processor(name))
}

fn belongs(name: &str) -> bool {
    let is_text = ending(Path::new(name)).is_some_and(|one| ENDINGS.contains(&&*one));
    let is_licence = ["LICENSE", "LICENCE", "NOTICE"]
        .iter()
        .any(|start| name.starts_with(start));
    is_text || is_licence || (is_processor(name) && name.ends_with(".safetensors"))
}

fn ending(path: &Path) -> Option<String> {
    path.extension()
        .map(|ending| ending.to_string_lossy().to_ascii_lowercase())
}
