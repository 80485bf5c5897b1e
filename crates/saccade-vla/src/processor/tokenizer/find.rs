//! Where the files of a tokenizer are: a file or directory that is given, or the directory of a checkpoint.

use std::path::{Path, PathBuf};

use saccade_vla_checkpoint::read_text;

use crate::error::{Error, Result, problem};

const JSON: &str = "tokenizer.json";
const VOCAB: &str = "vocab.json";
const MERGES: &str = "merges.txt";
const ADDED: &str = "added_tokens.json";
const CONFIG: &str = "tokenizer_config.json";

/// Folders of a checkpoint that programs put a tokenizer into, below the checkpoint's own.
const FOLDERS: [&str; 4] = ["", "tokenizer", "processor", "eagle2hg-processor-groot-n1p5"];

/// The files of a tokenizer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TokenizerFiles {
    /// A `tokenizer.json`.
    Json(PathBuf),
    /// A directory with `vocab.json` and `merges.txt`.
    Slow(PathBuf),
}

/// What is in the files of a tokenizer.
pub(super) enum FilesText {
    Json(String),
    Slow {
        vocab: String,
        merges: String,
        added: Option<String>,
        config: Option<String>,
    },
}

impl TokenizerFiles {
    /// Those at `path`: a `tokenizer.json`, whatever it is called, or a directory.
    ///
    /// # Errors
    /// [`Error::File`] if there is nothing at `path`; [`Error::Checkpoint`] for a directory without a tokenizer.
    pub fn at(path: &Path) -> Result<Self> {
        if !path.is_dir() {
            return Ok(Self::Json(path.to_owned()));
        }
        Self::in_folder(path).ok_or_else(|| {
            Error::Checkpoint(problem!(
                "tokenizer"; "{} holds neither {JSON} nor {VOCAB} and {MERGES}", path.display()
            ))
        })
    }

    /// Those of the checkpoint in `directory`, if it has any.
    #[must_use]
    pub fn of_checkpoint(directory: &Path) -> Option<Self> {
        FOLDERS
            .iter()
            .find_map(|folder| Self::in_folder(&directory.join(folder)))
    }

    fn in_folder(folder: &Path) -> Option<Self> {
        let has = |file: &str| folder.join(file).is_file();
        if has(JSON) {
            Some(Self::Json(folder.join(JSON)))
        } else if has(VOCAB) && has(MERGES) {
            Some(Self::Slow(folder.to_owned()))
        } else {
            None
        }
    }

    /// What is in them.
    ///
    /// # Errors
    /// [`Error::File`] for a file that cannot be read.
    pub(super) fn text(&self) -> Result<FilesText> {
        let text = |path: &Path| Ok::<_, Error>(read_text("tokenizer", path)?);
        Ok(match self {
            Self::Json(path) => FilesText::Json(text(path)?),
            Self::Slow(folder) => {
                let optional = |file: &str| {
                    let path = folder.join(file);
                    path.exists().then(|| text(&path)).transpose()
                };
                FilesText::Slow {
                    vocab: text(&folder.join(VOCAB))?,
                    merges: text(&folder.join(MERGES))?,
                    added: optional(ADDED)?,
                    config: optional(CONFIG)?,
                }
            }
        })
    }

    /// The file, or the directory of several.
    pub(super) fn path(&self) -> &Path {
        match self {
            Self::Json(path) | Self::Slow(path) => path,
        }
    }

    /// The directory that they are in.
    #[must_use]
    pub fn folder(&self) -> &Path {
        match self {
            Self::Json(path) => path.parent().unwrap_or(Path::new("")),
            Self::Slow(folder) => folder,
        }
    }
}
