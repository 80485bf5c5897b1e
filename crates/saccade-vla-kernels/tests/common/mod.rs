//! What the tests of this folder share: numbers to compute with, and the error that rounding may cause.

#![allow(dead_code, reason = "each test file uses a part")]

pub mod attention;
pub mod linear;
pub mod random;

use saccade_vla_kernels::{Isa, Rows, RowsMut};

/// The instruction sets that this CPU has, and tiles in software: so what drives tiles is tested on every machine.
pub fn isas() -> Vec<Isa> {
    let mut isas = Isa::available();
    isas.push(Isa::SoftwareTiles);
    isas
}

/// Whether an emulator runs this, some fifty times slower than a CPU, as `.ci/aarch64/run.sh` says. The longest tests then compute fewer
/// cases, still on every instruction set.
pub fn is_emulated() -> bool {
    std::env::var_os("SACCADE_TEST_EMULATED").is_some()
}

/// Half a unit in the last place of 1.
pub const ROUNDING: f64 = 1.0 / (1u64 << 24) as f64;

/// How much `operations` roundings in a row may change a value, relative to the sum of magnitudes (Higham's gamma).
pub fn gamma(operations: usize) -> f64 {
    let total = operations as f64 * ROUNDING;
    total / (1.0 - total)
}

/// Reproducible uniform numbers in `[-scale, scale)`.
pub fn numbers(seed: u64, len: usize, scale: f32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        ((state >> 40) as f32 / (1u64 << 23) as f32 - 1.0) * scale
    };
    // The first ones of small seeds resemble each other.
    (0..8).for_each(|_| _ = next());
    (0..len).map(|_| next()).collect()
}

/// A matrix whose rows stand `gap` elements apart, with NaN between them: whoever reads there spreads it, whoever writes there removes it.
#[derive(Clone)]
pub struct Strided {
    data: Vec<f32>,
    pub rows: usize,
    pub columns: usize,
    stride: usize,
}

impl Strided {
    pub fn new(values: &[f32], rows: usize, columns: usize, gap: usize) -> Self {
        let stride = columns + gap;
        let mut data = vec![f32::NAN; rows * stride];
        for row in 0..rows {
            data[row * stride..][..columns].copy_from_slice(&values[row * columns..][..columns]);
        }
        Self {
            data,
            rows,
            columns,
            stride,
        }
    }

    pub fn view(&self) -> Rows<'_> {
        Rows::strided(&self.data, self.rows, self.columns, self.stride)
    }

    pub fn view_mut(&mut self) -> RowsMut<'_> {
        RowsMut::strided(&mut self.data, self.rows, self.columns, self.stride)
    }

    /// The values without the gaps. Panics if a gap was written to.
    pub fn values(&self) -> Vec<f32> {
        let mut values = Vec::with_capacity(self.rows * self.columns);
        for row in 0..self.rows {
            let (row, gap) = self.data[row * self.stride..][..self.stride].split_at(self.columns);
            values.extend_from_slice(row);
            assert!(
                gap.iter().all(|value| value.is_nan()),
                "something was written between the rows"
            );
        }
        values
    }
}

/// That every value is as near the exact one as its bound says.
pub fn assert_close(what: &str, given: &[f32], exact: &[f64], bounds: &[f64]) {
    assert_eq!(given.len(), exact.len());
    for (index, ((&given, &exact), &bound)) in given.iter().zip(exact).zip(bounds).enumerate() {
        let error = (f64::from(given) - exact).abs();
        assert!(
            error <= bound,
            "{what} {index}: {given} instead of {exact}, off by {error}, allowed {bound}"
        );
    }
}

pub fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

pub fn rows(values: &[f32], columns: usize) -> Rows<'_> {
    Rows::new(values, columns)
}

pub fn rows_mut(values: &mut [f32], columns: usize) -> RowsMut<'_> {
    RowsMut::new(values, columns)
}

/// `0.5 x (1 + tanh(u))`, without the difference of nearly equal numbers.
pub fn gelu_tanh(x: f64) -> f64 {
    let u = (2.0 / std::f64::consts::PI).sqrt() * (x + 0.044715 * x * x * x);
    x / (1.0 + (-2.0 * u).exp())
}

pub fn silu(x: f64) -> f64 {
    x / (1.0 + (-x).exp())
}

/// `x Phi(x)`, with `erfc` by its series for small arguments and its continued fraction for large ones.
pub fn gelu_erf(x: f64) -> f64 {
    let z = x.abs() / std::f64::consts::SQRT_2;
    let erfc = if z < 2.0 {
        let (mut term, mut sum) = (z, z);
        let mut n = 1.0;
        while term > 1e-17 * sum {
            term *= 2.0 * z * z / (2.0 * n + 1.0);
            sum += term;
            n += 1.0;
        }
        1.0 - std::f64::consts::FRAC_2_SQRT_PI * (-z * z).exp() * sum
    } else {
        let fraction = (1..60).rev().fold(z, |rest, n| z + f64::from(n) / 2.0 / rest);
        std::f64::consts::FRAC_2_SQRT_PI / 2.0 * (-z * z).exp() / fraction
    };
    x.max(0.0) - x.abs() * 0.5 * erfc
}
