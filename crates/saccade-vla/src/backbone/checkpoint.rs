//! A backbone in a checkpoint, before it is loaded: what it is, which tensors it has, how much memory it will
//! need.

use std::path::Path;

use saccade_vla_checkpoint::{Checkpoint, directory_of};

use super::config::BackboneConfig;
use super::json::GivenConfig;
use super::recognise::Recognised;
use crate::config::object_in_any;
use crate::engine::Engine;
use crate::error::{Error, Problem, Result};
use crate::nn::source::planner::{Plan, plan};
use crate::nn::source::sizer::nbytes;
use crate::precision::Precision;

/// A checkpoint with a backbone, open, whose tensors fit its config.
pub struct BackboneCheckpoint {
    pub(super) checkpoint: Checkpoint,
    pub(super) found: Recognised,
    pub(super) plan: Plan,
}

impl BackboneCheckpoint {
    /// Opens `source`, one `.safetensors` file or a directory of them, with `config`, as JSON, or the
    /// `config.json` next to the weights, if there is one. Reads no tensor.
    ///
    /// # Errors
    /// [`Error::File`] for a path that is not there; [`Error::Checkpoint`] if there is no backbone, and for a
    /// config or tensors that are broken or do not fit each other (all that does not fit is listed).
    pub fn open(source: &Path, config: Option<&str>) -> Result<Self> {
        let checkpoint = Checkpoint::open(source)?;
        let given = match config {
            Some(text) => GivenConfig::parse(text)?,
            None => config_of(source)?,
        };
        let names: Vec<&str> = checkpoint.names().collect();
        let found = Recognised::new(names.iter().copied(), &given)?;
        let plan = plan(|weights| found.layers(weights))?;
        let is_unused = |name: &str, _: &[usize]| found.is_unused(name);
        let problems = checkpoint.problems(found.prefix, &plan.specs, is_unused);
        if !problems.is_empty() {
            return Err(Error::Checkpoint(Problem::new("source", found.list(&problems))));
        }
        Ok(Self {
            checkpoint,
            found,
            plan,
        })
    }

    /// Its sizes and switches.
    #[must_use]
    pub fn config(&self) -> &BackboneConfig {
        &self.found.config
    }

    /// The beginning of the names of its tensors.
    #[must_use]
    pub fn prefix(&self) -> &'static str {
        self.found.prefix
    }

    /// Bytes of the layers at a precision.
    ///
    /// # Errors
    /// [`Error::Isa`] for an unknown instruction set in the environment; [`Error::Interrupted`].
    pub fn nbytes(&self, precision: Precision) -> Result<usize> {
        self.nbytes_in(Engine::new(precision, Some(1))?)
    }

    pub(super) fn nbytes_in(&self, engine: Engine) -> Result<usize> {
        let dtype = |name: &str| Ok(self.checkpoint.dtype(&format!("{}{name}", self.found.prefix))?);
        nbytes(engine, dtype, |weights| self.found.layers(weights))
    }

    /// The tensors that are read, by their names without the prefix.
    #[cfg(feature = "rewrite")]
    pub(crate) fn specs(&self) -> &[saccade_vla_checkpoint::TensorSpec] {
        &self.plan.specs
    }
}

/// The config next to the weights; an empty one if there is none.
fn config_of(source: &Path) -> Result<GivenConfig> {
    let path = directory_of(source).join("config.json");
    GivenConfig::of(object_in_any("config", &path)?.unwrap_or_default())
}

/// The tensors of a published backbone, by their names without a prefix.
#[cfg(all(test, feature = "processor"))]
pub(crate) fn published_specs(
    version: crate::release::Version,
) -> Result<Vec<saccade_vla_checkpoint::TensorSpec>> {
    let rules = version
        .release()
        .backbone
        .as_ref()
        .expect("a release with a backbone");
    let found = Recognised::new(rules.marks().iter().map(String::as_str), &GivenConfig::default())?;
    Ok(plan(|weights| found.layers(weights))?.specs)
}
