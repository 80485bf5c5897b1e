//! The Cholesky factor of a Gram matrix, in the order in which columns of weights are rounded.
//!
//! Equation 55 of docs/equations.md.

use std::sync::Mutex;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{LltError, cholesky_in_place, cholesky_in_place_scratch};
use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Accum, MatMut, MatRef, Par, Spec};
use saccade_vla_kernels::parallel_for;

use crate::alloc::{collected, filled, product};
use crate::error::{Error, Result, problem};
use crate::gram::Gram;
use crate::ops::check_interrupted;

/// What memory is asked for.
pub(super) const WHAT: &str = "calibration";

/// Rows and columns of a block of the factorisation.
const BLOCK: usize = 256;

/// What is added to the diagonal, as a part of it. Of each input's own square and not of the mean: a channel that is
/// a hundred times as large as the others would drown them. Error of down projections with such channels, relative to
/// their outputs: 0.04, and 0.17 with a hundredth of the mean.
const DAMPING: f64 = 0.01;

/// An input whose square is below the normal numbers counts as one that was always zero: its products with others have
/// lost their digits. Its weights are rounded for themselves, and their errors are none.
const SMALLEST: f64 = f32::MIN_POSITIVE as f64;

/// `G = (M D^1/2) (M D^1/2)^T` of a damped Gram matrix `G` whose inputs are sorted, those of the smallest squares
/// first. Weights are rounded from the last input to the first.
pub(super) struct Factor {
    /// Which input each place is.
    pub order: Vec<usize>,
    /// `M`, lower triangular with a diagonal of ones, row after row.
    pub unit: Vec<f64>,
    /// The diagonal of `D`.
    pub squares: Vec<f64>,
}

impl Factor {
    /// Factorises it on up to `threads` threads, with the same bits on any number of them.
    ///
    /// # Errors
    /// [`Error::Input`] for a matrix that is not the sum of squares of rows, [`Error::Memory`],
    /// [`Error::Interrupted`].
    pub fn new(gram: &Gram, threads: usize) -> Result<Self> {
        let width = gram.width();
        let mut order = collected(WHAT, width, 0..width)?;
        // Inputs of equal squares from the last to the first: those without calibration in the order of the weights.
        order.sort_by(|&a, &b| gram.get(a, a).total_cmp(&gram.get(b, b)).then(b.cmp(&a)));
        let mut unit = filled(WHAT, product(WHAT, &[width, width])?, 0.0)?;
        for (row, &input) in order.iter().enumerate() {
            let row_of = &mut unit[row * width..][..=row];
            for (value, &other) in row_of.iter_mut().zip(&order) {
                *value = f64::from(gram.get(input, other));
            }
            row_of[row] = match row_of[row] {
                square if square < SMALLEST => 1.0,
                square => square * (1.0 + DAMPING),
            };
        }
        for start in (0..width).step_by(BLOCK) {
            check_interrupted()?;
            factor_block(&mut unit, width, start, threads)?;
        }
        check_interrupted()?;
        let mut squares = filled(WHAT, width, 0.0)?;
        let mut roots = filled(WHAT, width, 0.0)?;
        for (row, values) in unit.chunks_exact_mut(width).enumerate() {
            roots[row] = values[row];
            let is_zero = f64::from(gram.get(order[row], order[row])) < SMALLEST;
            squares[row] = if is_zero { 0.0 } else { values[row] * values[row] };
            values[..=row]
                .iter_mut()
                .zip(&roots)
                .for_each(|(value, root)| *value /= root);
        }
        Ok(Self { order, unit, squares })
    }
}

/// Columns `start ..` of the factor, for one block of them: everything to their left is done.
fn factor_block(data: &mut [f64], width: usize, start: usize, threads: usize) -> Result<()> {
    let end = width.min(start + BLOCK);
    let columns = end - start;
    let (above, below) = data.split_at_mut(end * width);
    let own = MatMut::from_row_major_slice_mut(&mut above[start * width..], columns, width);
    let (done, rest) = own.split_at_col_mut(start);
    let mut diagonal = rest.subcols_mut(0, columns);
    let done = done.as_ref();
    let minus = |from: MatMut<'_, f64>, left: MatRef<'_, f64>| {
        matmul(from, Accum::Add, left, done.transpose(), -1.0, Par::Seq);
    };
    minus(diagonal.as_mut(), done);
    let scratch = cholesky_in_place_scratch::<f64>(columns, Par::Seq, Spec::default());
    let mut memory = MemBuffer::try_new(scratch).map_err(|_| Error::Memory {
        what: WHAT,
        bytes: scratch.size_bytes(),
    })?;
    let stack = MemStack::new(&mut memory);
    cholesky_in_place(
        diagonal.as_mut(),
        Default::default(),
        Par::Seq,
        stack,
        Spec::default(),
    )
    .map_err(|LltError::NonPositivePivot { .. }| {
        Error::Input(problem!("gram"; "it is not positive definite: it is not the sum of squares of rows"))
    })?;
    let diagonal = diagonal.as_ref();
    let bands: Vec<_> = below.chunks_mut(BLOCK * width).map(Mutex::new).collect();
    parallel_for(threads, bands.len(), &|band| {
        let mut band = bands[band].try_lock().expect("each band is one task");
        let rows = band.len() / width;
        let (left, rest) = MatMut::from_row_major_slice_mut(&mut band, rows, width).split_at_col_mut(start);
        let mut own = rest.subcols_mut(0, columns);
        minus(own.as_mut(), left.as_ref());
        solve_lower_triangular_in_place(diagonal, own.transpose_mut(), Par::Seq);
    });
    check_interrupted()
}
