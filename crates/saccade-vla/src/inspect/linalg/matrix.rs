//! Matrices of float64 over memory that may be refused, and the checks of every argument.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};

use crate::alloc::{collected, filled, product};
use crate::array::{Array, OwnedArray, unravel};
use crate::error::{Error, Result, bail, ensure, show_shape};

/// A matrix, row after row.
#[derive(Clone, Debug)]
pub(super) struct Matrix {
    data: Vec<f64>,
    rows: usize,
    columns: usize,
}

impl Matrix {
    pub(super) fn zeros(rows: usize, columns: usize) -> Result<Self> {
        let len = product(MATRIX, &[rows, columns])?;
        Ok(Self {
            data: filled(MATRIX, len, 0.0)?,
            rows,
            columns,
        })
    }

    /// An argument with two axes, at least one element and no NaN or infinity.
    pub(super) fn checked(name: &'static str, axes: &str, array: Array<'_, f64>) -> Result<Self> {
        let [rows, columns] = *array.shape() else {
            bail!(Shape, name; expected "two axes, {axes}"; got "{}", show_shape(array.shape()));
        };
        ensure!(
            rows > 0 && columns > 0, Shape, name;
            expected "{axes} of at least one element"; got "{}", show_shape(array.shape())
        );
        if let Some(position) = array.data().iter().position(|value| !value.is_finite()) {
            bail!(
                Input, name;
                expected "finite values";
                got "{} at index {}", array.data()[position], show_shape(&unravel(position, array.shape()))
            );
        }
        Ok(Self {
            data: collected(name, array.data().len(), array.data().iter().copied())?,
            rows,
            columns,
        })
    }

    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    pub(super) fn columns(&self) -> usize {
        self.columns
    }

    pub(super) fn data(&self) -> &[f64] {
        &self.data
    }

    pub(super) fn each_row(&self) -> impl Iterator<Item = &[f64]> {
        self.data.chunks_exact(self.columns)
    }

    pub(super) fn each_row_mut(&mut self) -> impl Iterator<Item = &mut [f64]> {
        self.data.chunks_exact_mut(self.columns)
    }

    pub(super) fn view(&self) -> MatRef<'_, f64> {
        MatRef::from_row_major_slice(&self.data, self.rows, self.columns)
    }

    pub(super) fn view_mut(&mut self) -> MatMut<'_, f64> {
        MatMut::from_row_major_slice_mut(&mut self.data, self.rows, self.columns)
    }

    /// The first rows alone.
    pub(super) fn truncated(mut self, rows: usize) -> Self {
        self.data.truncate(rows * self.columns);
        self.rows = rows;
        self
    }

    /// The mean of each column. A second pass adds what rounding left over.
    pub(super) fn column_means(&self) -> Result<Vec<f64>> {
        let count = self.rows as f64;
        let mut means = filled(MATRIX, self.columns, 0.0)?;
        for _ in 0..2 {
            let mut apart = filled(MATRIX, self.columns, 0.0)?;
            for row in self.each_row() {
                for ((apart, value), mean) in apart.iter_mut().zip(row).zip(&means) {
                    *apart += value - mean;
                }
            }
            for (mean, apart) in means.iter_mut().zip(apart) {
                *mean += apart / count;
            }
        }
        check_result("x", &means)?;
        Ok(means)
    }

    /// Subtracts the mean of each column, and makes columns zero that vary by rounding alone.
    pub(super) fn centre(&mut self) -> Result<Centre> {
        let mean = self.column_means()?;
        self.subtract(&mean);
        let deviation = self.column_deviations(&mean)?;
        for row in self.each_row_mut() {
            for (value, &deviation) in row.iter_mut().zip(&deviation) {
                if deviation == 0.0 {
                    *value = 0.0;
                }
            }
        }
        Ok(Centre { mean, deviation })
    }

    /// The standard deviation of each centred column over all rows; 0 where it is the rounding of `mean`.
    fn column_deviations(&self, mean: &[f64]) -> Result<Vec<f64>> {
        let count = self.rows as f64;
        let mut largest = filled(MATRIX, self.columns, 0.0_f64)?;
        for row in self.each_row() {
            for (largest, value) in largest.iter_mut().zip(row) {
                *largest = largest.max(value.abs());
            }
        }
        // Squares of shares of the largest: they neither overflow nor vanish.
        let mut variance = filled(MATRIX, self.columns, 0.0)?;
        for row in self.each_row() {
            for ((variance, value), &largest) in variance.iter_mut().zip(row).zip(&largest) {
                if largest > 0.0 {
                    *variance += (value / largest).powi(2) / count;
                }
            }
        }
        let mut deviation = variance;
        for ((deviation, largest), mean) in deviation.iter_mut().zip(largest).zip(mean) {
            *deviation = largest * deviation.sqrt();
            if *deviation <= count * mean.abs() * f64::EPSILON {
                *deviation = 0.0;
            }
        }
        check_result("x", &deviation)?;
        Ok(deviation)
    }

    /// Subtracts `mean` from every row.
    pub(super) fn subtract(&mut self, mean: &[f64]) {
        for row in self.each_row_mut() {
            for (value, mean) in row.iter_mut().zip(mean) {
                *value -= mean;
            }
        }
    }

    /// Subtracts a matrix of the same shape.
    pub(super) fn subtract_matrix(&mut self, other: &Self) {
        for (value, other) in self.data.iter_mut().zip(&other.data) {
            *value -= other;
        }
    }

    /// Multiplies by the power of two that makes the largest magnitude 1 to 2, so that no square overflows or
    /// vanishes. Returns the inverse of that power; a matrix of zeros stays as it is.
    pub(super) fn scale_by_power_of_two(&mut self) -> f64 {
        let largest = self
            .data
            .iter()
            .fold(0.0, |largest: f64, value| largest.max(value.abs()));
        if largest == 0.0 {
            return 1.0;
        }
        // The exponent of f64, within what has an inverse.
        let exponent = (largest.log2().floor() as i32).clamp(-1000, 1000);
        let factor = 2.0_f64.powi(-exponent);
        self.data.iter_mut().for_each(|value| *value *= factor);
        2.0_f64.powi(exponent)
    }

    /// The sum of squares.
    pub(super) fn squared_norm(&self) -> f64 {
        self.data.iter().map(|value| value * value).sum()
    }

    /// The array with this shape, if no result overflowed.
    pub(super) fn into_array(self, name: &'static str) -> Result<OwnedArray<f64>> {
        check_result(name, &self.data)?;
        OwnedArray::new(self.data, &[self.rows, self.columns])
    }
}

/// What `Matrix::centre` subtracted and found.
pub(super) struct Centre {
    pub mean: Vec<f64>,
    /// Standard deviation over all rows, 0 for a constant column.
    pub deviation: Vec<f64>,
}

/// What memory is asked for.
pub(super) const MATRIX: &str = "linear algebra";

/// `a b`.
pub(super) fn times(a: MatRef<'_, f64>, b: MatRef<'_, f64>) -> Result<Matrix> {
    let mut made = Matrix::zeros(a.nrows(), b.ncols())?;
    matmul(made.view_mut(), Accum::Replace, a, b, 1.0, Par::Seq);
    Ok(made)
}

/// That the columns of `x` are as many as something was fitted to.
pub(super) fn check_columns(x: &Matrix, fitted: usize) -> Result<()> {
    let (rows, columns) = (x.rows(), x.columns());
    ensure!(
        x.columns() == fitted, Shape, "x";
        expected "(rows, features) = ({rows}, {fitted})"; got "({rows}, {columns})"
    );
    Ok(())
}

/// That `y` has as many rows as `x`.
pub(super) fn check_rows(name: &str, axes: &str, x: &Matrix, y: &Matrix) -> Result<()> {
    let (rows, given, columns) = (x.rows(), y.rows(), y.columns());
    ensure!(
        x.rows() == y.rows(), Shape, name; expected "{axes} = ({rows}, {columns})"; got "({given}, {columns})"
    );
    Ok(())
}

/// That there are two rows, between which something can vary.
pub(super) fn check_two_rows(name: &str, x: &Matrix) -> Result<()> {
    ensure!(x.rows() >= 2, Shape, name; expected "at least 2 rows"; got "{}", x.rows());
    Ok(())
}

/// That no element of a result overflowed.
pub(super) fn check_result(name: &str, data: &[f64]) -> Result<()> {
    ensure!(
        data.iter().all(|value| value.is_finite()), Input, name;
        "the result is not finite: values are too large for float64"
    );
    Ok(())
}
