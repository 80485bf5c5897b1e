//! Action rows from noisy actions and the time (spec 1.3), with the first two layers taken apart (spec I12).

use std::sync::Arc;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};
use saccade_vla_kernels::{Activations, Epilogue, LinearScratch, Matrix, WeightRef, silu};

use super::cache::Cache;
use super::embodiment_layers::EmbodimentLinear;
use super::embodiments::Embodiments;
use crate::alloc::sized;
use crate::config::HeadConfig;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::linear::Linear;
use crate::nn::weights::{Outline, Stored, Weight, Weights};
use crate::ops::check_interrupted;
use crate::precision::Role;
use crate::sampling::timestep_embedding::action_encoder_embedding;

/// Brackets of the action encoder that are kept, one for each embodiment and bucket; 1.6 MB at N1.5's size.
pub(super) const CACHED_BRACKETS: usize = 256;

/// `W3(silu(W2([W1(x); tau]))) + position`, as the released layers compute.
///
/// The action half of `W2([W1(x); tau])` is linear in `x` and becomes one small layer; the time half, with everything constant added to it,
/// depends on embodiment and bucket only: the bracket.
pub(crate) struct ActionEncoder {
    /// `W1 W2[0:width]`, without bias: `(encoder_action_dim -> width)`.
    action: EmbodimentLinear,
    /// `tau -> tau W2[width:] + b1 W2[0:width] + b2`.
    time: EmbodimentLinear,
    /// `W3`.
    out: EmbodimentLinear,
    /// Its first `action_horizon` rows, `(action_horizon, width)`; none without `add_pos_embed`.
    position_embedding: Option<Vec<f32>>,
    width: usize,
    brackets: Cache<(usize, usize), Vec<f32>>,
}

/// Noisy actions, and the conditions under which they are encoded.
pub(crate) struct NoisyRows<'a> {
    /// By batch element.
    pub embodiment_ids: &'a [usize],
    /// `(batch, samples, action_horizon, encoder_action_dim)`.
    pub x: &'a [f32],
}

impl ActionEncoder {
    /// From `action_encoder.W1`, `W2` and `W3`. `position_embedding` are rows of that table.
    pub(crate) fn new(
        weights: &Weights<'_>,
        embodiments: Embodiments<'_>,
        config: &HeadConfig,
        position_embedding: Option<Vec<f32>>,
    ) -> Result<Self> {
        let (width, actions) = (config.width, config.encoder_action_dim);
        let mut time = Vec::with_capacity(embodiments.ids.len());
        let action = EmbodimentLinear::of(embodiments, actions, width, |id| {
            let [action, of_time] = apart(weights, embodiments, id, actions, width)?;
            time.push(of_time);
            Ok(action)
        })?;
        let mut time = time.into_iter();
        Ok(Self {
            action,
            time: EmbodimentLinear::of(embodiments, width, width, |_| {
                Ok(time.next().expect("one per loaded embodiment"))
            })?,
            out: EmbodimentLinear::new(&weights.at("W3"), embodiments, width, width)?,
            position_embedding,
            width,
            brackets: Cache::new(CACHED_BRACKETS),
        })
    }

    /// Action rows to `encoded (batch, samples, action_horizon, width)`. `bucket` gives the bucket of a batch element.
    pub(crate) fn encode(
        &self,
        engine: Engine,
        noisy: &NoisyRows<'_>,
        bucket: impl Fn(usize) -> usize,
        tokens: &mut Activations,
        encoded: &mut Activations,
        scratch: &mut LinearScratch,
    ) -> Result<()> {
        let NoisyRows { embodiment_ids, x } = *noisy;
        let rows = x.len() / self.action.in_features();
        let tokens = sized(tokens, rows * self.width)?; // (batch, samples, action_horizon, width)
        let element = tokens.len() / embodiment_ids.len();
        for (index, (rows, &id)) in tokens.chunks_exact_mut(element).zip(embodiment_ids).enumerate() {
            let bracket = self.bracket(engine, id, bucket(index))?;
            rows.chunks_exact_mut(self.width)
                .for_each(|row| row.copy_from_slice(&bracket));
        }
        self.action
            .apply(engine, embodiment_ids, x, Epilogue::Add, tokens, scratch)?;
        silu(engine.isa, tokens);
        let encoded = sized(encoded, tokens.len())?;
        self.out
            .apply(engine, embodiment_ids, tokens, Epilogue::Store, encoded, scratch)?;
        if let Some(positions) = &self.position_embedding {
            for chunk in encoded.chunks_exact_mut(positions.len()) {
                for (value, position) in chunk.iter_mut().zip(positions) {
                    *value += position;
                }
            }
        }
        Ok(())
    }

    /// The part that depends on embodiment and bucket only, `(width)`.
    pub(crate) fn bracket(
        &self,
        engine: Engine,
        embodiment_id: usize,
        bucket: usize,
    ) -> Result<Arc<Vec<f32>>> {
        self.brackets.get_or_insert((embodiment_id, bucket), || {
            let mut tau = vec![0.0; self.width];
            action_encoder_embedding(bucket, &mut tau);
            let mut bracket = vec![0.0; self.width];
            self.time.apply(
                engine,
                &[embodiment_id],
                &tau,
                Epilogue::Store,
                &mut bracket,
                &mut LinearScratch::new(),
            )?;
            Ok(bracket)
        })
    }
}

/// The action half and the time half of the first two layers of one embodiment.
fn apart(
    weights: &Weights<'_>,
    embodiments: Embodiments<'_>,
    id: usize,
    actions: usize,
    width: usize,
) -> Result<[Linear; 2]> {
    let (w1, w2) = (weights.at("W1"), weights.at("W2"));
    let count = embodiments.count;
    let first = w1.slice("W", &[count, actions, width], id)?;
    let first_bias = w1.slice("b", &[count, width], id)?.into_f32()?;
    let second = w2.slice("W", &[count, 2 * width, width], id)?;
    let second_bias = w2.slice("b", &[count, width], id)?.into_f32()?;

    // Products in float64: the fused layer is then closer to the exact one than two float32 layers are.
    let action_half = second.transposed(width, 2 * width).inputs(0, width);
    let (fused, constant);
    let (action, bias) = match (first.weight(actions, width), action_half) {
        (Weight::Held(first), Weight::Held(action_half)) => {
            let action_half = widened(action_half); // (out, hidden)
            let product_of_weights = product(action_half.as_ref(), widened(first).transpose()); // (out, action)
            let first_bias = widened(WeightRef::F32(Matrix::new(&first_bias, width)));
            let bias = product(action_half.as_ref(), first_bias.transpose()); // (out, 1)
            constant = second_bias
                .iter()
                .enumerate()
                .map(|(row, &b)| (f64::from(b) + bias[(row, 0)]) as f32)
                .collect::<Vec<_>>();
            fused = (0..width)
                .flat_map(|i| (0..actions).map(move |j| (i, j)))
                .map(|(i, j)| product_of_weights[(i, j)] as f32)
                .collect::<Vec<_>>();
            (
                Weight::Held(WeightRef::F32(Matrix::new(&fused, actions))),
                Some(constant.as_slice()),
            )
        }
        _ => {
            let outline = Outline {
                stored: Stored::F32,
                out_features: width,
                in_features: actions,
            };
            (Weight::Outline(outline), None)
        }
    };
    check_interrupted()?;
    let second = second.held_as(weights.engine(), Role::Time)?;
    let time_half = second.transposed(width, 2 * width).inputs(width, width);
    Ok([
        Linear::packed(weights.pack(Role::Other, &[(action, None)])?),
        Linear::packed(weights.pack(Role::Time, &[(time_half, bias)])?),
    ])
}

fn widened(weight: WeightRef<'_>) -> Mat<f64> {
    let (rows, columns) = weight.shape();
    Mat::from_fn(rows, columns, |i, j| match weight {
        WeightRef::F32(view) => f64::from(view.get(i, j)),
        WeightRef::Bf16(view) => view.get(i, j).to_f64(),
        WeightRef::Int8 { values, scales } => f64::from(values.get(i, j)) * f64::from(scales[i]),
    })
}

fn product(lhs: MatRef<'_, f64>, rhs: MatRef<'_, f64>) -> Mat<f64> {
    let mut out = Mat::zeros(lhs.nrows(), rhs.ncols());
    matmul(&mut out, Accum::Replace, lhs, rhs, 1.0, Par::Seq);
    out
}
