//! The action head: encode an observation once, sample chunks of actions from it as often as wanted.

use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use saccade_kernels::{Epilogue, Isa, LinearScratch, silu};

use crate::array::{Array, OwnedArray};
use crate::cache::Cache;
use crate::chunking::{Chunking, Seam};
use crate::config::{HeadConfig, Reads};
use crate::context::{Context, EncodeBuffers, Seen, VlEncoder, removed_keys};
use crate::dit::{Dit, DitBuffers, Pass, Rows};
use crate::error::{Error, Result, show_shape};
use crate::intervention::{Changes, Extent, Intervention};
use crate::layers::{ActionEncoder, CategoryLinear, Engine, TensorSource, sized};
use crate::layout::{HeadNames, is_unused};
use crate::memory::{self, MemorySource, TensorViews};
use crate::precision::Precision;
use crate::reading::HeadTensors;
use crate::recognise::Published;
use crate::tables::action_time;
use crate::trace::{Keep, Recorded, Shapes, StepBlock, Trace, TraceOptions};
use saccade_checkpoint::granted;
use saccade_checkpoint::spec::{self, Problem};

/// Brackets of the action encoder that are kept, one for each embodiment and bucket; 1.6 MB at N1.5's size.
const CACHED_BRACKETS: usize = 256;

/// How a head is loaded.
#[derive(Clone, Debug, Default)]
pub struct LoadOptions {
    /// The config as JSON; default the `config.json` beside the weights.
    pub config: Option<String>,
    /// Keep only these embodiments; default all.
    pub embodiment_ids: Option<Vec<i64>>,
    /// What is computed in what.
    pub precision: Precision,
    /// Threads that a call uses; default `SACCADE_NUM_THREADS`, or the physical cores that the process may use.
    pub num_threads: Option<usize>,
}

/// The observation given to [`ActionHead::encode`].
#[derive(Clone, Copy, Debug)]
pub struct Features<'a> {
    /// `(batch, num_vl_tokens, context_dim)`.
    pub backbone_features: Array<'a>,
    /// `(batch, num_vl_tokens)`, true = attended. None: all are. A head that ignores padding takes an all-true mask only.
    pub attention_mask: Option<Array<'a, bool>>,
    /// `(batch, num_vl_tokens)`, true = image token. A head whose blocks alternate between text and images needs it; every head keeps it, for
    /// maps.
    pub image_mask: Option<Array<'a, bool>>,
    /// `(batch, num_vl_tokens)`, true = as if the position were not there.
    pub drop_vl: Option<Array<'a, bool>>,
    /// What to keep of the VL self-attention.
    pub record: Keep,
}

impl<'a> Features<'a> {
    /// Features without masks.
    #[must_use]
    pub fn new(backbone_features: Array<'a>) -> Self {
        Self {
            backbone_features,
            attention_mask: None,
            image_mask: None,
            drop_vl: None,
            record: Keep::default(),
        }
    }
}

/// How the velocity is followed from noise to actions in one step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Integrator {
    /// `x + dt v(x, t)`, as the released sampler does.
    #[default]
    Euler,
    /// `x + dt v(x + dt / 2 v(x, t), t + dt / 2)`: two evaluations of the velocity.
    Midpoint,
}

impl Integrator {
    /// From its name: `euler` or `midpoint`.
    ///
    /// # Errors
    /// [`Error::Input`] for any other name.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "euler" => Ok(Self::Euler),
            "midpoint" => Ok(Self::Midpoint),
            _ => Err(Error::Input(format!(
                "integrator: expected euler or midpoint, got {name}"
            ))),
        }
    }

    /// Evaluations of the velocity in one step.
    fn evaluations(self) -> usize {
        match self {
            Self::Euler => 1,
            Self::Midpoint => 2,
        }
    }
}

/// How a chunk is sampled.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sampling<'a> {
    /// Steps, 1 to `num_timestep_buckets`; default the config's.
    pub num_steps: Option<usize>,
    /// What a step is. To the interventions all evaluations of a step are that step.
    pub integrator: Integrator,
    /// Chunks for each observation; none adds no axis to noise and result.
    pub num_samples: Option<usize>,
    /// The rows of state and future tokens run at every so many evaluations of the velocity, from the first one on. At the others only the
    /// action rows run, and self-attention reads the others' keys and values as they last were. None and 1: at all, which is exact.
    pub future_refresh: Option<usize>,
    /// The chunk before, and how this one begins with its end; none starts from noise alone.
    pub chunking: Option<Chunking<'a>>,
    /// What to change inside the head. Cuts and biases act on the rows that run; a patch of rows that do not is an error.
    pub interventions: &'a [Intervention],
}

/// A loaded action head. Immutable; serves any number of threads at once.
pub struct ActionHead {
    config: HeadConfig,
    engine: Engine,
    /// Tells contexts of this head from those of others.
    id: u64,
    embodiment_ids: Vec<usize>,
    vl: VlEncoder,
    state_encoder: [CategoryLinear; 2],
    action_encoder: ActionEncoder,
    /// `(num_future_tokens, width)`.
    future_tokens: OwnedArray,
    /// Its first `action_horizon` rows; none without `add_pos_embed`.
    position_embedding: Option<Vec<f32>>,
    dit: Dit,
    /// Their outputs stand side by side.
    decoders: Vec<[CategoryLinear; 2]>,
    brackets: Cache<(usize, usize), Vec<f32>>,
    workspaces: Mutex<Vec<Workspace>>,
}

/// Memory of one call, kept for the next call.
struct Workspace {
    encode: EncodeBuffers,
    dit: DitBuffers,
    embodiment_ids: Vec<usize>,
    state_hidden: Vec<f32>,
    state: Vec<f32>,
    x: Vec<f32>,
    /// `x` at the start of a step of two evaluations.
    start: Vec<f32>,
    /// What the velocity of each action of a chunk is multiplied by.
    strength: Vec<f32>,
    tokens: Vec<f32>,
    encoded: Vec<f32>,
    output: Vec<f32>,
    decoder_hidden: Vec<f32>,
    decoded: Vec<f32>,
    velocity: Vec<f32>,
    linear: LinearScratch,
}

impl Workspace {
    fn new() -> Self {
        Self {
            encode: EncodeBuffers::new(),
            dit: DitBuffers::new(),
            embodiment_ids: Vec::new(),
            state_hidden: Vec::new(),
            state: Vec::new(),
            x: Vec::new(),
            start: Vec::new(),
            strength: Vec::new(),
            tokens: Vec::new(),
            encoded: Vec::new(),
            output: Vec::new(),
            decoder_hidden: Vec::new(),
            decoded: Vec::new(),
            velocity: Vec::new(),
            linear: LinearScratch::new(),
        }
    }
}

impl ActionHead {
    /// Loads a head from `source`: one `.safetensors` file, or a directory with `config.json` beside one or more of them.
    ///
    /// # Errors
    /// [`Error::File`] for a path that is not there, [`Error::Checkpoint`] for a config or weights that are broken or do not fit each
    /// other (all that is wrong is listed), [`Error::Input`] for options out of range.
    pub fn load(source: &Path, options: &LoadOptions) -> Result<Self> {
        let engine = engine(options.precision, options.num_threads)?;
        let published = Published::open(source, options.config.as_deref())?;
        let embodiment_ids = chosen_embodiments(
            options.embodiment_ids.as_deref(),
            published.kept_embodiments()?.as_deref(),
            published.config.num_embodiments,
        )?;
        published.check()?;
        granted(
            "source",
            published.nbytes(options.precision, embodiment_ids.len())?,
        )?;
        let Published {
            checkpoint,
            prefix,
            config,
            ..
        } = published;
        let names = HeadNames::new(&config);
        let wanted = names.reading_order(&config, &embodiment_ids);
        HeadTensors::read_ahead(&checkpoint, prefix, wanted, |tensors| {
            Self::build(tensors, engine, config, &names, embodiment_ids)
        })
    }

    /// A head from `tensors` in memory, by their names in a checkpoint without a prefix, with the sizes of the config in `options`, which must
    /// be there: bit for bit the head that [`Self::load`] reads from a file of them. The tensors are borrowed for the call only, and of
    /// layers for each embodiment only the wanted slices are touched.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] for a broken config and for tensors that are missing or unknown, [`Error::Shape`] if shapes alone are wrong (all
    /// that is wrong is listed in both), [`Error::Input`] for options out of range.
    pub fn from_tensors(tensors: &TensorViews<'_>, options: &LoadOptions) -> Result<Self> {
        let engine = engine(options.precision, options.num_threads)?;
        let config = options.config.as_deref().ok_or_else(|| {
            Error::Input("config: expected one, since tensors in memory bring none".to_owned())
        })?;
        let config = HeadConfig::from_json(config)?;
        let embodiment_ids =
            chosen_embodiments(options.embodiment_ids.as_deref(), None, config.num_embodiments)?;
        let names = HeadNames::new(&config);
        let problems = memory::problems(tensors, &names.tensors(), |name, shape| {
            is_unused(&config, name, shape)
        });
        if !problems.is_empty() {
            let message = format!("tensors: {}", spec::list(&problems, "the config"));
            let is_shape = |problem: &Problem| matches!(problem, Problem::Shape(_));
            return Err(if problems.iter().all(is_shape) {
                Error::Shape(message)
            } else {
                Error::Checkpoint(message)
            });
        }
        Self::build(
            &MemorySource::new(tensors),
            engine,
            config,
            &names,
            embodiment_ids,
        )
    }

    /// Asks for tensors in the order of [`HeadNames::reading_order`].
    fn build(
        tensors: &dyn TensorSource,
        engine: Engine,
        config: HeadConfig,
        names: &HeadNames,
        embodiment_ids: Vec<usize>,
    ) -> Result<Self> {
        let ids = &embodiment_ids;
        let category = |names| CategoryLinear::load(tensors, engine, names, ids);
        let [state_1, state_2] = &names.state_encoder;
        Ok(Self {
            engine,
            id: next_id(),
            vl: VlEncoder::load(tensors, engine, &config, names)?,
            state_encoder: [category(state_1)?, category(state_2)?],
            action_encoder: ActionEncoder::load(tensors, engine, &names.action_encoder, ids)?,
            future_tokens: OwnedArray::new(
                match config.num_future_tokens {
                    0 => Vec::new(),
                    _ => tensors.tensor(&names.future_tokens.0)?.into_f32(),
                },
                &[config.num_future_tokens, config.width],
            ),
            position_embedding: match &names.position_embedding {
                None => None,
                Some((name, _)) => Some(tensors.slices(name, 0..config.action_horizon)?.into_f32()),
            },
            dit: Dit::load(tensors, engine, &config, names)?,
            decoders: names
                .decoders
                .iter()
                .map(|[layer1, layer2]| Ok([category(layer1)?, category(layer2)?]))
                .collect::<Result<_>>()?,
            brackets: Cache::new(CACHED_BRACKETS),
            workspaces: Mutex::new(Vec::new()),
            embodiment_ids,
            config,
        })
    }

    /// Sizes and switches.
    #[must_use]
    pub fn config(&self) -> &HeadConfig {
        &self.config
    }

    /// The loaded embodiments, ascending.
    #[must_use]
    pub fn embodiment_ids(&self) -> &[usize] {
        &self.embodiment_ids
    }

    /// The learned future tokens, `(num_future_tokens, width)`: what the future rows are before the first block.
    #[must_use]
    pub fn future_tokens(&self) -> Array<'_> {
        self.future_tokens.view()
    }

    /// Threads that a call uses.
    #[must_use]
    pub fn num_threads(&self) -> usize {
        self.engine.threads
    }

    /// What it computes in.
    #[must_use]
    pub fn precision(&self) -> Precision {
        self.engine.precision
    }

    /// The instruction set that the kernels use.
    #[must_use]
    pub fn isa(&self) -> Isa {
        self.engine.isa
    }

    /// Bytes of weights in memory.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        let category = |layers: &[CategoryLinear]| layers.iter().map(CategoryLinear::nbytes).sum::<usize>();
        self.vl.nbytes()
            + category(&self.state_encoder)
            + self.action_encoder.nbytes()
            + 4 * (self.future_tokens.data.len() + self.position_embedding.as_ref().map_or(0, Vec::len))
            + self.dit.nbytes()
            + self.decoders.iter().map(|layers| category(layers)).sum::<usize>()
    }

    /// Encodes observations: `vlln`, the VL self-attention, and the keys and values of every cross-attention block.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for features or masks that do not fit.
    pub fn encode(&self, features: &Features<'_>) -> Result<Context> {
        let (batch, num_vl_tokens) = self.check_features(features)?;
        let removed = features
            .drop_vl
            .filter(|mask| mask.data.contains(&true))
            .map(|mask| removed_keys(mask.data));
        let seen = self.seen(features, batch, num_vl_tokens)?;
        let mut recorded = self.vl.recorded(features.record, batch, num_vl_tokens)?;
        let cross = self.dit.cross_attentions();
        let (vl_embs, keys_values) = self.with_workspace(|workspace| {
            let data = features.backbone_features.data;
            let buffers = &mut workspace.encode;
            self.vl.encode(
                self.engine,
                &cross,
                data,
                num_vl_tokens,
                removed.as_deref(),
                &seen,
                &mut recorded,
                buffers,
            )
        });
        Ok(Context {
            head: self.id,
            batch,
            num_vl_tokens,
            vl_embs,
            keys_values,
            seen,
            image_mask: features.image_mask.map(|mask| mask.data.to_vec()),
            recorded,
        })
    }

    /// Samples a chunk of actions: Euler steps from `noise` (spec 1.8).
    ///
    /// `state` is `(batch, state_history, state_dim)`, or `(batch, state_dim)` where the history is of one; `embodiment_id` a scalar or `(batch)`, `noise`
    /// `(batch, action_horizon, encoder_action_dim)`, or `(batch, num_samples, action_horizon, encoder_action_dim)` with `num_samples`.
    /// `out` has the shape of the noise, with `action_dim` for its last axis.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for arguments that do not fit; `out` is then untouched.
    pub fn sample(
        &self,
        context: &Context,
        state: Array<'_>,
        embodiment_id: Array<'_, i64>,
        noise: Array<'_>,
        sampling: &Sampling<'_>,
        out: &mut [f32],
    ) -> Result<()> {
        self.check_context(context)?;
        let state = self.check_state(state, context.batch)?;
        let num_steps = self.check_num_steps(sampling.num_steps)?;
        let samples = self.check_noise(noise, context.batch, sampling.num_samples)?;
        let seam = self.check_chunking(sampling, context.batch)?;
        let refresh = check_refresh(sampling.future_refresh)?;
        let extent = self.extent(sampling.interventions, context, num_steps)?;
        let changes = Changes::new(sampling.interventions, extent)?;
        changes.check_refresh(refresh, sampling.integrator.evaluations())?;
        let pass = Pass {
            context,
            samples,
            changes: &changes,
            step: 0,
            rows: Rows::Needed,
        };
        self.with_workspace(|workspace| {
            self.check_embodiments(embodiment_id, context.batch, &mut workspace.embodiment_ids)?;
            self.encode_state(state, workspace);
            let nothing = &mut Recorded::default();
            let steps = (num_steps, sampling.integrator);
            self.begin(noise.data, seam.as_ref(), samples, workspace);
            self.follow(&pass, steps, refresh, nothing, workspace);
            self.copy_actions(&workspace.x, out);
            Ok(())
        })
    }

    /// As [`Self::sample`], and keeps what goes on inside. All rows are computed in every block, the last included.
    ///
    /// There is one chunk for each observation, and all rows run at every step: `sampling.num_samples` and `sampling.future_refresh` must
    /// be none, and `sampling.integrator` Euler's.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for arguments that do not fit, and for a trace of more than `options.max_bytes`.
    pub fn trace(
        &self,
        context: &Context,
        state: Array<'_>,
        embodiment_id: Array<'_, i64>,
        noise: Array<'_>,
        sampling: &Sampling<'_>,
        options: &TraceOptions,
    ) -> Result<Trace> {
        self.check_context(context)?;
        if let Some(samples) = sampling.num_samples {
            return Err(Error::Input(format!(
                "num_samples: expected none, since a trace is of one chunk an observation, got {samples}"
            )));
        }
        if sampling.integrator != Integrator::Euler {
            return Err(Error::Input(
                "integrator: expected euler, since a trace has one evaluation a step, got midpoint"
                    .to_owned(),
            ));
        }
        if let Some(refresh) = sampling.future_refresh {
            return Err(Error::Input(format!(
                "future_refresh: expected none, since a trace is of all rows at every step, got {refresh}"
            )));
        }
        let (batch, config) = (context.batch, &self.config);
        let state = self.check_state(state, batch)?;
        let num_steps = self.check_num_steps(sampling.num_steps)?;
        let samples = self.check_noise(noise, batch, None)?;
        let seam = self.check_chunking(sampling, batch)?;
        let extent = self.extent(sampling.interventions, context, num_steps)?;
        let groups = extent.groups;
        let shapes = |place: StepBlock| {
            let rows = groups.num_rows();
            let keys = if config.is_cross(place.1) { groups.vl } else { rows };
            let attention = [batch, config.num_heads, rows, keys];
            let hidden = [batch, rows, config.width];
            (place, Shapes { attention, hidden })
        };
        let places = options.places(num_steps, config.num_layers)?;
        let places: Vec<_> = places.into_iter().map(shapes).collect();
        // Before the interventions are worked out, since that takes memory too.
        let mut recorded = Recorded::claim("max_bytes", options.record, &places, options.max_bytes)?;
        let changes = Changes::new(sampling.interventions, extent)?;
        let pass = Pass {
            context,
            samples,
            changes: &changes,
            step: 0,
            rows: Rows::All,
        };
        self.with_workspace(|workspace| {
            self.check_embodiments(embodiment_id, batch, &mut workspace.embodiment_ids)?;
            self.encode_state(state, workspace);
            let steps = (num_steps, Integrator::Euler);
            self.begin(noise.data, seam.as_ref(), samples, workspace);
            self.follow(&pass, steps, 1, &mut recorded, workspace);
            let shape = [batch, config.action_horizon, config.action_dim];
            let mut actions = vec![0.0; shape.iter().product()];
            self.copy_actions(&workspace.x, &mut actions);
            Ok(Trace {
                recorded,
                groups,
                actions: OwnedArray::new(actions, &shape),
            })
        })
    }

    /// The velocity of noisy `actions (batch, action_horizon, encoder_action_dim)` at `timestep`, a bucket: a scalar or `(batch)`.
    /// To the interventions it is step 0 of 1.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for arguments that do not fit; `out` is then untouched.
    #[allow(clippy::too_many_arguments)] // The equation's variables.
    pub fn velocity(
        &self,
        context: &Context,
        state: Array<'_>,
        embodiment_id: Array<'_, i64>,
        actions: Array<'_>,
        timestep: Array<'_, i64>,
        interventions: &[Intervention],
        out: &mut [f32],
    ) -> Result<()> {
        self.check_context(context)?;
        let batch = context.batch;
        let state = self.check_state(state, batch)?;
        let expected = [batch, self.config.action_horizon, self.config.encoder_action_dim];
        let actions = actions
            .check_shape(
                "actions",
                "(batch, action_horizon, encoder_action_dim)",
                &expected,
            )?
            .check_finite("actions")?;
        let timesteps = self.check_timestep(timestep, batch)?;
        let changes = Changes::new(interventions, self.extent(interventions, context, 1)?)?;
        self.with_workspace(|workspace| {
            self.check_embodiments(embodiment_id, batch, &mut workspace.embodiment_ids)?;
            self.encode_state(state, workspace);
            sized(&mut workspace.x, actions.data.len()).copy_from_slice(actions.data);
            let times = timesteps.iter().map(|&bucket| self.dit.time(self.engine, bucket));
            workspace.dit.times.clear();
            workspace.dit.times.extend(times);
            let pass = Pass {
                context,
                samples: 1,
                changes: &changes,
                step: 0,
                rows: Rows::Needed,
            };
            let bucket = |element: usize| timesteps[element];
            self.step_velocity(&pass, bucket, &mut Recorded::default(), workspace);
            out.copy_from_slice(&workspace.velocity);
            Ok(())
        })
    }

    /// Allocates and touches all that calls of this size need: weights, caches, buffers and threads.
    ///
    /// # Errors
    /// [`Error::Input`] for a size of zero.
    pub fn warmup(
        &self,
        num_vl_tokens: usize,
        batch: usize,
        num_samples: Option<usize>,
        future_refresh: Option<usize>,
    ) -> Result<()> {
        check_refresh(future_refresh)?;
        for (name, size) in [
            ("num_vl_tokens", num_vl_tokens),
            ("batch", batch),
            ("num_samples", num_samples.unwrap_or(1)),
        ] {
            if size == 0 {
                return Err(Error::Input(format!("{name}: expected at least 1, got 0")));
            }
        }
        let config = &self.config;
        let rows = num_samples
            .unwrap_or(1)
            .checked_mul(config.num_rows())
            .and_then(|rows| rows.checked_mul(config.width));
        let tokens = num_vl_tokens.checked_mul(config.context_dim);
        let elements = rows
            .zip(tokens)
            .and_then(|(rows, tokens)| rows.checked_add(tokens)?.checked_mul(batch));
        if elements.is_none_or(|elements| elements > MAX_WARMUP_ELEMENTS) {
            return Err(Error::Input(format!(
                "num_vl_tokens, batch, num_samples: expected sizes whose rows fit in memory, got {num_vl_tokens}, {batch}, {}",
                num_samples.unwrap_or(1)
            )));
        }
        let features = vec![0.0; batch * num_vl_tokens * config.context_dim];
        let shape = [batch, num_vl_tokens, config.context_dim];
        // One kind of block sees all but one token: no call of this size gathers more at a time.
        let kinds = self.kinds();
        if kinds.len() > num_vl_tokens {
            return Err(Error::Input(format!(
                "num_vl_tokens: expected at least 2, one of text and one of an image, got {num_vl_tokens}"
            )));
        }
        let is_image = |token: usize| kinds.contains(&Reads::Images) && !token.is_multiple_of(num_vl_tokens);
        let image_mask: Vec<_> = (0..batch * num_vl_tokens).map(is_image).collect();
        let context = self.encode(&Features {
            image_mask: Some(Array::new(&image_mask, &shape[..2])),
            ..Features::new(Array::new(&features, &shape))
        })?;
        let state_shape = [batch, config.state_history, config.state_dim];
        let state = vec![0.0; state_shape.iter().product()];
        let state = Array::new(&state, &state_shape);
        let chunk = [config.action_horizon, config.encoder_action_dim];
        let shape: Vec<usize> = [batch].into_iter().chain(num_samples).chain(chunk).collect();
        let noise = vec![0.0; shape.iter().product()];
        let mut out = vec![0.0; noise.len() / config.encoder_action_dim * config.action_dim];
        for &id in &self.embodiment_ids {
            for step in 0..config.num_steps {
                self.bracket(id, self.bucket(step, config.num_steps));
            }
        }
        let embodiment_id = [self.embodiment_ids[0] as i64];
        let embodiment_id = Array::new(&embodiment_id, &[]);
        self.sample(
            &context,
            state,
            embodiment_id,
            Array::new(&noise, &shape),
            &Sampling {
                num_samples,
                future_refresh,
                ..Sampling::default()
            },
            &mut out,
        )
    }

    /// What a call on `context` is over.
    fn extent<'a>(
        &'a self,
        interventions: &'a [Intervention],
        context: &Context,
        num_steps: usize,
    ) -> Result<Extent<'a>> {
        Extent::new(
            &self.config,
            &self.future_tokens.data,
            interventions,
            context,
            num_steps,
        )
    }

    /// What a chunk starts from, to `workspace.x (batch, samples, action_horizon, encoder_action_dim)`: noise, and where there was a chunk before
    /// its end. What no decoder moves is zero.
    fn begin(&self, noise: &[f32], seam: Option<&Seam<'_>>, samples: usize, workspace: &mut Workspace) {
        let Workspace { x, strength, .. } = workspace;
        let (horizon, width) = (self.config.action_horizon, self.config.encoder_action_dim);
        sized(x, noise.len()).copy_from_slice(noise);
        sized(strength, horizon).fill(1.0);
        if let Some(seam) = seam {
            seam.begin(samples, horizon, width, x);
            for (index, strength) in strength.iter_mut().enumerate() {
                *strength = seam.strength(index);
            }
        }
        for row in x.chunks_exact_mut(width) {
            row[self.config.action_dim..].fill(0.0);
        }
    }

    /// The actions as they are returned: without what no decoder moves.
    fn copy_actions(&self, x: &[f32], out: &mut [f32]) {
        let (width, action_dim) = (self.config.encoder_action_dim, self.config.action_dim);
        for (row, out) in x.chunks_exact(width).zip(out.chunks_exact_mut(action_dim)) {
            out.copy_from_slice(&row[..action_dim]);
        }
    }

    /// Follows the velocity from `workspace.x` to the actions in equal steps, in place. At evaluations that `refresh` does not divide only the
    /// action rows run.
    fn follow(
        &self,
        pass: &Pass<'_>,
        (num_steps, integrator): (usize, Integrator),
        refresh: usize,
        recorded: &mut Recorded<StepBlock>,
        workspace: &mut Workspace,
    ) {
        let dt = 1.0 / num_steps as f32;
        let in_step = integrator.evaluations();
        let refreshes = |evaluation: usize| evaluation.is_multiple_of(refresh);
        for evaluation in 0..num_steps * in_step {
            let step = evaluation / in_step;
            let bucket = self.bucket(evaluation, num_steps * in_step);
            let times = &mut workspace.dit.times;
            times.clear();
            times.resize(pass.context.batch, self.dit.time(self.engine, bucket));
            let rows = if !refreshes(evaluation) {
                Rows::Actions
            } else if evaluation + 1 < num_steps * in_step && !refreshes(evaluation + 1) {
                Rows::NeededAndHeld
            } else {
                pass.rows
            };
            self.step_velocity(&Pass { step, rows, ..*pass }, |_| bucket, recorded, workspace);
            let Workspace {
                x,
                start,
                strength,
                velocity,
                ..
            } = &mut *workspace;
            let dt = match (integrator, evaluation % in_step) {
                (Integrator::Euler, _) => dt,
                (Integrator::Midpoint, 0) => {
                    sized(start, x.len()).copy_from_slice(x);
                    dt / 2.0
                }
                (Integrator::Midpoint, _) => {
                    x.copy_from_slice(start);
                    dt
                }
            };
            let rows = x
                .chunks_exact_mut(self.config.encoder_action_dim)
                .zip(velocity.chunks_exact(self.config.action_dim));
            for ((x, v), strength) in rows.zip(strength.iter().cycle()) {
                for (x, v) in x.iter_mut().zip(v) {
                    *x += dt * v * strength;
                }
            }
        }
    }

    /// The bucket of evaluation number `index` of `count` at equal times: float64, truncated, as the released sampler does.
    fn bucket(&self, index: usize, count: usize) -> usize {
        (index as f64 / count as f64 * self.config.num_timestep_buckets as f64) as usize
    }

    /// One state row for each batch element, to `workspace.state (batch, width)`.
    fn encode_state(&self, state: &[f32], workspace: &mut Workspace) {
        let Workspace {
            embodiment_ids,
            state_hidden,
            state: encoded,
            linear,
            ..
        } = workspace;
        let batch = embodiment_ids.len();
        let [layer1, layer2] = &self.state_encoder;
        let hidden = sized(state_hidden, batch * self.config.hidden_dim);
        layer1.apply(self.engine, embodiment_ids, state, Epilogue::Relu, hidden, linear);
        layer2.apply(
            self.engine,
            embodiment_ids,
            hidden,
            Epilogue::Store,
            sized(encoded, batch * self.config.width),
            linear,
        );
    }

    /// One forward pass over `workspace.x (batch, samples, action_horizon, encoder_action_dim)`, to `workspace.velocity`.
    fn step_velocity(
        &self,
        pass: &Pass<'_>,
        bucket: impl Fn(usize) -> usize,
        recorded: &mut Recorded<StepBlock>,
        workspace: &mut Workspace,
    ) {
        self.encode_actions(pass.samples, bucket, workspace);
        self.assemble_rows(pass, workspace);
        let Workspace {
            dit,
            embodiment_ids,
            output,
            decoder_hidden,
            decoded,
            velocity,
            linear,
            ..
        } = workspace;
        self.dit.forward(self.engine, pass, recorded, dit, output);
        let action_dim = self.config.action_dim;
        let rows = output.len() / self.config.hidden_dim;
        let hidden = sized(decoder_hidden, output.len());
        let velocity = sized(velocity, rows * action_dim);
        let mut first = 0; // column of the decoder's first output
        for ([layer1, layer2], (_, width)) in self.decoders.iter().zip(&self.config.decoders) {
            let decoded = sized(decoded, rows * width);
            layer1.apply(
                self.engine,
                embodiment_ids,
                output,
                Epilogue::Relu,
                hidden,
                linear,
            );
            layer2.apply(
                self.engine,
                embodiment_ids,
                hidden,
                Epilogue::Store,
                decoded,
                linear,
            );
            for (row, decoded) in velocity
                .chunks_exact_mut(action_dim)
                .zip(decoded.chunks_exact(*width))
            {
                row[first..first + width].copy_from_slice(decoded);
            }
            first += width;
        }
    }

    /// Action rows from noisy actions (spec 1.3 with I12), to `workspace.encoded (batch, samples, action_horizon, width)`.
    fn encode_actions(&self, samples: usize, bucket: impl Fn(usize) -> usize, workspace: &mut Workspace) {
        let Workspace {
            embodiment_ids,
            x,
            tokens,
            encoded,
            linear,
            ..
        } = workspace;
        let (width, horizon) = (self.config.width, self.config.action_horizon);
        let element = samples * horizon * width;
        let tokens = sized(tokens, embodiment_ids.len() * element);
        for (index, (rows, &id)) in tokens
            .chunks_exact_mut(element)
            .zip(embodiment_ids.iter())
            .enumerate()
        {
            let bracket = self.bracket(id, bucket(index));
            rows.chunks_exact_mut(width)
                .for_each(|row| row.copy_from_slice(&bracket));
        }
        let encoder = &self.action_encoder;
        encoder
            .action
            .apply(self.engine, embodiment_ids, x, Epilogue::Add, tokens, linear);
        silu(self.engine.isa, tokens);
        let encoded = sized(encoded, tokens.len());
        encoder.out.apply(
            self.engine,
            embodiment_ids,
            tokens,
            Epilogue::Store,
            encoded,
            linear,
        );
        if let Some(positions) = &self.position_embedding {
            for chunk in encoded.chunks_exact_mut(positions.len()) {
                for (value, position) in chunk.iter_mut().zip(positions) {
                    *value += position;
                }
            }
        }
    }

    /// The part of the action encoder that depends on embodiment and bucket only, `(width)`.
    fn bracket(&self, embodiment_id: usize, bucket: usize) -> Arc<Vec<f32>> {
        self.brackets.get_or_insert((embodiment_id, bucket), || {
            let width = self.config.width;
            let mut tau = vec![0.0; width];
            action_time(bucket, &mut tau);
            let mut bracket = vec![0.0; width];
            self.action_encoder.time.apply(
                self.engine,
                &[embodiment_id],
                &tau,
                Epilogue::Store,
                &mut bracket,
                &mut LinearScratch::new(),
            );
            bracket
        })
    }

    /// `[state, future, action]` for each sequence, or those of them that run, to the transformer's residual stream.
    fn assemble_rows(&self, pass: &Pass<'_>, workspace: &mut Workspace) {
        let Workspace {
            state, encoded, dit, ..
        } = workspace;
        if pass.rows == Rows::Actions {
            return sized(&mut dit.action, encoded.len()).copy_from_slice(encoded);
        }
        let width = self.config.width;
        let actions = self.config.action_horizon * width;
        let sequence = pass.changes.extent.groups.num_rows() * width;
        let future_tokens = pass.changes.extent.future_tokens;
        let h = sized(&mut dit.h, encoded.len() / actions * sequence);
        for (index, (h, action)) in h
            .chunks_exact_mut(sequence)
            .zip(encoded.chunks_exact(actions))
            .enumerate()
        {
            let element = index / pass.samples;
            let (h_state, rest) = h.split_at_mut(width);
            let (h_future, h_action) = rest.split_at_mut(future_tokens.len());
            h_state.copy_from_slice(&state[element * width..(element + 1) * width]);
            h_future.copy_from_slice(future_tokens);
            h_action.copy_from_slice(action);
        }
    }

    /// Lends a workspace to `call`. Like the caches, the list is never waited for: see [`Cache::get_or_insert`].
    fn with_workspace<R>(&self, call: impl FnOnce(&mut Workspace) -> R) -> R {
        let kept = self.workspaces.try_lock().ok().and_then(|mut kept| kept.pop());
        let mut workspace = kept.unwrap_or_else(Workspace::new);
        let result = call(&mut workspace);
        if let Ok(mut kept) = self.workspaces.try_lock() {
            kept.push(workspace);
        }
        result
    }

    fn check_features(&self, features: &Features<'_>) -> Result<(usize, usize)> {
        let array = features.backbone_features;
        let context_dim = self.config.context_dim;
        let &[batch, num_vl_tokens, width] = array.shape else {
            return Err(Error::Shape(format!(
                "backbone_features: expected (batch, num_vl_tokens, {context_dim}), got {}",
                show_shape(array.shape)
            )));
        };
        if width != context_dim || batch == 0 || num_vl_tokens == 0 {
            return Err(Error::Shape(format!(
                "backbone_features: expected (batch, num_vl_tokens, {context_dim}) with at least one observation and token, got {}",
                show_shape(array.shape)
            )));
        }
        array.check_finite("backbone_features")?;
        let masks = [
            ("attention_mask", features.attention_mask),
            ("image_mask", features.image_mask),
            ("drop_vl", features.drop_vl),
        ];
        for (name, mask) in masks {
            if let Some(mask) = mask {
                mask.check_shape(name, "(batch, num_vl_tokens)", &[batch, num_vl_tokens])?;
            }
        }
        let ignores_masks = self.config.attend_text_every_n_blocks == 0;
        if ignores_masks
            && features
                .attention_mask
                .is_some_and(|mask| mask.data.contains(&false))
        {
            return Err(Error::Input(format!(
                "attention_mask: this head (GR00T {}) ignores padding masks, so a mask with a false entry would promise what it does not do; \
                 pass None to reproduce the released code (padding is attended), or drop_vl=~attention_mask to remove these positions",
                self.config.version.to_uppercase()
            )));
        }
        if !ignores_masks && features.image_mask.is_none() {
            return Err(Error::Input(
                "image_mask: expected (batch, num_vl_tokens) booleans, True = image token, since this head's blocks alternate between text \
                 and images, got None"
                    .to_owned(),
            ));
        }
        Ok((batch, num_vl_tokens))
    }

    /// What each kind of the head's blocks sees of the features.
    ///
    /// # Errors
    /// [`Error::Input`] if a kind that alternates with another sees nothing of an observation: its softmax is not defined (spec 5.3).
    fn seen(&self, features: &Features<'_>, batch: usize, num_vl_tokens: usize) -> Result<Vec<Seen>> {
        let is = |mask: Option<Array<'_, bool>>, token: usize| mask.is_some_and(|mask| mask.data[token]);
        let is_left = |token| {
            let attended = features.attention_mask.is_none() || is(features.attention_mask, token);
            attended && !is(features.drop_vl, token)
        };
        let all_are_left = (0..batch * num_vl_tokens).all(is_left);
        let mut seen = Vec::new();
        for reads in self.kinds() {
            let is_seen = |token: usize| {
                is_left(token)
                    && match reads {
                        Reads::All => true,
                        Reads::Text => !is(features.image_mask, token),
                        Reads::Images => is(features.image_mask, token),
                    }
            };
            let of_element = |element: usize| {
                let first = element * num_vl_tokens;
                (0..num_vl_tokens)
                    .filter(|position| is_seen(first + position))
                    .collect::<Vec<_>>()
            };
            let positions = match reads {
                Reads::All if all_are_left => None,
                _ => Some((0..batch).map(of_element).collect::<Vec<_>>()),
            };
            let nothing = positions.iter().flatten().position(Vec::is_empty);
            if let Some(element) = nothing.filter(|_| reads != Reads::All) {
                let (kind, what) = match reads {
                    Reads::Images => ("image", "True"),
                    _ => ("text", "False"),
                };
                return Err(Error::Input(format!(
                    "image_mask: expected at least one {kind} token ({what}) in each observation that is attended and not dropped, since some \
                     of this head's blocks see nothing else, got none in observation {element}"
                )));
            }
            seen.push(Seen { reads, positions });
        }
        Ok(seen)
    }

    /// The kinds of cross-attention blocks that there are.
    fn kinds(&self) -> Vec<Reads> {
        let mut kinds = Vec::new();
        for reads in (0..self.config.num_layers).filter_map(|block| self.config.reads(block)) {
            if !kinds.contains(&reads) {
                kinds.push(reads);
            }
        }
        kinds
    }

    fn check_context(&self, context: &Context) -> Result<()> {
        if context.head == self.id {
            return Ok(());
        }
        Err(Error::Input(
            "context: it was made by another head, whose keys and values mean nothing here; call this head's encode".to_owned(),
        ))
    }

    fn check_state<'a>(&self, state: Array<'a>, batch: usize) -> Result<&'a [f32]> {
        let (history, width) = (self.config.state_history, self.config.state_dim);
        let is_one_state = history == 1 && state.shape == [batch, width];
        if !is_one_state && state.shape != [batch, history, width] {
            let axes = match history {
                1 => format!(
                    "(batch, state_dim) = {} or (batch, state_history, state_dim)",
                    show_shape(&[batch, width])
                ),
                _ => format!("the last {history} states, (batch, state_history, state_dim)"),
            };
            return Err(Error::Shape(format!(
                "state: expected {axes} = {}, normalised and zero-padded to state_dim as the checkpoint's normaliser does, got {}; \
                 saccade.Normalizer turns a robot's state into that",
                show_shape(&[batch, history, width]),
                show_shape(state.shape)
            )));
        }
        Ok(state.check_finite("state")?.data)
    }

    fn check_num_steps(&self, num_steps: Option<usize>) -> Result<usize> {
        let num_steps = num_steps.unwrap_or(self.config.num_steps);
        let buckets = self.config.num_timestep_buckets;
        if (1..=buckets).contains(&num_steps) {
            return Ok(num_steps);
        }
        Err(Error::Input(format!(
            "num_steps: expected 1 to {buckets} (num_timestep_buckets), got {num_steps}"
        )))
    }

    /// The number of samples an observation.
    fn check_noise(&self, noise: Array<'_>, batch: usize, num_samples: Option<usize>) -> Result<usize> {
        let (horizon, width) = (self.config.action_horizon, self.config.encoder_action_dim);
        match num_samples {
            None => {
                let axes = "(batch, action_horizon, encoder_action_dim)";
                noise.check_shape("noise", axes, &[batch, horizon, width])?;
            }
            Some(0) => return Err(Error::Input("num_samples: expected at least 1, got 0".to_owned())),
            Some(samples) => {
                let axes = "(batch, num_samples, action_horizon, encoder_action_dim)";
                noise.check_shape("noise", axes, &[batch, samples, horizon, width])?;
            }
        }
        noise.check_finite("noise")?;
        Ok(num_samples.unwrap_or(1))
    }

    fn check_chunking<'a>(&self, sampling: &Sampling<'a>, batch: usize) -> Result<Option<Seam<'a>>> {
        let chunking = sampling.chunking.as_ref();
        chunking
            .map(|chunking| chunking.check(&self.config, batch))
            .transpose()
    }

    fn check_embodiments(&self, ids: Array<'_, i64>, batch: usize, checked: &mut Vec<usize>) -> Result<()> {
        checked.clear();
        if !ids.shape.is_empty() {
            ids.check_shape("embodiment_id", "(batch,)", &[batch])?;
        }
        for &id in ids.data {
            let loaded = usize::try_from(id)
                .ok()
                .filter(|id| self.embodiment_ids.contains(id));
            checked.push(loaded.ok_or_else(|| self.embodiment_error(id))?);
        }
        checked.resize(batch, checked[0]);
        Ok(())
    }

    fn embodiment_error(&self, id: i64) -> Error {
        let last = self.config.num_embodiments - 1;
        if (0..=last as i64).contains(&id) {
            return Error::Input(format!(
                "embodiment_id: {id} is not loaded, only {:?} are",
                self.embodiment_ids
            ));
        }
        Error::Input(format!("embodiment_id: expected 0 to {last}, got {id}"))
    }

    fn check_timestep(&self, timestep: Array<'_, i64>, batch: usize) -> Result<Vec<usize>> {
        if !timestep.shape.is_empty() {
            timestep.check_shape("timestep", "(batch,)", &[batch])?;
        }
        let last = self.config.num_timestep_buckets - 1;
        let mut buckets = Vec::with_capacity(batch);
        for &given in timestep.data {
            let bucket = usize::try_from(given).ok().filter(|bucket| *bucket <= last);
            buckets.push(bucket.ok_or_else(|| {
                Error::Input(format!(
                    "timestep: expected a bucket from 0 to {last}, got {given}"
                ))
            })?);
        }
        buckets.resize(batch, buckets[0]);
        Ok(buckets)
    }
}

/// Elements of tokens and rows that a warm-up may ask for: 8 GB in float32, far above any batch that a CPU is given.
const MAX_WARMUP_ELEMENTS: usize = 1 << 31;

/// The most threads that can be asked for: far more than any machine has cores, far fewer than make starting them a problem.
const MAX_THREADS: usize = 1024;

/// Every how many Euler steps all rows run.
fn check_refresh(future_refresh: Option<usize>) -> Result<usize> {
    match future_refresh {
        Some(0) => Err(Error::Input(
            "future_refresh: expected at least 1, got 0".to_owned(),
        )),
        given => Ok(given.unwrap_or(1)),
    }
}

/// The engine that the environment, `precision` and `num_threads` ask for.
pub(crate) fn engine(precision: Precision, num_threads: Option<usize>) -> Result<Engine> {
    let isa = Isa::from_env().map_err(|error| Error::Input(error.to_string()))?;
    let threads = match num_threads {
        Some(threads) if (1..=MAX_THREADS).contains(&threads) => threads,
        Some(threads) => {
            return Err(Error::Input(format!(
                "num_threads: expected 1 to {MAX_THREADS}, got {threads}"
            )));
        }
        None => saccade_kernels::default_num_threads()
            .map_err(|error| Error::Input(error.to_string()))?
            .get(),
    };
    Ok(Engine {
        isa,
        threads,
        precision,
    })
}

fn next_id() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

/// The embodiments `ids`, ascending, of those that are there: the ones `kept`, or else all.
pub(crate) fn chosen_embodiments(
    ids: Option<&[i64]>,
    kept: Option<&[i64]>,
    num_embodiments: usize,
) -> Result<Vec<usize>> {
    let Some(ids) = ids.or(kept) else {
        return Ok((0..num_embodiments).collect());
    };
    let mut chosen = Vec::with_capacity(ids.len());
    for &id in ids {
        match usize::try_from(id) {
            Ok(known) if known < num_embodiments && kept.is_none_or(|kept| kept.contains(&id)) => {
                chosen.push(known);
            }
            _ => {
                let expected = match kept {
                    None => format!("ids from 0 to {}", num_embodiments - 1),
                    Some(kept) => {
                        let kept: Vec<String> = kept.iter().map(i64::to_string).collect();
                        format!("some of {}, which alone are in this checkpoint", kept.join(", "))
                    }
                };
                return Err(Error::Input(format!(
                    "embodiment_ids: expected {expected}, got {id}"
                )));
            }
        }
    }
    chosen.sort_unstable();
    chosen.dedup();
    if chosen.is_empty() {
        return Err(Error::Input(
            "embodiment_ids: expected at least one id, got none".to_owned(),
        ));
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A released head; its config stands in the file's metadata.
    fn released(name: &str) -> ActionHead {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../tests/data")
            .join(name);
        let bytes = std::fs::read(&path).unwrap();
        let size = usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
        let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + size]).unwrap();
        let config = header["__metadata__"]["config"].as_str().unwrap().to_owned();
        let options = LoadOptions {
            config: Some(config),
            num_threads: Some(2),
            ..LoadOptions::default()
        };
        ActionHead::load(&path, &options).unwrap()
    }

    /// Numbers that look random and are the same everywhere.
    fn numbers(len: usize, seed: u32) -> Vec<f32> {
        let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(12345);
        (0..len)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 23) as f32 - 1.0
            })
            .collect()
    }

    fn context(head: &ActionHead, batch: usize) -> Context {
        let shape = [batch, 9, head.config.context_dim];
        let features = numbers(shape.iter().product(), 1);
        let image_mask: Vec<_> = (0..batch * 9).map(|token| token % 3 == 1).collect();
        head.encode(&Features {
            image_mask: Some(Array::new(&image_mask, &shape[..2])),
            ..Features::new(Array::new(&features, &shape))
        })
        .unwrap()
    }

    /// One velocity with all rows, or only the needed ones, in the last block.
    fn velocity(head: &ActionHead, context: &Context, bucket: usize, rows: Rows) -> Vec<f32> {
        let mut workspace = Workspace::new();
        let config = &head.config;
        workspace
            .embodiment_ids
            .extend((0..context.batch).map(|element| element % 2));
        workspace.x = numbers(
            context.batch * config.action_horizon * config.encoder_action_dim,
            2,
        );
        let times = &mut workspace.dit.times;
        times.resize(context.batch, head.dit.time(head.engine, bucket));
        let state = numbers(context.batch * config.state_history * config.state_dim, 3);
        head.encode_state(&state, &mut workspace);
        let changes = Changes::new(&[], head.extent(&[], context, 1).unwrap()).unwrap();
        let pass = Pass {
            context,
            samples: 1,
            changes: &changes,
            step: 0,
            rows,
        };
        head.step_velocity(&pass, |_| bucket, &mut Recorded::default(), &mut workspace);
        workspace.velocity
    }

    const FILES: [&str; 5] = [
        "n15_tiny.safetensors",
        "n15_single_view.safetensors",
        "n15_bf16.safetensors",
        "n17_tiny.safetensors",
        "fork_two_decoders.safetensors",
    ];

    #[test]
    fn the_last_block_on_action_rows_only_changes_no_bit() {
        for file in FILES {
            let head = released(file);
            let context = context(&head, 3);
            for bucket in [0, 499, 999] {
                let needed = velocity(&head, &context, bucket, Rows::Needed);
                let all = velocity(&head, &context, bucket, Rows::All);
                assert_eq!(needed, all, "{file} at {bucket}");
            }
        }
    }

    #[test]
    fn kept_modulations_and_brackets_change_no_bit() {
        let (head, fresh) = (released(FILES[0]), released(FILES[0]));
        let kept = context(&head, 2);
        let first = velocity(&head, &kept, 250, Rows::Needed);
        for bucket in 0..CACHED_BRACKETS + 10 {
            velocity(&head, &kept, bucket, Rows::Needed);
        }
        assert_eq!(
            velocity(&head, &kept, 250, Rows::Needed),
            first,
            "pushed out and computed again"
        );
        let kept = context(&fresh, 2);
        assert_eq!(
            velocity(&fresh, &kept, 250, Rows::Needed),
            first,
            "never kept before"
        );
    }

    /// The action encoder as the released code has it: `W3(silu(W2([W1(x); tau])))`, in float64.
    #[test]
    fn the_action_encoder_taken_apart_is_the_plain_one() {
        let name = FILES[0];
        let head = released(name);
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../tests/data")
            .join(name);
        let checkpoint = crate::Checkpoint::open(&path).unwrap();
        let (width, id, bucket) = (head.config.width, 1, 250);
        let slice = |name: &str| {
            let tensor = checkpoint
                .read_slices(&format!("action_head.action_encoder.{name}"), id..id + 1)
                .unwrap();
            tensor.into_f32().into_iter().map(f64::from).collect::<Vec<_>>()
        };
        let linear = |layer: &str, x: &[f64]| {
            let (weight, mut out) = (slice(&format!("{layer}.W")), slice(&format!("{layer}.b")));
            let outputs = out.len();
            for (k, x) in x.iter().enumerate() {
                for (out, w) in out.iter_mut().zip(&weight[k * outputs..]) {
                    *out += x * w;
                }
            }
            out
        };
        let mut workspace = Workspace::new();
        workspace.embodiment_ids.push(id);
        workspace.x = numbers(head.config.action_horizon * head.config.encoder_action_dim, 2);
        head.encode_actions(1, |_| bucket, &mut workspace);

        let mut tau = vec![0.0; width];
        action_time(bucket, &mut tau);
        let positions = head.position_embedding.as_ref().unwrap();
        let actions = workspace.x.chunks_exact(head.config.encoder_action_dim);
        for (row, action) in actions.enumerate() {
            let action: Vec<f64> = action.iter().copied().map(f64::from).collect();
            let mut both = linear("W1", &action);
            both.extend(tau.iter().copied().map(f64::from));
            let hidden: Vec<f64> = linear("W2", &both)
                .into_iter()
                .map(|x| x / (1.0 + (-x).exp()))
                .collect();
            for (column, expected) in linear("W3", &hidden).into_iter().enumerate() {
                let index = row * width + column;
                let expected = expected + f64::from(positions[index]);
                let error = (f64::from(workspace.encoded[index]) - expected).abs();
                assert!(
                    error <= 2e-6 * expected.abs().max(1.0),
                    "row {row}, column {column}: {error}"
                );
            }
        }
    }

    #[test]
    fn encoding_in_chunks_changes_no_bit() {
        // 200 observations of 9 tokens are more rows than are encoded together.
        let head = released(FILES[0]);
        let many = context(&head, 200);
        let width = head.config.context_dim;
        for element in [0, 113, 199] {
            let features = numbers(200 * 9 * width, 1);
            let one = &features[element * 9 * width..(element + 1) * 9 * width];
            let one = head
                .encode(&Features::new(Array::new(one, &[1, 9, width])))
                .unwrap();
            assert_eq!(
                one.vl_embs(),
                &many.vl_embs()[element * 9 * width..(element + 1) * 9 * width]
            );
        }
    }
}
