//! Where a backbone is in a checkpoint, of which release it is, and what its tensors are called.

use saccade_vla_checkpoint::spec::{self, TensorProblem};

use super::config::BackboneConfig;
use super::json::GivenConfig;
use crate::error::{Error, Result, bail, problem};
use crate::recognise::BACKBONE_PREFIXES;
use crate::release::{BackboneRules, Names, Version};

/// What the tensors of a backbone are called, below the prefix.
pub(super) struct TensorNames {
    pub parts: Names,
    /// The table of embeddings: its own name, or that of its twin where that alone was stored.
    pub embedding: String,
}

/// A backbone in a list of tensors.
pub(super) struct Recognised {
    pub prefix: &'static str,
    pub version: Version,
    pub names: TensorNames,
    pub config: BackboneConfig,
}

impl Recognised {
    /// The backbone among tensors of these names, with the config that was given for it.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if there is none, if there are two, if the config is of another one, and as the
    /// config has them.
    pub(super) fn new<'a>(names: impl Iterator<Item = &'a str> + Clone, given: &GivenConfig) -> Result<Self> {
        let found = backbones_in(names.clone());
        let (prefix, version, rules) = match found[..] {
            [one] => one,
            [] => return Err(nothing_found(names)),
            [first, second, ..] => {
                let show =
                    |(prefix, version, _): (&str, Version, _)| format!("of GR00T {version} under `{prefix}`");
                bail!(
                    Checkpoint, "source";
                    "two backbones in one checkpoint, {} and {}", show(first), show(second)
                );
            }
        };
        if let Some((other, words)) = given.version()?
            && other != version
        {
            bail!(Checkpoint, "config"; "{words}, but the tensors are those of GR00T {version}");
        }
        let config = given.read(version, rules)?;
        let own = format!("{}.embed_tokens", rules.names.language);
        let is_there = |name: &str| {
            let name = format!("{prefix}{name}.weight");
            names.clone().any(|other| other == name)
        };
        let has_twin_only = !is_there(&own) && is_there(rules.names.lm_head);
        Ok(Self {
            prefix,
            version,
            names: TensorNames {
                parts: rules.names,
                embedding: match has_twin_only {
                    true => rules.names.lm_head.to_owned(),
                    false => own,
                },
            },
            config,
        })
    }

    /// Whether a checkpoint may hold a tensor `name`, without the prefix, that nothing of the backbone reads:
    /// the pooling head of SigLIP, the twin of the embeddings, layers of the language model beyond the last
    /// one that is kept, and its norm where features are not normed.
    pub(super) fn is_unused(&self, name: &str) -> bool {
        fn below<'a>(name: &'a str, path: &str) -> Option<&'a str> {
            name.strip_prefix(path)?.strip_prefix('.')
        }
        let names = &self.names.parts;
        let of_head = |rest: &str| names.connector.is_some() && rest.starts_with("head.");
        if below(name, names.lm_head) == Some("weight") || below(name, names.vision).is_some_and(of_head) {
            return true;
        }
        let Some(rest) = below(name, names.language) else {
            return false;
        };
        if rest == "norm.weight" {
            return !self.config.language.has_final_norm;
        }
        let layer = below(rest, "layers").and_then(|rest| rest.split('.').next()?.parse::<usize>().ok());
        layer.is_some_and(|layer| layer >= self.config.language.num_layers)
    }

    /// All problems, one on a line.
    pub(super) fn list(&self, problems: &[TensorProblem]) -> String {
        let what = format!("the backbone of GR00T {}", self.version);
        spec::list(problems, &what)
    }
}

/// All backbones among tensors of these names, with the prefix of each.
pub(crate) fn backbones_in<'a>(
    names: impl Iterator<Item = &'a str> + Clone,
) -> Vec<(&'static str, Version, &'static BackboneRules)> {
    let mut found = Vec::new();
    for prefix in BACKBONE_PREFIXES {
        for (version, rules) in Version::backbones() {
            let marks = rules.marks();
            let is_own = |name: &str| {
                let name = name.strip_prefix(prefix);
                name.is_some_and(|name| marks.iter().any(|mark| name.starts_with(mark)))
            };
            if names.clone().any(is_own) {
                found.push((prefix, version, rules));
            }
        }
    }
    found
}

/// The error for a checkpoint without a backbone.
fn nothing_found<'a>(mut names: impl Iterator<Item = &'a str> + Clone) -> Error {
    let count = names.clone().count();
    let like = |prefix: &str| names.clone().find(|name| name.starts_with(prefix));
    let other = BACKBONE_PREFIXES
        .iter()
        .filter(|prefix| !prefix.is_empty())
        .find_map(|prefix| like(prefix));
    if let Some(name) = other {
        let known: Vec<String> = Version::backbones()
            .map(|(version, rules)| format!("{} ({version})", rules.names.vision))
            .collect();
        return Error::Checkpoint(problem!(
            "source";
            "the backbone is of a model that is not known: it has {name}, expected names that begin with one of {}",
            known.join(", ")
        ));
    }
    let first = names
        .next()
        .map_or_else(String::new, |name| format!(", such as {name}"));
    Error::Checkpoint(problem!(
        "source"; "there is no backbone among the {count} tensors{first}: expected names that begin with {}",
        BACKBONE_PREFIXES .iter() .filter(|prefix| !prefix.is_empty()) .map(|prefix| format!("`{prefix}`")) .collect::<Vec<_>>() .join(" or ")
    ))
}
