//! What an adapter adds to one weight: the product of two narrow matrices, a row at a time.

use saccade_vla_checkpoint::{Checkpoint, Elements, reserve};

use crate::alloc::filled;
use crate::error::{Error, Result, bail};

/// The names of a product's factors in the adapter's file, and how they are multiplied.
pub(super) struct Factors {
    /// `(rank, columns)`; of an embedding `(rank, rows)`.
    pub a: String,
    /// `(rows, rank)`; of an embedding `(columns, rank)`.
    pub b: String,
    pub is_embedding: bool,
    pub rows: usize,
    pub columns: usize,
    pub rank: usize,
    pub scaling: f32,
}

/// `scaling * B A`, computed as it is asked for.
pub(crate) struct Delta {
    /// `(rank, columns)`.
    a: Vec<f32>,
    /// `(rows, rank)`.
    b: Vec<f32>,
    columns: usize,
    scaling: f32,
    /// The products of one row.
    sums: Vec<f32>,
    row: Option<usize>,
}

impl Delta {
    /// Reads the factors.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if one of their numbers is not finite, [`Error::File`] if they cannot be read.
    pub(super) fn read(checkpoint: &Checkpoint, factors: &Factors) -> Result<Self> {
        let (mut a, mut b) = (finite(checkpoint, &factors.a)?, finite(checkpoint, &factors.b)?);
        if factors.is_embedding {
            (a, b) = (
                transposed(&b, factors.columns, factors.rank)?,
                transposed(&a, factors.rank, factors.rows)?,
            );
        }
        Ok(Self {
            a,
            b,
            columns: factors.columns,
            scaling: factors.scaling,
            sums: filled("adapter", factors.columns, 0.0)?,
            row: None,
        })
    }

    /// Adds the elements from number `first` on to `values`.
    pub(crate) fn add(&mut self, first: usize, values: &mut [f32]) {
        let mut done = 0;
        while done < values.len() {
            let (row, column) = ((first + done) / self.columns, (first + done) % self.columns);
            self.compute(row);
            let count = (self.columns - column).min(values.len() - done);
            let sums = &self.sums[column..column + count];
            for (value, sum) in values[done..done + count].iter_mut().zip(sums) {
                *value += sum * self.scaling;
            }
            done += count;
        }
    }

    fn compute(&mut self, row: usize) {
        if self.row == Some(row) {
            return;
        }
        self.row = Some(row);
        self.sums.fill(0.0);
        let rank = self.a.len() / self.columns;
        let factors = &self.b[row * rank..(row + 1) * rank];
        for (factor, a) in factors.iter().zip(self.a.chunks_exact(self.columns)) {
            let factor = f64::from(*factor);
            for (sum, a) in self.sums.iter_mut().zip(a) {
                // A fused multiply-add, one rank after the other, as torch's product on a CPU: in float64 this product is exact.
                *sum = (f64::from(*sum) + factor * f64::from(*a)) as f32;
            }
        }
    }
}

fn finite(checkpoint: &Checkpoint, name: &str) -> Result<Vec<f32>> {
    let values = checkpoint.read(name).map(Elements::into_f32)??;
    match values.iter().find(|value| !value.is_finite()) {
        None => Ok(values),
        Some(bad) => bail!(Checkpoint, "adapter"; "{name} holds {bad}, expected finite numbers"),
    }
}

/// The matrix `values (rows, columns)` with its axes exchanged.
fn transposed(values: &[f32], rows: usize, columns: usize) -> Result<Vec<f32>> {
    let mut turned = Vec::new();
    reserve("adapter", &mut turned, values.len())?;
    turned.extend((0..columns).flat_map(|column| (0..rows).map(move |row| values[row * columns + column])));
    Ok(turned)
}
