//! Ridge regression.

use faer::MatRef;

use super::matrix::{MATRIX, Matrix, check_columns, check_result, check_rows, times};
use super::svd::Svd;
use crate::alloc::{filled, product, reserved};
use crate::array::{Array, OwnedArray};
use crate::error::{Error, Result, bail, ensure};
use crate::ops::check_interrupted;

/// Ridge regression with an intercept, for several penalties at once.
///
/// For each penalty alpha the weights minimise `|y - x W - b|^2 + alpha |W|^2`; the intercept `b` is not
/// penalised. In columns without their means that is
///
/// `W = (X^T X + alpha I)^-1 X^T Y = X^T (X X^T + alpha I)^-1 Y = V diag(s / (s^2 + alpha)) U^T Y`
///
/// with `X = U diag(s) V^T` (Hoerl and Kennard, 1970; the second form is the dual one). One thin decomposition
/// serves all penalties, whether there are more rows or more features, and the condition of `X` is not
/// squared. With `alpha = 0` the weights are the least-squares solution of smallest norm: singular values
/// up to `max(rows, features) * 2^-52` times the largest count as zero.
///
/// ```
/// use saccade_vla::{Array, linalg::Ridge};
///
/// let (x, y) = ([0.0, 1.0, 2.0], [1.0, 3.0, 5.0]); // y = 2 x + 1
/// let (x, y) = (Array::new(&x, &[3, 1])?, Array::new(&y, &[3, 1])?);
/// let ridge = Ridge::fit(x, y, &[0.0, 2.0])?;
/// assert!((ridge.weights().data()[0] - 2.0).abs() < 1e-12);
/// assert!((ridge.intercepts().data()[0] - 1.0).abs() < 1e-12);
/// assert!((ridge.weights().data()[1] - 1.0).abs() < 1e-12); // 4 / (2 + alpha)
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Ridge {
    weights: OwnedArray<f64>,
    intercepts: OwnedArray<f64>,
}

impl Ridge {
    /// Fits `x (rows, features)` to `y (rows, targets)` with each of the penalties.
    ///
    /// # Errors
    /// [`Error::Shape`], [`Error::Input`] if an array is empty, has other axes or values that are not finite
    /// or too large, if the rows differ in number, or if there is no penalty or one that is negative or not
    /// finite; [`Error::Memory`].
    pub fn fit(x: Array<'_, f64>, y: Array<'_, f64>, alphas: &[f64]) -> Result<Self> {
        let mut x = Matrix::checked("x", "(rows, features)", x)?;
        let mut y = Matrix::checked("y", "(rows, targets)", y)?;
        check_rows("y", "(rows, targets)", &x, &y)?;
        check_penalties(alphas)?;
        let (features, targets) = (x.columns(), y.columns());
        let mean = x.centre()?.mean;
        let offset = y.column_means()?;
        y.subtract(&offset);
        let svd = Svd::new(x)?;
        let projected = times(svd.left.view(), y.view())?; // U^T Y: (singular values, targets)

        let len = product(MATRIX, &[alphas.len(), features, targets])?;
        let mut weights = filled(MATRIX, len, 0.0)?;
        let mut intercepts = filled(MATRIX, alphas.len() * targets, 0.0)?;
        let places = weights
            .chunks_exact_mut(features * targets)
            .zip(intercepts.chunks_exact_mut(targets));
        for (&alpha, (weights, intercept)) in alphas.iter().zip(places) {
            check_interrupted()?;
            let mut shrunk = projected.clone();
            for (row, &singular) in shrunk.each_row_mut().zip(&svd.singular) {
                let factor = shrinkage(singular, alpha, svd.rounding);
                row.iter_mut().for_each(|value| *value *= factor);
            }
            let of_alpha = times(svd.right.view().transpose(), shrunk.view())?; // (features, targets)
            weights.copy_from_slice(of_alpha.data());
            intercept.copy_from_slice(&offset);
            for (row, mean) in of_alpha.each_row().zip(&mean) {
                for (intercept, weight) in intercept.iter_mut().zip(row) {
                    *intercept -= mean * weight;
                }
            }
        }
        check_result("weights", &weights)?;
        check_result("intercepts", &intercepts)?;
        Ok(Self {
            weights: OwnedArray::new(weights, &[alphas.len(), features, targets])?,
            intercepts: OwnedArray::new(intercepts, &[alphas.len(), targets])?,
        })
    }

    /// The weights, `(penalties, features, targets)`.
    #[must_use]
    pub fn weights(&self) -> Array<'_, f64> {
        self.weights.view()
    }

    /// The intercepts, `(penalties, targets)`.
    #[must_use]
    pub fn intercepts(&self) -> Array<'_, f64> {
        self.intercepts.view()
    }

    /// `x W + b` of `x (rows, features)` for each penalty: `(penalties, rows, targets)`.
    ///
    /// # Errors
    /// [`Error::Shape`], [`Error::Input`] if `x` is empty, has other features than the fit, or values that are
    /// not finite or too large; [`Error::Memory`].
    pub fn predict(&self, x: Array<'_, f64>) -> Result<OwnedArray<f64>> {
        let x = Matrix::checked("x", "(rows, features)", x)?;
        let [penalties, features, targets] = *self.weights.shape() else {
            unreachable!("three axes")
        };
        check_columns(&x, features)?;
        let len = product(MATRIX, &[penalties, x.rows(), targets])?;
        let mut predicted = reserved(MATRIX, len)?;
        let each = self.weights.data().chunks_exact(features * targets);
        for (weights, intercept) in each.zip(self.intercepts.data().chunks_exact(targets)) {
            let weights = MatRef::from_row_major_slice(weights, features, targets);
            let mut of_alpha = times(x.view(), weights)?;
            for row in of_alpha.each_row_mut() {
                row.iter_mut()
                    .zip(intercept)
                    .for_each(|(value, intercept)| *value += intercept);
            }
            predicted.extend_from_slice(of_alpha.data());
        }
        check_result("x", &predicted)?;
        OwnedArray::new(predicted, &[penalties, x.rows(), targets])
    }
}

/// `s / (s^2 + alpha)`, written so that `s^2` cannot overflow.
fn shrinkage(singular: f64, alpha: f64, rounding: f64) -> f64 {
    if singular == 0.0 || (alpha == 0.0 && singular <= rounding) {
        return 0.0;
    }
    1.0 / (singular + alpha / singular)
}

fn check_penalties(alphas: &[f64]) -> Result<()> {
    ensure!(!alphas.is_empty(), Input, "alphas"; expected "at least one penalty"; got "none");
    match alphas.iter().find(|alpha| !(alpha.is_finite() && **alpha >= 0.0)) {
        None => Ok(()),
        Some(alpha) => bail!(Input, "alphas"; expected "finite penalties of at least 0"; got "{alpha}"),
    }
}
