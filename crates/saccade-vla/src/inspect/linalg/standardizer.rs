//! Centring and standardising.

use super::matrix::{Centre, MATRIX, Matrix, check_columns};
use crate::alloc::{collected, filled};
use crate::array::{Array, OwnedArray};
use crate::error::Result;

/// Subtracts the mean of each column, and divides by its standard deviation: `(x - mean) / scale`.
///
/// The deviation is that of all rows (divisor: the number of rows). A column that varies by rounding alone is
/// centred and not scaled.
///
/// ```
/// use saccade_vla::{Array, linalg::Standardizer};
///
/// let rows = [1.0, 5.0, 3.0, 5.0];
/// let rows = Array::new(&rows, &[2, 2])?;
/// let scaler = Standardizer::fit(rows)?;
/// assert_eq!((scaler.mean(), scaler.scale()), (&[2.0, 5.0][..], &[1.0, 1.0][..]));
/// assert_eq!(scaler.transform(rows)?.data(), [-1.0, 0.0, 1.0, 0.0]);
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Standardizer {
    mean: Vec<f64>,
    scale: Vec<f64>,
}

impl Standardizer {
    /// Takes mean and deviation of `x (rows, features)`.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape), [`Error::Input`](crate::Error::Input) if `x` is empty, or has
    /// other axes or values that are not finite or too large; [`Error::Memory`](crate::Error::Memory).
    pub fn fit(x: Array<'_, f64>) -> Result<Self> {
        let Centre { mean, deviation } = Matrix::checked("x", "(rows, features)", x)?.centre()?;
        let scale = deviation
            .iter()
            .map(|&scale| if scale == 0.0 { 1.0 } else { scale });
        let scale = collected(MATRIX, mean.len(), scale)?;
        Ok(Self { mean, scale })
    }

    /// Takes the mean of `x (rows, features)` alone: the scale of each column is 1.
    ///
    /// # Errors
    /// As [`fit`](Self::fit).
    pub fn centring(x: Array<'_, f64>) -> Result<Self> {
        let mean = Matrix::checked("x", "(rows, features)", x)?.column_means()?;
        let scale = filled(MATRIX, mean.len(), 1.0)?;
        Ok(Self { mean, scale })
    }

    /// The mean of each column, `(features)`.
    #[must_use]
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// What each column is divided by, `(features)`.
    #[must_use]
    pub fn scale(&self) -> &[f64] {
        &self.scale
    }

    /// `(x - mean) / scale` of `x (rows, features)`, with the same shape.
    ///
    /// # Errors
    /// As [`fit`](Self::fit), and if the number of features differs from that of the fit.
    pub fn transform(&self, x: Array<'_, f64>) -> Result<OwnedArray<f64>> {
        let mut x = Matrix::checked("x", "(rows, features)", x)?;
        check_columns(&x, self.mean.len())?;
        x.subtract(&self.mean);
        for row in x.each_row_mut() {
            for (value, scale) in row.iter_mut().zip(&self.scale) {
                *value /= scale;
            }
        }
        x.into_array("x")
    }
}
