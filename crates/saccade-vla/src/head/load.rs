//! Loading a head: from a checkpoint, or from tensors in memory.

use std::path::Path;

use saccade_vla_checkpoint::probe_allocation;
use saccade_vla_checkpoint::spec;

use super::action_head::ActionHead;
use super::embodiments::{Embodiments, chosen_embodiments};
use super::layers::HeadLayers;
use super::plan::{head_plan, is_unused, specs_of};
use super::state_dropout::{STATE_DROPOUT, StateDropout, reads_state_dropout};
use crate::config::HeadConfig;
use crate::engine::{Engine, next_id};
use crate::error::{Error, Result, problem};
use crate::nn::source::Source;
use crate::nn::source::file::FileSource;
use crate::nn::source::memory::{self, MemorySource, TensorViews};
use crate::nn::weights;
use crate::precision::Precision;
use crate::recognise::HeadCheckpoint;
use crate::workspaces::Workspaces;

/// Options of loading a head.
///
/// ```
/// use saccade_vla::{LoadOptions, Precision};
/// let options = LoadOptions { precision: Precision::Int8, num_threads: Some(4), ..LoadOptions::default() };
/// assert_eq!(options.embodiment_ids, None);
/// ```
#[derive(Clone, Debug, Default)]
pub struct LoadOptions {
    /// The config as JSON; default the `config.json` in the checkpoint's directory.
    pub config: Option<String>,
    /// Keep only these embodiments; default all.
    pub embodiment_ids: Option<Vec<i64>>,
    /// Actions in a chunk, in place of the config's `action_horizon`; at most as many as the position table
    /// has rows.
    pub action_horizon: Option<usize>,
    /// States in an observation, each with a state row of its own; default 1. N1.7 makes one row of as many
    /// states as its config says.
    pub num_states: Option<usize>,
    /// The arithmetic of each kind of layer.
    pub precision: Precision,
    /// Threads that a call uses; default `SACCADE_NUM_THREADS`, or the physical cores that the process may
    /// use.
    pub num_threads: Option<usize>,
}

impl LoadOptions {
    /// The head's config with the actions and states that were asked for.
    fn rows_of(&self, mut config: HeadConfig) -> Result<HeadConfig> {
        if let Some(action_horizon) = self.action_horizon {
            config = config.with_action_horizon(action_horizon)?;
        }
        match self.num_states {
            Some(num_states) => config.with_num_states(num_states),
            None => Ok(config),
        }
    }
}

impl ActionHead {
    /// Loads a head from `source`: one `.safetensors` file, or a directory of one or more of them with a
    /// `config.json`.
    ///
    /// ```
    /// use saccade_vla::{ActionHead, LoadOptions, Precision};
    /// let options = LoadOptions { precision: Precision::Bfloat16, num_threads: Some(1), ..LoadOptions::default() };
    /// let head = ActionHead::load("examples/tiny".as_ref(), &options)?;
    /// assert_eq!((head.config().num_layers, head.engine().threads), (2, 1));
    /// # Ok::<(), saccade_vla::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::File`] for a path that is not there; [`Error::Checkpoint`] for a config or weights that are
    /// broken, not finite or do not fit each other (all that does not fit is listed); [`Error::Input`] for
    /// options out of range; [`Error::Memory`].
    pub fn load(source: &Path, options: &LoadOptions) -> Result<Self> {
        let engine = Engine::new(options.precision, options.num_threads)?;
        let mut published = HeadCheckpoint::open(source, options.config.as_deref())?;
        published.config = options.rows_of(published.config)?;
        let embodiment_ids = chosen_embodiments(
            options.embodiment_ids.as_deref(),
            published.kept_embodiments()?.as_deref(),
            published.config.num_embodiments,
        )?;
        published.check()?;
        probe_allocation(
            "source",
            published.nbytes(options.precision, embodiment_ids.len())?,
        )?;
        let drops_states = reads_state_dropout(&published.config_json, published.has(STATE_DROPOUT))?;
        let HeadCheckpoint {
            checkpoint,
            prefix,
            config,
            ..
        } = published;
        let wanted = head_plan(&config, &embodiment_ids)?.wanted;
        FileSource::read_ahead(&checkpoint, prefix, wanted, |tensors| {
            Self::build(tensors, engine, config, embodiment_ids, drops_states)
        })
    }

    /// A head from `tensors` in memory, by their names in a checkpoint without a prefix, with the sizes of
    /// the config in `options`, which must be there: bit for bit the head that [`Self::load`] reads from a
    /// file of them. The tensors are borrowed for the call only, and of layers for each embodiment only the
    /// wanted slices are touched.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] for a broken config, for tensors that are missing or unknown, and for weights
    /// that are not finite; [`Error::Shape`] if shapes alone are wrong (all that is wrong is listed in both);
    /// [`Error::Input`] for options out of range; [`Error::Memory`].
    pub fn from_tensors(tensors: &TensorViews<'_>, options: &LoadOptions) -> Result<Self> {
        let engine = Engine::new(options.precision, options.num_threads)?;
        let given_config = options.config.as_deref().ok_or_else(|| {
            Error::Input(problem!(
                "config"; "expected one, since tensors in memory bring none"
            ))
        })?;
        let config = options.rows_of(HeadConfig::from_json(given_config)?)?;
        let embodiment_ids =
            chosen_embodiments(options.embodiment_ids.as_deref(), None, config.num_embodiments)?;
        let has = |name: &str| tensors.contains_key(name);
        let problems = memory::problems(tensors, &specs_of(&config, has)?, |name, shape| {
            is_unused(&config, name, shape)
        });
        memory::check(&problems, |problems| spec::list(problems, "the config"))?;
        let drops_states = reads_state_dropout(given_config, has(STATE_DROPOUT))?;
        let source = MemorySource::new(tensors);
        Self::build(&source, engine, config, embodiment_ids, drops_states)
    }

    fn build(
        source: &dyn Source,
        engine: Engine,
        config: HeadConfig,
        embodiment_ids: Vec<usize>,
        drops_states: bool,
    ) -> Result<Self> {
        let embodiments = Embodiments {
            ids: &embodiment_ids,
            count: config.num_embodiments,
        };
        let ((state_dropout, layers), nbytes) = weights::build(source, engine, |weights| {
            // First, since it is small and may be refused.
            let state_dropout = match drops_states {
                true => StateDropout::read(weights, config.num_embodiments)?,
                false => StateDropout::none(),
            };
            Ok((state_dropout, HeadLayers::new(weights, &config, embodiments)?))
        })?;
        Ok(Self {
            config,
            engine,
            id: next_id(),
            embodiment_ids,
            layers,
            state_dropout,
            nbytes,
            workspaces: Workspaces::new(),
        })
    }
}
