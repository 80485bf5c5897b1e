//! What a checkpoint says about its processor: version, path, sizes, options, and where its tokenizer is.

use std::path::{Path, PathBuf};

use saccade_vla_checkpoint::{Checkpoint, directory_of};
use serde_json::Value;

use super::files::{add_pixel_limits, options};
use super::options::overrides;
use super::settings::ProcessorOptions;
use super::tokenizer::TokenizerFiles;
use super::{Processor, Tokenizer};
use crate::backbone::backbones_in;
use crate::config::{CheckpointConfig, Object, object_in_any};
use crate::error::{Error, Result, bail, ensure, problem, show_shape};
use crate::recognise::HeadCheckpoint;
use crate::release::{Names, Preprocessing, ProcessorRules, Version, ViewRules};

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
    /// Reads what the checkpoint `source` says, one file or a directory. Only headers of its weights are
    /// read.
    ///
    /// # Errors
    /// [`Error::File`] for files that are not there or broken; [`Error::Json`] and [`Error::Checkpoint`] for
    /// a `config.json` that is not, for a checkpoint of which no version can be found, and for a config that
    /// its tensors contradict.
    pub fn open(source: &Path) -> Result<Self> {
        let checkpoint = Checkpoint::open(source)?;
        let directory = directory_of(source);
        let config = object_in_any("config", &directory.join("config.json"))?;
        let config = config.map(CheckpointConfig::of).transpose()?;
        let found = {
            let names: Vec<&str> = checkpoint.names().collect();
            backbones_in(names.into_iter()).into_iter().next()
        };
        let version = match found {
            Some((_, version, _)) => version,
            None => HeadCheckpoint::open(source, None)?.config.version,
        };
        if let Some(config) = &config {
            check_declared(config, version)?;
        }
        let is_lerobot = checkpoint.names().any(|name| name.starts_with("_groot_model."))
            || config
                .as_ref()
                .is_some_and(|config| config.top().contains_key("type"));
        let views = version.release().processor.as_ref().map(|rules| &rules.views);
        let (image_size, tokens_per_view) = match (found, views) {
            (Some((prefix, _, backbone)), Some(ViewRules::Square { patch_size, .. })) => {
                square_sizes(&checkpoint, prefix, &backbone.names, *patch_size, config.as_ref())?
            }
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

    /// The version of the checkpoint.
    #[must_use]
    pub fn version(&self) -> Version {
        self.version
    }

    /// The tokenizer that the checkpoint brings along.
    #[must_use]
    pub fn tokenizer(&self) -> Option<&TokenizerFiles> {
        self.tokenizer.as_ref()
    }

    /// Published repositories that have the tokenizer of this version, the released one first.
    #[must_use]
    pub fn published(&self) -> &'static [&'static str] {
        self.rules().map_or(&[], |rules| rules.tokenizers)
    }

    /// The files that are needed of such a repository.
    #[must_use]
    pub fn needed_files(&self) -> &'static [&'static str] {
        self.rules().map_or(&[], |rules| rules.tokenizer_files)
    }

    fn rules(&self) -> Option<&'static ProcessorRules> {
        self.version.release().processor.as_ref()
    }

    /// The processor, with these files or the checkpoint's own, and with this path or the checkpoint's own.
    /// `replaced` is a JSON object of options that take the place of the checkpoint's.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if no tokenizer is given and the checkpoint has none, and for files of the
    /// processor that are broken or hold what their release does not know; those of reading a
    /// [`TokenizerFiles`] and [`Processor::new`].
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
        let mut found = Object::new();
        if let Some(rules) = self.rules() {
            found = options(self.version, rules, preprocessing, &self.directory)?;
            if rules.has_pixel_limits() {
                add_pixel_limits(&mut found, files.folder())?;
            }
        }
        if let Some(replaced) = replaced {
            found.extend(overrides(replaced)?);
        }
        let options = Value::Object(found).to_string();
        let given = ProcessorOptions {
            preprocessing: Some(preprocessing),
            image_size: self.image_size,
            tokens_per_view: self.tokens_per_view,
            plain_text: false,
            options: Some(&options),
        };
        Processor::new(self.version, Tokenizer::read(files)?, &given)
    }
}

/// Refuses a config that names another version than the tensors.
fn check_declared(config: &CheckpointConfig, version: Version) -> Result<()> {
    for declared in config.declared() {
        ensure!(
            !declared.version.is_some_and(|other| other != version), Checkpoint, "config";
            "{}, but the tensors are those of {version}", declared.text
        );
    }
    Ok(())
}

/// Side and tokens of views of one size, from the shapes of the vision tower and of the connector.
fn square_sizes(
    checkpoint: &Checkpoint,
    prefix: &str,
    names: &Names,
    patch_size: usize,
    config: Option<&CheckpointConfig>,
) -> Result<(Option<usize>, Option<usize>)> {
    let shape = |name: &str| {
        let name = format!("{prefix}{name}");
        checkpoint.shape(&name).map(|shape| (name, shape))
    };
    let embeddings = format!("{}.embeddings", names.vision);
    let Some((name, positions)) = shape(&format!("{embeddings}.position_embedding.weight")) else {
        return Ok((None, None));
    };
    let patch = match shape(&format!("{embeddings}.patch_embedding.weight")) {
        Some((_, &[_, _, side, _])) => side,
        _ => patch_size,
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
    let taken = match shape(&format!("{}.0.weight", names.connector.unwrap_or_default())) {
        Some((_, &[inputs] | &[_, inputs])) if inputs.is_multiple_of(width) => (inputs / width).max(1),
        _ => 1,
    };
    let Some(side) = grid.checked_mul(patch) else {
        return bad("fewer patches");
    };
    if let Some(given) = config.and_then(given_image_size)
        && given != side as u64
    {
        bail!(
            Checkpoint, "config";
            "the image size is {given}, but {name} has {grid} x {grid} patches of {patch}"
        );
    }
    Ok((Some(side), Some(patches / taken)))
}

/// The image size in a config of NVIDIA's layout.
fn given_image_size(config: &CheckpointConfig) -> Option<u64> {
    let eagle = config.top().get("backbone_cfg")?.get("eagle_config")?;
    let forced = eagle.get("force_image_size").and_then(Value::as_u64);
    forced.or_else(|| eagle.get("vision_config")?.get("image_size")?.as_u64())
}
