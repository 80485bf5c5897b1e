//! Attention in float64, with what rounding may change, and the kernel's ways to compute it.

use std::fmt;

use saccade_vla_kernels::{Element, Isa, Mask, PackedKeyValues, attention};

use super::{ROUNDING, Strided, isas, numbers};

/// The bias that removes a key.
pub const REMOVED: f32 = f32::NEG_INFINITY;

/// Half a unit in the last place of 1 in bfloat16.
pub const BF16_ROUNDING: f64 = 1.0 / 256.0;

/// A way to compute.
#[derive(Clone, Copy)]
pub struct Kind {
    pub isa: Isa,
    pub element: Element,
}

impl fmt::Display for Kind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}, {:?}", self.isa, self.element)
    }
}

/// What keys and values are stored in.
pub const ELEMENTS: [Element; 2] = [Element::F32, Element::Bf16];

/// All that this CPU has.
pub fn kinds() -> impl Iterator<Item = Kind> {
    ELEMENTS.into_iter().flat_map(kinds_of)
}

/// All of one element: what they have to agree with in float64 is computed once for them.
pub fn kinds_of(element: Element) -> impl Iterator<Item = Kind> {
    isas().into_iter().map(move |isa| Kind { isa, element })
}

pub fn best() -> Kind {
    Kind {
        isa: Isa::best(),
        element: Element::F32,
    }
}

pub struct Case {
    pub queries: Strided,
    pub keys: Strided,
    pub values: Strided,
    pub num_heads: usize,
    pub num_kv_heads: usize,
    pub head_dim: usize,
    pub scale: f32,
}

impl Case {
    pub fn new(
        seed: u64,
        queries: usize,
        keys: usize,
        num_heads: usize,
        head_dim: usize,
        gap: usize,
    ) -> Self {
        Self::grouped(seed, [queries, keys], [num_heads, num_heads], head_dim, gap)
    }

    /// With as many heads of keys and values as the second number of heads.
    pub fn grouped(
        seed: u64,
        [queries, keys]: [usize; 2],
        [num_heads, num_kv_heads]: [usize; 2],
        head_dim: usize,
        gap: usize,
    ) -> Self {
        let matrix = |seed, rows: usize, num_heads: usize| {
            let width = num_heads * head_dim;
            Strided::new(&numbers(seed, rows * width, 2.0), rows, width, gap)
        };
        let (queries, keys, values) = (
            matrix(seed, queries, num_heads),
            matrix(seed + 1, keys, num_kv_heads),
            matrix(seed + 2, keys, num_kv_heads),
        );
        Self {
            queries,
            keys,
            values,
            num_heads,
            num_kv_heads,
            head_dim,
            scale: 1.0 / (head_dim as f32).sqrt(),
        }
    }

    pub fn held(&self, kind: Kind) -> PackedKeyValues {
        let mut held = PackedKeyValues::new(kind.isa, kind.element, self.num_kv_heads, self.head_dim);
        held.pack(1, self.keys.view(), self.values.view()).unwrap();
        held
    }

    /// A bias, a mask, or neither.
    pub fn run<'a>(
        &self,
        kind: Kind,
        threads: usize,
        mask: impl Into<Mask<'a>>,
        weights: Option<&mut [f32]>,
    ) -> Vec<f32> {
        let blank = vec![f32::NAN; self.queries.rows * self.queries.columns];
        let mut out = Strided::new(&blank, self.queries.rows, self.queries.columns, 3);
        attention(
            threads,
            self.queries.view(),
            &self.held(kind),
            self.scale,
            mask.into(),
            weights,
            out.view_mut(),
        );
        out.values()
    }

    /// In float64, with what rounding may change: `(out, its bound, probabilities, their bounds)`.
    ///
    /// `Bf16` rounds the two factors of every product of a logit, the probabilities and the values. Logits are off by `d` at most, so that
    /// a probability before it is divided by their sum has a factor between `exp(-d)` and `exp(d)`, and after it at most `exp(2 d)`. What
    /// rounding does to the probabilities is in their sum too: a factor of at most `(1 + e) / (1 - e)`.
    pub fn exact(
        &self,
        element: Element,
        bias: impl Fn(usize, usize, usize) -> f32,
    ) -> (Vec<f64>, Vec<f64>, Vec<f64>, Vec<f64>) {
        // Of an element; of a probability, with its cheaper exponential.
        let (rounding, share_rounding) = match element {
            Element::F32 => (0.0, 0.0),
            _ => (BF16_ROUNDING, BF16_ROUNDING + 1.1e-4),
        };
        let share_factor = (1.0 + share_rounding) / (1.0 - share_rounding);
        let (queries, keys, values) = (self.queries.view(), self.keys.view(), self.values.view());
        let (mut out, mut bounds) = (
            vec![0.0; queries.num_rows() * queries.num_columns()],
            vec![0.0; queries.num_rows() * queries.num_columns()],
        );
        let (mut weights, mut weight_bounds) = (Vec::new(), Vec::new());
        for head in 0..self.num_heads {
            let columns = head * self.head_dim..(head + 1) * self.head_dim;
            // The columns of its keys and values.
            let shared = head / (self.num_heads / self.num_kv_heads) * self.head_dim;
            let shared = shared..shared + self.head_dim;
            for query in 0..queries.num_rows() {
                // The error of a logit is an error of its probability, as a factor.
                let mut logit_error: f64 = 0.0;
                let logits: Vec<f64> = (0..keys.num_rows())
                    .map(|key| {
                        let (mut sum, mut magnitude) = (0.0, 0.0);
                        for (&q, &k) in queries.row(query)[columns.clone()]
                            .iter()
                            .zip(&keys.row(key)[shared.clone()])
                        {
                            let product = f64::from(q) * f64::from(k) * f64::from(self.scale);
                            sum += product;
                            magnitude += product.abs();
                        }
                        let bias = f64::from(bias(head, query, key));
                        let logit = sum + bias;
                        if logit.is_finite() {
                            let rounded = (1.0 + rounding) * (1.0 + rounding) - 1.0;
                            let summed = (self.head_dim + 3) as f64 * ROUNDING * (magnitude + bias.abs());
                            logit_error = logit_error.max(rounded * magnitude + summed);
                        }
                        logit
                    })
                    .collect();
                let max = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let shares: Vec<f64> = logits
                    .iter()
                    .map(|logit| if max.is_finite() { (logit - max).exp() } else { 0.0 })
                    .collect();
                let sum: f64 = shares.iter().sum();
                // Twice the logits' error (own and in the sum), `exp`, sums over keys, and the division; small logits lose the digits of the largest.
                let relative = (2.0 * logit_error + (keys.num_rows() as f64 + 40.0) * ROUNDING).exp()
                    * share_factor
                    - 1.0;
                for (key, &share) in shares.iter().enumerate() {
                    let weight = if sum > 0.0 { share / sum } else { 0.0 };
                    weights.push(weight);
                    let distance = if share > 0.0 {
                        (max - logits[key]) * ROUNDING * 2.0
                    } else {
                        0.0
                    };
                    let error = weight * (relative + distance) + 1e-38;
                    weight_bounds.push(error);
                    if weight > 0.0 {
                        let values = &values.row(key)[shared.clone()];
                        let first = query * queries.num_columns() + columns.start;
                        for ((out, bound), &value) in
                            out[first..].iter_mut().zip(&mut bounds[first..]).zip(values)
                        {
                            *out += weight * f64::from(value);
                            *bound += (error + rounding * (weight + error)) * f64::from(value).abs();
                        }
                    }
                }
            }
        }
        (out, bounds, weights, weight_bounds)
    }
}
