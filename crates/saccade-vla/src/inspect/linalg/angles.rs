//! Principal angles between subspaces.

use super::matrix::{MATRIX, Matrix, check_rows, times};
use super::svd::Svd;
use crate::alloc::collected;
use crate::array::Array;
use crate::error::{Error, Result, bail};

/// The principal angles between the spans of the columns of two matrices, ascending, in radians, 0 to pi/2.
///
/// With orthonormal bases `A` and `B` of the spans, the cosines of the angles are the singular values of
/// `A^T B`, and their sines those of `B - A A^T B` (Bjorck and Golub 1973, "Numerical Methods for Computing
/// Angles Between Linear Subspaces"). Angles below 45 degrees are taken from the sines, the others from the
/// cosines, so that both small and large ones are exact to rounding.
///
/// `a` is `(dimensions, vectors)`, `b` is `(dimensions, vectors of b)`. Dependent columns count once: there are
/// as many angles as the smaller rank, by the singular values that exceed `max(dimensions, vectors) * 2^-52`
/// times the largest.
///
/// ```
/// use saccade_vla::{Array, linalg::principal_angles};
///
/// let (a, b) = ([1.0, 0.0, 0.0], [1.0, 1.0, 0.0]);
/// let angles = principal_angles(Array::new(&a, &[3, 1])?, Array::new(&b, &[3, 1])?)?;
/// assert!((angles[0] - std::f64::consts::FRAC_PI_4).abs() < 1e-15);
/// # Ok::<(), saccade_vla::Error>(())
/// ```
///
/// # Errors
/// [`Error::Shape`], [`Error::Input`] if an array is empty, zero, has other axes or values that are not
/// finite, or if the dimensions differ; [`Error::Memory`].
pub fn principal_angles(a: Array<'_, f64>, b: Array<'_, f64>) -> Result<Vec<f64>> {
    let a = Matrix::checked("a", AXES, a)?;
    let b = Matrix::checked("b", AXES, b)?;
    check_rows("b", AXES, &a, &b)?;
    let (a, b) = (orthonormal("a", a)?, orthonormal("b", b)?);
    let (wide, narrow) = if a.rows() >= b.rows() { (a, b) } else { (b, a) };
    let shared = times(narrow.view(), wide.view().transpose())?; // (narrow, wide)
    let inside = times(shared.view(), wide.view())?;
    let mut outside = narrow;
    outside.subtract_matrix(&inside);
    let cosines = Svd::new(shared)?.singular; // descending: ascending angles
    let sines = Svd::new(outside)?.singular;
    let angles = cosines.iter().zip(sines.iter().rev()).map(|(&cosine, &sine)| {
        if cosine * cosine >= 0.5 {
            sine.min(1.0).asin()
        } else {
            cosine.acos()
        }
    });
    collected(MATRIX, cosines.len(), angles)
}

const AXES: &str = "(dimensions, vectors)";

/// An orthonormal basis of the span of the columns, one vector a row.
fn orthonormal(name: &'static str, x: Matrix) -> Result<Matrix> {
    let svd = Svd::new(x)?;
    match svd.rank() {
        0 => bail!(Input, name; expected "a column that is not zero"; got "zeros only"),
        rank => Ok(svd.left.truncated(rank)),
    }
}
