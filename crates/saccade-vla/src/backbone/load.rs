//! Loading a backbone: from a checkpoint, or from tensors in memory.

use std::path::Path;

use saccade_vla_checkpoint::probe_allocation;

use super::checkpoint::BackboneCheckpoint;
use super::json::GivenConfig;
use super::model::Backbone;
use super::recognise::Recognised;
use crate::engine::{Engine, next_id};
use crate::error::Result;
use crate::nn::source::Source;
use crate::nn::source::file::FileSource;
use crate::nn::source::memory::{self, MemorySource, TensorViews};
use crate::nn::source::planner::plan;
use crate::nn::weights;
use crate::precision::Precision;
use crate::workspaces::Workspaces;

/// Options of loading a backbone.
#[derive(Clone, Debug, Default)]
pub struct BackboneLoadOptions {
    /// The config as JSON; default the `config.json` in the checkpoint's directory, if it is there.
    pub config: Option<String>,
    /// The arithmetic of each kind of layer.
    pub precision: Precision,
    /// Threads that a call uses; default `SACCADE_NUM_THREADS`, or the physical cores that the process may
    /// use.
    pub num_threads: Option<usize>,
}

impl Backbone {
    /// Loads a backbone from `source`: one `.safetensors` file, or a directory of one or more of them with a
    /// `config.json`.
    ///
    /// The version is that of the tensors. Sizes that the config does not hold are those of the published
    /// model.
    ///
    /// ```
    /// use saccade_vla::{Backbone, BackboneLoadOptions};
    /// let backbone = Backbone::load("examples/tiny".as_ref(), &BackboneLoadOptions::default())?;
    /// assert_eq!(backbone.config().version, "n1.5".parse()?);
    /// # Ok::<(), saccade_vla::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::File`](crate::Error::File) for a path that is not there;
    /// [`Error::Checkpoint`](crate::Error::Checkpoint) for a config or weights that are broken, not finite or
    /// do not fit each other (all that does not fit is listed); [`Error::Input`](crate::Error::Input) for
    /// options out of range; [`Error::Memory`](crate::Error::Memory).
    pub fn load(source: &Path, options: &BackboneLoadOptions) -> Result<Self> {
        let engine = Engine::new(options.precision, options.num_threads)?;
        let published = BackboneCheckpoint::open(source, options.config.as_deref())?;
        probe_allocation("source", published.nbytes_in(engine)?)?;
        let BackboneCheckpoint {
            checkpoint,
            found,
            plan,
        } = published;
        FileSource::read_ahead(&checkpoint, found.prefix, plan.wanted, |tensors| {
            Self::build(tensors, engine, &found)
        })
    }

    /// A backbone from `tensors` in memory, by their names in a checkpoint, with the config in `options`, or
    /// that of the published model: bit for bit the backbone that [`Self::load`] reads from a file of them.
    /// The tensors are borrowed for the call only.
    ///
    /// # Errors
    /// [`Error::Checkpoint`](crate::Error::Checkpoint) for a broken config, for tensors that are missing or
    /// unknown, and for weights that are not finite; [`Error::Shape`](crate::Error::Shape) if shapes alone
    /// are wrong (all that is wrong is listed in both); [`Error::Input`](crate::Error::Input) for options out
    /// of range; [`Error::Memory`](crate::Error::Memory).
    pub fn from_tensors(tensors: &TensorViews<'_>, options: &BackboneLoadOptions) -> Result<Self> {
        let engine = Engine::new(options.precision, options.num_threads)?;
        let given = GivenConfig::parse(options.config.as_deref().unwrap_or("{}"))?;
        let found = Recognised::new(tensors.keys().map(String::as_str), &given)?;
        let plan = plan(|weights| found.layers(weights))?;
        let own = tensors.iter().filter_map(|(name, tensor)| {
            let name = name.strip_prefix(found.prefix)?.to_owned();
            Some((name, tensor.clone()))
        });
        let own: TensorViews<'_> = own.collect();
        let problems = memory::problems(&own, &plan.specs, |name, _| found.is_unused(name));
        memory::check(&problems, |problems| found.list(problems))?;
        Self::build(&MemorySource::new(&own), engine, &found)
    }

    fn build(source: &dyn Source, engine: Engine, found: &Recognised) -> Result<Self> {
        let (layers, nbytes) = weights::build(source, engine, |weights| found.layers(weights))?;
        Ok(Self {
            config: found.config.clone(),
            engine,
            id: next_id(),
            layers,
            nbytes,
            workspaces: Workspaces::new(),
        })
    }
}
