//! GPTQ: each column of weights is rounded, and the columns after it make up for its error.

use std::sync::Mutex;

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use saccade_vla_kernels::parallel_for;

use super::factor::{Factor, WHAT};
use crate::alloc::{filled, product};
use crate::array::Array;
use crate::error::{Error, Result, bail, ensure, show_shape};
use crate::gram::Gram;
use crate::ops::check_interrupted;

/// The largest magnitude of a weight.
const MOST: f32 = 7.0;

/// Rows of weights that one task rounds, and columns that are rounded before their errors go on to the others: always
/// the same, so that bits do not depend on the threads.
const ROWS: usize = 64;
const COLUMNS: usize = 128;

/// Rounded weights of a linear layer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rounded {
    /// Whole numbers from -7 to 7, `(out_features, in_features)`.
    pub values: Vec<i8>,
    /// What they change.
    pub errors: RoundingErrors,
}

/// How much rounded weights change the outputs of a linear layer, summed over rows and outputs. Each counts a hundredth of
/// the squares of the inputs for themselves, as [`gptq`] does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RoundingErrors {
    /// The squared error if each weight is rounded for itself.
    pub plain: f64,
    /// The squared error of the weights as they were rounded.
    pub rounded: f64,
    /// The squares of the outputs.
    pub outputs: f64,
}

impl RoundingErrors {
    fn add(&mut self, other: Self) {
        self.plain += other.plain;
        self.rounded += other.rounded;
        self.outputs += other.outputs;
    }
}

/// Rounds `weight (out_features, in_features)` to multiples of `scales (out_features)` so that the outputs of the layer
/// change little for inputs as in `gram`, on up to `threads` threads, with the same bits on any number of them.
///
/// Inputs are treated in the order of their squares, the largest first. Each weight is rounded to the nearest of 15
/// steps, and its error is passed on to those that follow, by the Cholesky factor of the Gram matrix (Frantar et al.
/// 2023, "GPTQ: Accurate Post-Training Quantization for Generative Pre-trained Transformers", in the form of Chee et
/// al. 2023, "QuIP: 2-Bit Quantization of Large Language Models With Guarantees", which needs no inverse; equation 55
/// of docs/equations.md). A hundredth of each input's square is added to it, which makes any Gram matrix regular. A
/// weight whose input was always zero keeps its nearest step, and so does a row of weights whose error is less so.
///
/// ```
/// use saccade_vla::{Array, Gram, gptq};
/// let mut gram = Gram::new(2)?;
/// gram.add(Array::new(&[1.0, 1.0, -1.0, -1.0], &[2, 2])?, 1)?; // both inputs are the same
/// let rounded = gptq(Array::new(&[1.4, 2.4], &[1, 2])?, &[1.0], &gram, 1)?;
/// assert_eq!(rounded.values, [1, 3]); // their sum is what counts
/// assert!(rounded.errors.rounded < rounded.errors.plain);
/// # Ok::<(), saccade_vla::Error>(())
/// ```
///
/// # Errors
/// [`Error::Shape`]; [`Error::Input`] for weights that are not finite, for scales that are negative or not finite, for
/// a scale of zero whose row is not zero, and for sums that overflow; [`Error::Memory`], [`Error::Interrupted`].
pub fn gptq(weight: Array<'_>, scales: &[f32], gram: &Gram, threads: usize) -> Result<Rounded> {
    let [out_features, in_features] = *weight.shape() else {
        let shape = show_shape(weight.shape());
        bail!(Shape, "weight"; expected "two axes, (out_features, in_features)"; got "{shape}");
    };
    let width = gram.width();
    ensure!(
        in_features == width, Shape, "weight";
        expected "(out_features, in_features) = ({out_features}, {width})"; got "({out_features}, {in_features})"
    );
    ensure!(
        scales.len() == out_features, Shape, "scales";
        expected "one for each of {out_features} rows"; got "{}", scales.len()
    );
    let weight = weight.check_finite("weight")?.data();
    check_scales(weight, scales, in_features)?;
    gram.check_finite("gram")?;
    let factor = Factor::new(gram, threads)?;

    let mut values = filled(WHAT, product(WHAT, &[out_features, in_features])?, 0_i8)?;
    let tasks: Vec<_> = values
        .chunks_mut(ROWS * in_features)
        .zip(weight.chunks(ROWS * in_features))
        .zip(scales.chunks(ROWS))
        .map(|((values, weight), scales)| Mutex::new((values, weight, scales, Ok(RoundingErrors::default()))))
        .collect();
    parallel_for(threads, tasks.len(), &|task| {
        let mut task = tasks[task].try_lock().expect("each is one task");
        let (values, weight, scales, errors) = &mut *task;
        *errors = round(&factor, weight, scales, values);
    });
    check_interrupted()?;
    let mut errors = RoundingErrors::default();
    for task in tasks {
        let (.., of_task) = task.into_inner().expect("a task that panics ends the call");
        errors.add(of_task?);
    }
    ensure!(
        (errors.plain + errors.rounded + errors.outputs).is_finite(), Input, "weight";
        "outputs of the layer are too large: their squares overflow float64"
    );
    Ok(Rounded { values, errors })
}

fn check_scales(weight: &[f32], scales: &[f32], in_features: usize) -> Result<()> {
    for (row, (&scale, weight)) in scales.iter().zip(weight.chunks_exact(in_features)).enumerate() {
        ensure!(
            scale >= 0.0 && (MOST * scale).is_finite(), Input, "scales";
            expected "finite scales that are not negative"; got "{scale} at index {row}"
        );
        ensure!(
            scale > 0.0 || weight.iter().all(|value| value.abs() < MOST * f32::MIN_POSITIVE), Input, "scales";
            expected "a scale above 0 for a row that is not zero"; got "0 at index {row}"
        );
    }
    Ok(())
}

/// Rounds a few rows of weights.
fn round(factor: &Factor, weight: &[f32], scales: &[f32], values: &mut [i8]) -> Result<RoundingErrors> {
    let width = factor.order.len();
    let mut sorted = filled(WHAT, weight.len(), 0.0_f64)?;
    for (sorted, weight) in sorted.chunks_exact_mut(width).zip(weight.chunks_exact(width)) {
        sorted
            .iter_mut()
            .zip(&factor.order)
            .for_each(|(sorted, &input)| *sorted = f64::from(weight[input]));
    }
    let mut pass = Pass::new(factor, &sorted, scales)?;
    let outputs = pass.run(|_, _| 0.0)?;
    let plain = pass.run(|weight, _| weight)?;
    let plain_steps = pass.steps.clone();
    let fed = pass.run(|_, target| target)?;
    let mut errors = RoundingErrors::default();
    for (row, values) in values.chunks_exact_mut(width).enumerate() {
        let is_better = fed[row] < plain[row];
        let steps = if is_better { &pass.steps } else { &plain_steps };
        for (&step, &input) in steps[row * width..][..width].iter().zip(&factor.order) {
            values[input] = step;
        }
        errors.plain += plain[row];
        errors.rounded += if is_better { fed[row] } else { plain[row] };
        errors.outputs += outputs[row];
    }
    Ok(errors)
}

/// One pass over a few rows of weights, whose inputs are in the order of the factor.
struct Pass<'a> {
    factor: &'a Factor,
    weight: &'a [f64],
    scales: &'a [f32],
    /// What weights were rounded to.
    steps: Vec<i8>,
    /// Weights less what they were rounded to.
    errors: Vec<f64>,
    /// The columns that are rounded now, with what is passed on to them.
    targets: Vec<f64>,
}

impl<'a> Pass<'a> {
    fn new(factor: &'a Factor, weight: &'a [f64], scales: &'a [f32]) -> Result<Self> {
        Ok(Self {
            factor,
            weight,
            scales,
            steps: filled(WHAT, weight.len(), 0)?,
            errors: filled(WHAT, weight.len(), 0.0)?,
            targets: filled(WHAT, scales.len() * COLUMNS.min(factor.order.len()), 0.0)?,
        })
    }

    /// Rounds what `choose(weight, target)` says, where the target is the weight with the errors of the inputs before it.
    /// Returns the squared error of each output.
    fn run(&mut self, choose: impl Fn(f64, f64) -> f64) -> Result<Vec<f64>> {
        let (rows, width) = (self.scales.len(), self.factor.order.len());
        let mut squared = filled(WHAT, rows, 0.0)?;
        for start in (0..width).step_by(COLUMNS).rev() {
            check_interrupted()?;
            let end = width.min(start + COLUMNS);
            let columns = end - start;
            let unit = MatRef::from_row_major_slice(&self.factor.unit, width, width);
            let errors = MatRef::from_row_major_slice(&self.errors, rows, width);
            let targets = &mut self.targets[..rows * columns];
            for (targets, weight) in targets
                .chunks_exact_mut(columns)
                .zip(self.weight.chunks_exact(width))
            {
                targets.copy_from_slice(&weight[start..end]);
            }
            matmul(
                MatMut::from_row_major_slice_mut(targets, rows, columns),
                Accum::Add,
                errors.subcols(end, width - end),
                unit.submatrix(end, start, width - end, columns),
                1.0,
                Par::Seq,
            );
            for column in (start..end).rev() {
                let passed_on = &self.factor.unit[column * width + start..column * width + column];
                for (row, targets) in targets.chunks_exact_mut(columns).enumerate() {
                    let place = row * width + column;
                    let (weight, target, scale) =
                        (self.weight[place], targets[column - start], self.scales[row]);
                    let step = nearest(choose(weight, target), scale);
                    let rounded = f64::from(step) * f64::from(scale);
                    squared[row] += self.factor.squares[column] * (target - rounded).powi(2);
                    self.steps[place] = step as i8;
                    let error = weight - rounded;
                    self.errors[place] = error;
                    let before = targets.iter_mut().zip(passed_on);
                    before.for_each(|(target, part)| *target += error * part);
                }
            }
        }
        Ok(squared)
    }
}

/// The nearest step, as plain rounding finds it.
fn nearest(value: f64, scale: f32) -> f32 {
    let steps = (value as f32 / scale).round_ties_even().clamp(-MOST, MOST);
    if scale > 0.0 { steps } else { 0.0 }
}
