//! Linear centred kernel alignment.

use super::matrix::{Matrix, check_rows, check_two_rows, times};
use crate::array::Array;
use crate::error::{Error, Result, ensure};

/// Linear centred kernel alignment (CKA) of two sets of features of the same observations, 0 to 1.
///
/// `|Y^T X|^2 / (|X^T X| |Y^T Y|)` in columns without their means, with Frobenius norms (Kornblith et al.
/// 2019, "Similarity of Neural Network Representations Revisited", section 3). It is 1 if the features are the
/// same up to rotation, reflection, a common factor and an offset, and does not change with these. With more
/// features than rows the same number is computed from products of rows:
/// `<X X^T, Y Y^T> / (|X X^T| |Y Y^T|)`.
///
/// `x` is `(rows, features)`, `y` is `(rows, features of y)`.
///
/// ```
/// use saccade_vla::{Array, linalg::linear_cka};
///
/// let x = [1.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, -1.0];
/// let turned = [0.0, 3.0, -3.0, 0.0, 0.0, -3.0, 3.0, 0.0];
/// let cka = linear_cka(Array::new(&x, &[4, 2])?, Array::new(&turned, &[4, 2])?)?;
/// assert!((cka - 1.0).abs() < 1e-12);
/// # Ok::<(), saccade_vla::Error>(())
/// ```
///
/// # Errors
/// [`Error::Shape`], [`Error::Input`] if an array has fewer than two rows, other axes, or values that are not
/// finite or too large, if the rows differ in number, or if no feature varies: the alignment is then not
/// defined. [`Error::Memory`].
pub fn linear_cka(x: Array<'_, f64>, y: Array<'_, f64>) -> Result<f64> {
    let x = Matrix::checked("x", "(rows, features)", x)?;
    let y = Matrix::checked("y", "(rows, features)", y)?;
    check_two_rows("x", &x)?;
    check_rows("y", "(rows, features)", &x, &y)?;
    let (x, y) = (varying("x", x)?, varying("y", y)?);
    let (rows, wide, other) = (x.rows() as f64, x.columns() as f64, y.columns() as f64);
    let by_features = wide * wide + other * other + wide * other <= rows * (wide + other);
    let (shared, own, others) = if by_features {
        let gram = |a: &Matrix, b: &Matrix| times(a.view().transpose(), b.view());
        (gram(&y, &x)?.squared_norm(), gram(&x, &x)?, gram(&y, &y)?)
    } else {
        let own = times(x.view(), x.view().transpose())?;
        let others = times(y.view(), y.view().transpose())?;
        let shared = own.data().iter().zip(others.data()).map(|(a, b)| a * b).sum();
        (shared, own, others)
    };
    // One root of the product: exactly 1 if both are the same.
    Ok((shared / (own.squared_norm() * others.squared_norm()).sqrt()).clamp(0.0, 1.0))
}

/// `x` without the means of its columns, scaled so that products neither overflow nor vanish.
fn varying(name: &'static str, mut x: Matrix) -> Result<Matrix> {
    x.centre()?;
    x.scale_by_power_of_two();
    ensure!(
        !x.data().iter().all(|&value| value == 0.0), Input, name;
        expected "a feature that varies between rows"; got "constant columns only"
    );
    Ok(x)
}
