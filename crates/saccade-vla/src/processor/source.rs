//! What a checkpoint says about its processor: version, path, sizes, options, and where its tokenizer is.

use std::path::{Path, PathBuf};

use saccade_vla_checkpoint::Checkpoint;
use serde_json::Value;

use super::files::{add_pixel_limits, options, read_object};
use super::options::overrides;
use super::settings::{PATCH_SIZE, Preprocessing, ProcessorOptions};
use super::tokenizer::TokenizerFiles;
use super::{Processor, Tokenizer};
use crate::config::{CheckpointConfig, Version};
use crate::error::{Error, Result, problem, show_shape};
use crate::recognise::HeadCheckpoint;

/// What the names of a backbone's tensors begin with: lerobot's, NVIDIA's, a backbone alone.
const PREFIXES: [&str; 3] = ["_groot_model.backbone.", "backbone.", ""];

/// What the names of each version's tensors go on with.
const MARKS: [(Version, &str); 3] = [
    (Version::N15, "eagle_model."),
    (Version::N16, "model.vision_model."),
    (Version::N17, "model.model.visual."),
];

/// HeadCheckpoint repositories that have the tokenizer of a version, the released one first, and the files that are needed of it.
const PUBLISHED: [(Version, &[&str], &[&str]); 3] = [
    (
        Version::N15,
        &["lerobot/eagle2hg-processor-groot-n1p5"],
        &SLOW_FILES,
    ),
    // N1.6's tokenizer has the ids of N1.5's.
    (
        Version::N16,
        &[
            "aravindhs-NV/eagle3-processor-groot-n1d6",
            "lerobot/eagle2hg-processor-groot-n1p5",
        ],
        &SLOW_FILES,
    ),
    (
        Version::N17,
        &["nvidia/Cosmos-Reason2-2B", "Qwen/Qwen3-VL-2B-Instruct"],
        &["tokenizer.json", "preprocessor_config.json"],
    ),
];

const SLOW_FILES: [&str; 4] = [
    "vocab.json",
    "merges.txt",
    "added_tokens.json",
    "tokenizer_config.json",
];

/// The processor of a checkpoint, before its tokenizer is read.
pub struct ProcessorSource {
    version: Version,
    preprocessing: Preprocessing,
    image_size: Option<usize>,
    tokens_per_view: Option<usize>,
    directory: PathBuf,
    tokenizer: Option<TokenizerFiles>,
}

impl ProcessorSource {
    /// Reads what the checkpoint `source` says, one file or a directory. Only headers of its weights are read.
    ///
    /// # Errors
    /// [`Error::File`] for files that are not there or broken; [`Error::Json`] and [`Error::Checkpoint`] for a `config.json` that is not, for
    /// a checkpoint of which no version can be found, and for a config that its tensors contradict.
    pub fn open(source: &Path) -> Result<Self> {
        let checkpoint = Checkpoint::open(source)?;
        let directory = match source.is_dir() {
            true => source,
            false => source.parent().unwrap_or(Path::new("")),
        };
        let config = match read_object("config", &directory.join("config.json"))? {
            None => None,
            Some(config) => Some(CheckpointConfig::parse(&Value::Object(config).to_string())?),
        };
        let found = backbone_of(&checkpoint);
        let version = match found {
            Some((version, _)) => version,
            None => version_of_head(source)?,
        };
        if let Some(config) = &config {
            check_declared(config, version)?;
        }
        let is_lerobot = checkpoint.names().any(|name| name.starts_with("_groot_model."))
            || config
                .as_ref()
                .is_some_and(|config| config.top().contains_key("type"));
        let (image_size, tokens_per_view) = match found {
            Some((Version::N15, prefix)) => n15_sizes(&checkpoint, prefix, config.as_ref())?,
            _ => (None, None),
        };
        let preprocessing = match is_lerobot {
            true => Preprocessing::Lerobot,
            false => Preprocessing::Isaac,
        };
        Ok(Self {
            version,
            preprocessing,
            image_size,
            tokens_per_view,
            directory: directory.to_owned(),
            tokenizer: TokenizerFiles::of_checkpoint(directory),
        })
    }

    /// `n1.5`, `n1.6` or `n1.7`.
    #[must_use]
    pub fn version(&self) -> &'static str {
        self.version.name()
    }

    /// The tokenizer that the checkpoint brings along.
    #[must_use]
    pub fn tokenizer(&self) -> Option<&TokenizerFiles> {
        self.tokenizer.as_ref()
    }

    /// HeadCheckpoint repositories that have the tokenizer of this version, the released one first.
    #[must_use]
    pub fn published(&self) -> &'static [&'static str] {
        self.release().0
    }

    /// The files that are needed of such a repository.
    #[must_use]
    pub fn needed_files(&self) -> &'static [&'static str] {
        self.release().1
    }

    fn release(&self) -> (&'static [&'static str], &'static [&'static str]) {
        let found = PUBLISHED.iter().find(|(version, _, _)| *version == self.version);
        found.map_or((&[], &[]), |(_, ids, files)| (*ids, *files))
    }

    /// The processor, with these files or the checkpoint's own, and with this path or the checkpoint's own. `replaced` is a JSON object of
    /// options that take the place of the checkpoint's.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if no tokenizer is given and the checkpoint has none, and for files of the processor that are broken or hold what
    /// their release does not know; those of reading a [`TokenizerFiles`] and [`Processor::new`].
    pub fn processor(
        &self,
        tokenizer: Option<&TokenizerFiles>,
        preprocessing: Option<Preprocessing>,
        replaced: Option<&str>,
    ) -> Result<Processor> {
        let files = tokenizer.or(self.tokenizer.as_ref()).ok_or_else(|| {
            Error::Checkpoint(problem!(
                "tokenizer"; "the checkpoint has none; needed are {} of {}",
                self.needed_files().join(", "), self.published().join(" or ")
            ))
        })?;
        let preprocessing = preprocessing.unwrap_or(self.preprocessing);
        let mut options = options(self.version, preprocessing, &self.directory)?;
        if self.version == Version::N17 {
            add_pixel_limits(&mut options, files.folder())?;
        }
        if let Some(replaced) = replaced {
            options.extend(overrides(replaced)?);
        }
        let options = Value::Object(options).to_string();
        let given = ProcessorOptions {
            preprocessing: Some(preprocessing),
            image_size: self.image_size,
            tokens_per_view: self.tokens_per_view,
            plain_text: false,
            options: Some(&options),
        };
        Processor::new(self.version.name(), Tokenizer::read(files)?, &given)
    }
}

/// The version of the backbone in a checkpoint, and its prefix.
fn backbone_of(checkpoint: &Checkpoint) -> Option<(Version, &'static str)> {
    let starts = |prefix: &str, mark: &str| {
        let start = format!("{prefix}{mark}");
        checkpoint.names().any(|name| name.starts_with(&start))
    };
    let all = PREFIXES.iter().flat_map(|prefix| {
        MARKS
            .iter()
            .map(move |(version, mark)| (*version, *prefix, *mark))
    });
    let mut found = all.filter(|(_, prefix, mark)| starts(prefix, mark));
    found.next().map(|(version, prefix, _)| (version, prefix))
}

/// The version of a checkpoint without a backbone that is known.
fn version_of_head(source: &Path) -> Result<Version> {
    let head = HeadCheckpoint::open(source, None)?;
    Version::named(&head.config.version).ok_or_else(|| {
        Error::Checkpoint(problem!(
            "source"; expected "the backbone of GR00T N1.5, N1.6 or N1.7";
            got "a head of {}", head.config.version
        ))
    })
}

/// That the config names no other version than the tensors.
fn check_declared(config: &CheckpointConfig, version: Version) -> Result<()> {
    for declared in config.declared() {
        if declared.version.is_some_and(|other| other != version) {
            return Err(Error::Checkpoint(problem!(
                "config"; "{}, but the tensors are those of {}", declared.text, version.title()
            )));
        }
    }
    Ok(())
}

/// Side and tokens of N1.5's views, from the shapes of the vision tower and of the connector.
fn n15_sizes(
    checkpoint: &Checkpoint,
    prefix: &str,
    config: Option<&CheckpointConfig>,
) -> Result<(Option<usize>, Option<usize>)> {
    let shape = |name: &str| {
        let name = format!("{prefix}eagle_model.{name}");
        checkpoint.shape(&name).map(|shape| (name, shape))
    };
    let embeddings = "vision_model.vision_model.embeddings";
    let Some((name, positions)) = shape(&format!("{embeddings}.position_embedding.weight")) else {
        return Ok((None, None));
    };
    let patch = match shape(&format!("{embeddings}.patch_embedding.weight")) {
        Some((_, &[_, _, side, _])) => side,
        _ => PATCH_SIZE,
    };
    let bad = |what: &str| {
        Err(Error::Checkpoint(problem!(
            "source"; "{name}: expected {what}, got shape {}", show_shape(positions)
        )))
    };
    let &[patches, width] = positions else {
        return bad("two axes");
    };
    let grid = patches.isqrt();
    if grid == 0 || grid * grid != patches || width == 0 {
        return bad("a square of patches");
    }
    // A connector that is wider takes several patches at once.
    let taken = match shape("mlp1.0.weight") {
        Some((_, &[inputs] | &[_, inputs])) if inputs.is_multiple_of(width) => (inputs / width).max(1),
        _ => 1,
    };
    let Some(side) = grid.checked_mul(patch) else {
        return bad("fewer patches");
    };
    if let Some(given) = config.and_then(given_image_size)
        && given != side as u64
    {
        return Err(Error::Checkpoint(problem!(
            "config"; "the image size is {given}, but {name} has {grid} x {grid} patches of {patch}"
        )));
    }
    Ok((Some(side), Some(patches / taken)))
}

/// The image size in a config of NVIDIA's layout.
fn given_image_size(config: &CheckpointConfig) -> Option<u64> {
    let eagle = config.top().get("backbone_cfg")?.get("eagle_config")?;
    let forced = eagle.get("force_image_size").and_then(Value::as_u64);
    forced.or_else(|| eagle.get("vision_config")?.get("image_size")?.as_u64())
}
