//! Principal components.

use super::matrix::{MATRIX, Matrix, check_columns, check_result, check_two_rows, times};
use super::svd::Svd;
use crate::alloc::collected;
use crate::array::{Array, OwnedArray};
use crate::error::{Error, Result, ensure};

/// Principal components: the orthonormal directions along which rows vary most.
///
/// With the singular value decomposition `x - mean = U S V^T` the components are the first rows of `V^T`; the
/// variance along one of them is `s^2 / (rows - 1)`. A component's sign is free: here the entry of largest
/// magnitude is positive, the first of equal ones, as in scikit-learn since 1.5. Components without variance
/// are orthonormal too, and otherwise arbitrary.
///
/// ```
/// use saccade_vla::{Array, linalg::Pca};
///
/// let rows = [0.0, 0.0, 1.0, 2.0, 2.0, 4.0]; // on a line
/// let rows = Array::new(&rows, &[3, 2])?;
/// let pca = Pca::fit(rows, 1)?;
/// let [a, b] = *pca.components().data() else { unreachable!() };
/// assert!((b / a - 2.0).abs() < 1e-12 && b > 0.0);
/// assert!((pca.explained_variance()[0] - pca.total_variance()).abs() < 1e-12);
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Pca {
    mean: Vec<f64>,
    components: OwnedArray<f64>,
    explained_variance: Vec<f64>,
    total_variance: f64,
}

impl Pca {
    /// Finds the first `components` principal components of `x (rows, features)`.
    ///
    /// # Errors
    /// [`Error::Shape`], [`Error::Input`] if `x` has fewer than two rows, other axes, or values that are not
    /// finite or too large, or if `components` is 0 or more than rows or features; [`Error::Memory`].
    pub fn fit(x: Array<'_, f64>, components: usize) -> Result<Self> {
        let mut x = Matrix::checked("x", "(rows, features)", x)?;
        check_two_rows("x", &x)?;
        let most = x.rows().min(x.columns());
        ensure!(
            (1..=most).contains(&components), Input, "components";
            expected "1 to {most} for x of shape ({}, {})", x.rows(), x.columns(); got "{components}"
        );
        let mean = x.centre()?.mean;
        let divisor = (x.rows() - 1) as f64;
        let Svd { singular, right, .. } = Svd::new(x)?;
        let mut right = right.truncated(components);
        right.each_row_mut().for_each(orient);
        let mut explained_variance = collected(
            MATRIX,
            singular.len(),
            singular.iter().map(|value| value * value / divisor),
        )?;
        let total_variance = explained_variance.iter().sum();
        check_result("explained_variance", &[total_variance])?;
        explained_variance.truncate(components);
        Ok(Self {
            mean,
            components: right.into_array("components")?,
            explained_variance,
            total_variance,
        })
    }

    /// The mean of each column, `(features)`.
    #[must_use]
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// The components, `(components, features)`, that with the most variance first.
    #[must_use]
    pub fn components(&self) -> Array<'_, f64> {
        self.components.view()
    }

    /// The variance along each component, `(components)`.
    #[must_use]
    pub fn explained_variance(&self) -> &[f64] {
        &self.explained_variance
    }

    /// The sum of the variances of all columns.
    #[must_use]
    pub fn total_variance(&self) -> f64 {
        self.total_variance
    }

    /// The coordinates of `x (rows, features)` along the components, `(x - mean) V`: `(rows, components)`.
    ///
    /// # Errors
    /// [`Error::Shape`], [`Error::Input`] if `x` is empty, has other features than the fit, or values that are
    /// not finite or too large; [`Error::Memory`].
    pub fn transform(&self, x: Array<'_, f64>) -> Result<OwnedArray<f64>> {
        let mut x = Matrix::checked("x", "(rows, features)", x)?;
        check_columns(&x, self.mean.len())?;
        x.subtract(&self.mean);
        let components = Matrix::checked("components", "(components, features)", self.components())?;
        times(x.view(), components.view().transpose())?.into_array("x")
    }
}

/// Makes the entry of largest magnitude positive.
fn orient(component: &mut [f64]) {
    let mut largest = 0.0_f64;
    for &value in component.iter() {
        if value.abs() > largest.abs() {
            largest = value;
        }
    }
    if largest < 0.0 {
        component.iter_mut().for_each(|value| *value = -*value);
    }
}
