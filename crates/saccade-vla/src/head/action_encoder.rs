//! Action rows from noisy actions and the timestep: `W3 silu(W2 [W1 x; tau]) + position` with the first two
//! layers merged.
//!
//! Equations 4 and 5 of docs/equations.md.

use std::sync::Arc;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};
use saccade_vla_kernels::{Epilogue, LinearScratch, Matrix, Rows, RowsMut, WeightRef, silu};

use super::embodiment_layers::EmbodimentLinear;
use super::embodiments::Embodiments;
use crate::alloc::Scratch;
use crate::array::OwnedArray;
use crate::cache::Cache;
use crate::config::HeadConfig;
use crate::engine::{Engine, Kernels};
use crate::error::Result;
use crate::nn::linear::Linear;
use crate::nn::sequences::Sequences;
use crate::nn::source::{Outline, Stored, Weight};
use crate::nn::weights::Weights;
use crate::ops::check_interrupted;
use crate::precision::Role;
use crate::sampling::timestep_embedding::action_encoder_embedding;

/// Time biases that are cached, one for each embodiment and timestep; 1.6 MB at N1.5's size.
pub(super) const CACHED_TIME_BIASES: usize = 256;

/// `W3(silu(W2([W1(x); tau]))) + position`, as the released layers compute, for the sinusoidal embedding
/// `tau` of the timestep.
///
/// The action half of `W2([W1(x); tau])` is linear in `x` and becomes one small layer. The time half, with
/// everything constant added to it, depends on embodiment and timestep only: the time bias.
pub(crate) struct ActionEncoder {
    /// `W1 W2[0:width]`, without bias: `(encoder_action_dim -> width)`.
    action: EmbodimentLinear,
    /// `tau -> tau W2[width:] + b1 W2[0:width] + b2`.
    time: EmbodimentLinear,
    /// `W3`.
    out: EmbodimentLinear,
    /// Its first `action_horizon` rows, `(action_horizon, width)`; none without `add_pos_embed`.
    position_embedding: Option<OwnedArray>,
    width: usize,
    time_biases: Cache<(usize, usize), Vec<f32>>,
}

impl ActionEncoder {
    /// From `action_encoder.W1`, `W2` and `W3`. `position_embedding` are rows of that table.
    pub(crate) fn new(
        weights: &Weights<'_>,
        embodiments: Embodiments<'_>,
        config: &HeadConfig,
        position_embedding: Option<OwnedArray>,
    ) -> Result<Self> {
        let (width, actions) = (config.width, config.encoder_action_dim);
        let mut time = Vec::with_capacity(embodiments.ids.len());
        let action = EmbodimentLinear::of(embodiments, |id| {
            let [action, of_time] = apart(weights, embodiments, id, actions, width)?;
            time.push(of_time);
            Ok(action)
        })?;
        let mut time = time.into_iter();
        Ok(Self {
            action,
            time: EmbodimentLinear::of(embodiments, |_| {
                Ok(time.next().expect("one per loaded embodiment"))
            })?,
            out: EmbodimentLinear::new(&weights.at("W3"), embodiments, width, width)?,
            position_embedding,
            width,
            time_biases: Cache::new(CACHED_TIME_BIASES),
        })
    }

    /// Action rows, `(batch * samples * action_horizon, width)`, to `encoded`, for noisy actions
    /// `x (batch * samples * action_horizon, encoder_action_dim)` of observations of these embodiments.
    /// `timestep` gives the timestep of an observation.
    pub(crate) fn encode(
        &self,
        kernels: &mut Kernels<'_>,
        embodiment_ids: &[usize],
        x: Rows<'_>,
        timestep: impl Fn(usize) -> usize,
        hidden: &mut Scratch,
        encoded: &mut Scratch,
    ) -> Result<()> {
        let observations = Sequences::new(x, embodiment_ids.len());
        let mut rows = hidden.rows(x.num_rows(), self.width)?;
        for (index, &id) in embodiment_ids.iter().enumerate() {
            let bias = self.time_bias(kernels.engine, id, timestep(index))?;
            let mut rows = rows.reborrow().rows(observations.range(index..index + 1));
            rows.iter_mut().for_each(|row| row.copy_from_slice(&bias));
        }
        self.action
            .apply(kernels, embodiment_ids, x, Epilogue::Add, rows)?;
        silu(kernels.engine.isa, hidden.as_mut_slice());
        let mut encoded = encoded.rows(x.num_rows(), self.width)?;
        self.out.apply(
            kernels,
            embodiment_ids,
            hidden.as_rows(),
            Epilogue::Store,
            encoded.reborrow(),
        )?;
        if let Some(positions) = &self.position_embedding {
            let positions = positions.rows();
            for (index, row) in encoded.iter_mut().enumerate() {
                let position = positions.row(index % positions.num_rows());
                row.iter_mut()
                    .zip(position)
                    .for_each(|(value, position)| *value += position);
            }
        }
        Ok(())
    }

    /// The part of the first two layers that depends on embodiment and timestep only, `(width)`.
    pub(crate) fn time_bias(
        &self,
        engine: Engine,
        embodiment_id: usize,
        timestep: usize,
    ) -> Result<Arc<Vec<f32>>> {
        self.time_biases.get_or_insert((embodiment_id, timestep), || {
            let mut tau = vec![0.0; self.width];
            action_encoder_embedding(timestep, &mut tau);
            let mut bias = vec![0.0; self.width];
            self.time.apply(
                &mut Kernels::new(engine, &mut LinearScratch::new()),
                &[embodiment_id],
                Rows::new(&tau, self.width),
                Epilogue::Store,
                RowsMut::new(&mut bias, self.width),
            )?;
            Ok(bias)
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
        WeightRef::Int4 { .. } => unreachable!("category-specific weights are checked to be floating point"),
    })
}

fn product(lhs: MatRef<'_, f64>, rhs: MatRef<'_, f64>) -> Mat<f64> {
    let mut out = Mat::zeros(lhs.nrows(), rhs.ncols());
    matmul(&mut out, Accum::Replace, lhs, rhs, 1.0, Par::Seq);
    out
}
