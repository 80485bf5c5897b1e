//! The cross-attention of the head as a layer of its own, for programs in which everything else runs
//! elsewhere. The head's blocks do not use it: they are in `head/dit.rs`, on the same [`Attention`].

use saccade_vla_kernels::{Epilogue, LinearScratch, PackedKeyValues, Rows, RowsMut};

use crate::alloc::{Scratch, collected, filled, product};
use crate::array::{Array, ArrayMut, first_not_bias};
use crate::engine::{Engine, Kernels};
use crate::error::{Error, Result, bail, ensure, problem, show_shape};
use crate::nn::attention::{Attention, AttentionWorkspace, Bias, CrossKeys};
use crate::nn::sequences::Sequences;
use crate::nn::source::memory::{self, MemorySource, TensorViews};
use crate::nn::source::planner::plan;
use crate::nn::weights::{self, Weights};
use crate::precision::Precision;
use crate::profile::Part;
use crate::workspaces::Workspaces;
use saccade_vla_checkpoint::spec;

/// Projected keys and values of a batch: immutable, for any number of calls.
pub struct KeyValues {
    batch: usize,
    num_vl_tokens: usize,
    num_heads: usize,
    width: usize,
    packed: Vec<PackedKeyValues>,
}

impl KeyValues {
    /// Sequences.
    #[must_use]
    pub fn batch(&self) -> usize {
        self.batch
    }

    /// Keys of each.
    #[must_use]
    pub fn num_vl_tokens(&self) -> usize {
        self.num_vl_tokens
    }

    /// Bytes held.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        self.packed.iter().map(PackedKeyValues::nbytes).sum()
    }
}

/// `to_out(softmax(to_q(x) to_k(c)^T / sqrt(head_dim)) to_v(c))`.
pub struct CrossAttention {
    attention: Attention,
    engine: Engine,
    num_heads: usize,
    context_dim: usize,
    nbytes: usize,
    workspaces: Workspaces<(AttentionWorkspace, LinearScratch)>,
}

/// Which keys count, and how much.
#[derive(Clone, Copy, Debug, Default)]
pub struct KeyOptions<'a> {
    /// `(batch, num_vl_tokens)`, true = attended.
    pub key_mask: Option<Array<'a, bool>>,
    /// `(batch, num_vl_tokens)`, added to the logits.
    pub key_bias: Option<Array<'a>>,
}

impl CrossAttention {
    /// From `to_q.weight (width, width)`, `to_k.weight` and `to_v.weight (width, context_dim)`,
    /// `to_out.0.weight (width, width)` and their biases.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] that lists every tensor that is missing, unknown or misshaped; [`Error::Input`]
    /// if `num_heads` does not divide the width.
    pub fn new(
        tensors: &TensorViews<'_>,
        num_heads: usize,
        precision: Precision,
        num_threads: Option<usize>,
    ) -> Result<Self> {
        let engine = Engine::new(precision, num_threads)?;
        let size = |name: &str, axis: usize| {
            let shape = memory::shape_of(tensors, name)?;
            shape.get(axis).copied()
        };
        // The sizes come from two of the tensors; the others must agree with them.
        let width = size("to_q.weight", 0).unwrap_or(1);
        let context_dim = size("to_k.weight", 1).unwrap_or(1);
        let layer = |num_heads| {
            move |weights: &Weights<'_>| {
                Attention::new(weights, width, context_dim, num_heads, Part::ContextToKv)
            }
        };
        let problems = memory::problems(tensors, &plan(layer(1))?.specs, |_, _| false);
        if !problems.is_empty() {
            let listed = spec::list(&problems, "the widths of to_q and to_k");
            bail!(Checkpoint, "tensors"; "{listed}");
        }
        ensure!(
            width > 0 && context_dim > 0, Checkpoint, "tensors";
            expected "at least one input and output feature"; got "width {width} and context_dim {context_dim}"
        );
        ensure!(
            num_heads > 0 && width.is_multiple_of(num_heads), Input, "num_heads";
            expected "a divisor of the width {width}"; got "{num_heads}"
        );
        let source = MemorySource::new(tensors);
        let (attention, nbytes) = weights::build(&source, engine, layer(num_heads))?;
        Ok(Self {
            attention,
            nbytes,
            engine,
            num_heads,
            context_dim,
            workspaces: Workspaces::new(),
        })
    }

    /// Width of queries and output.
    #[must_use]
    pub fn width(&self) -> usize {
        self.attention.width()
    }

    /// Width of the tokens attended to.
    #[must_use]
    pub fn context_dim(&self) -> usize {
        self.context_dim
    }

    /// The instruction set, threads and precision of its calls.
    #[must_use]
    pub fn engine(&self) -> Engine {
        self.engine
    }

    /// Bytes of weights in memory.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        self.nbytes
    }

    /// Attention heads.
    #[must_use]
    pub fn num_heads(&self) -> usize {
        self.num_heads
    }

    /// Keys and values of `encoder_hidden_states (batch, num_vl_tokens, context_dim)`.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for states that do not fit.
    pub fn project(&self, encoder_hidden_states: Array<'_>) -> Result<KeyValues> {
        let (batch, num_vl_tokens) =
            self.check_rows("encoder_hidden_states", encoder_hidden_states, self.context_dim)?;
        let packed = self.attention.project(
            &mut Kernels::new(self.engine, &mut LinearScratch::new()),
            Rows::new(encoder_hidden_states.data(), self.context_dim),
            &filled("keys and values", batch, num_vl_tokens)?,
            &mut Scratch::default(),
        )?;
        Ok(KeyValues {
            batch,
            num_vl_tokens,
            num_heads: self.num_heads,
            width: self.width(),
            packed,
        })
    }

    /// Attends from `hidden_states (batch, queries, width)` to `kv`.
    ///
    /// `key_mask (batch, num_vl_tokens)`: true = attended; `key_bias (batch, num_vl_tokens)` is added to the
    /// logits. A query with no key left gets zeros before the output projection. `out` is
    /// `(batch, queries, width)`; `weights`, if wanted, `(batch, heads, queries, keys)`.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for arguments that do not fit, [`Error::Input`] also for a
    /// result that is not finite, after which `out` is zero; [`Error::Memory`].
    pub fn attend(
        &self,
        hidden_states: Array<'_>,
        kv: &KeyValues,
        keys: KeyOptions<'_>,
        weights: Option<ArrayMut<'_>>,
        out: ArrayMut<'_>,
    ) -> Result<()> {
        let (batch, queries) = self.check_rows("hidden_states", hidden_states, self.width())?;
        self.check_keys(kv, batch)?;
        let shape = [batch, queries, self.width()];
        let out = out.check_shape("out", "(batch, queries, width)", &shape)?;
        let probabilities = match weights {
            None => None,
            Some(weights) => {
                let shape = [batch, self.num_heads, queries, kv.num_vl_tokens];
                Some(weights.check_shape("weights", "(batch, heads, queries, keys)", &shape)?)
            }
        };
        let logit_bias = logit_bias([kv.batch, kv.num_vl_tokens], keys.key_mask, keys.key_bias)?;
        let keys = CrossKeys {
            caches: &kv.packed,
            subset: None,
            bias: logit_bias.as_deref().map_or(Bias::None, Bias::Keys),
            probabilities,
        };
        let y = Sequences::new(Rows::new(hidden_states.data(), self.width()), batch);
        self.workspaces.with(Default::default, |(attention, scratch)| {
            let kernels = &mut Kernels::new(self.engine, scratch);
            let out = RowsMut::new(out, self.width());
            self.attention
                .cross(kernels, y, keys, attention, Epilogue::Store, out)
        })?;
        let result = Array::new(out, &shape)?.check_result("hidden_states");
        result.map(drop).inspect_err(|_| out.fill(0.0))
    }

    fn check_keys(&self, kv: &KeyValues, batch: usize) -> Result<()> {
        ensure!(
            (kv.num_heads, kv.width) == (self.num_heads, self.width()), Input, "kv";
            expected "keys and values of {} heads and width {}", self.num_heads, self.width();
            got "{} and {}", kv.num_heads, kv.width
        );
        ensure!(
            batch == kv.batch, Shape, "hidden_states"; expected "the batch of kv, {}", kv.batch; got "{batch}"
        );
        Ok(())
    }

    fn check_rows(&self, name: &str, array: Array<'_>, width: usize) -> Result<(usize, usize)> {
        match *array.shape() {
            [batch, rows, last] if last == width && batch > 0 && rows > 0 => {
                array.check_finite(name)?;
                Ok((batch, rows))
            }
            _ => Err(Error::Shape(problem!(
                name; expected "(batch, rows, {width}) with at least one row";
                got "{}", show_shape(array.shape())
            ))),
        }
    }
}

/// Mask and bias in one: minus infinity takes a key away.
fn logit_bias(
    shape: [usize; 2],
    key_mask: Option<Array<'_, bool>>,
    key_bias: Option<Array<'_>>,
) -> Result<Option<Vec<f32>>> {
    let axes = "(batch, num_vl_tokens)";
    let mut values = match key_bias {
        None if key_mask.is_none() => return Ok(None),
        None => filled("key_mask", product("key_mask", &shape)?, 0.0)?,
        Some(bias) => {
            bias.check_shape("key_bias", axes, &shape)?;
            if let Some(bad) = first_not_bias(bias.data()) {
                bail!(Input, "key_bias"; expected "finite values or minus infinity"; got "{bad}");
            }
            collected("key_bias", bias.data().len(), bias.data().iter().copied())?
        }
    };
    if let Some(mask) = key_mask {
        mask.check_shape("key_mask", axes, &shape)?;
        for (value, &attended) in values.iter_mut().zip(mask.data()) {
            if !attended {
                *value = f32::NEG_INFINITY;
            }
        }
    }
    Ok(Some(values))
}
