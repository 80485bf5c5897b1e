//! Linear layers and attention of any shape, chosen by bytes, on every instruction set: within the bounds of rounding, the
//! same bits for a row alone, and nothing written beside the results. `fuzz/` finds bytes, `tests/random.rs` draws some.

use half::bf16;
use saccade_vla_kernels::{
    Arithmetic, Epilogue, Isa, LinearScratch, LogitBias, Mask, Matrix, PackedLinear, Rows, WeightRef,
    attention, quantize_rows_int4,
};

use super::attention::{BF16_ROUNDING, Case, ELEMENTS, Kind, REMOVED, kinds_of};
use super::{Strided, assert_close, bits, gamma, gelu_erf, gelu_tanh, isas, numbers, silu};

/// Choices made by bytes; the first one where they have run out.
struct Choices<'a>(std::slice::Iter<'a, u8>);

impl Choices<'_> {
    /// A number below `count`.
    fn below(&mut self, count: usize) -> usize {
        let mut byte = || usize::from(self.0.next().copied().unwrap_or(0));
        if count > 256 {
            (byte() << 8 | byte()) % count
        } else {
            byte() % count
        }
    }

    fn among<T: Copy>(&mut self, values: &[T]) -> T {
        values[self.below(values.len())]
    }

    fn yes(&mut self) -> bool {
        self.below(2) == 1
    }
}

/// How far an epilogue may carry an error of its input, and what it makes of one.
fn epilogue(epilogue: Epilogue, y: f64, before: f64) -> (f64, f64) {
    match epilogue {
        Epilogue::Store => (y, 1.0),
        Epilogue::GeluTanh => (gelu_tanh(y), 1.2),
        Epilogue::GeluErf => (gelu_erf(y), 1.2),
        Epilogue::Relu => (y.max(0.0), 1.0),
        Epilogue::Silu => (silu(y), 1.2),
        Epilogue::Add => (before + y, 1.0),
        Epilogue::Mul => (before * y, before.abs()),
        _ => panic!("an epilogue without a definition here"),
    }
}

const EPILOGUES: [Epilogue; 7] = [
    Epilogue::Store,
    Epilogue::GeluTanh,
    Epilogue::GeluErf,
    Epilogue::Relu,
    Epilogue::Silu,
    Epilogue::Add,
    Epilogue::Mul,
];

const ARITHMETICS: [Arithmetic; 4] = [
    Arithmetic::Float32,
    Arithmetic::Bfloat16,
    Arithmetic::Int8,
    Arithmetic::Int4,
];

/// A layer and its rows.
struct Layer {
    rows: usize,
    inputs: usize,
    outputs: usize,
    /// Stored `(in_features, out_features)`.
    transposed: bool,
    /// Representable in bfloat16, and stored so if `is_bf16`.
    weight: Vec<f32>,
    is_bf16: bool,
    bias: Option<Vec<f32>>,
    x: Strided,
    before: Strided,
    epilogue: Epilogue,
    apart: bool,
}

impl Layer {
    fn new(choices: &mut Choices<'_>) -> Self {
        let (rows, inputs, outputs) = (choices.below(24), 1 + choices.below(300), choices.below(150));
        let seed = choices.below(256) as u64;
        let weight = numbers(seed, outputs * inputs, 1.0)
            .into_iter()
            .map(|value| bf16::from_f32(value).to_f32())
            .collect();
        let mut x = numbers(seed + 1, rows * inputs, 2.0);
        if choices.yes() && !x.is_empty() {
            // Far larger than the others.
            let at = choices.below(x.len());
            x[at] *= 50.0;
        }
        Self {
            rows,
            inputs,
            outputs,
            transposed: choices.yes(),
            weight,
            is_bf16: choices.yes(),
            bias: choices.yes().then(|| numbers(seed + 2, outputs, 1.0)),
            x: Strided::new(&x, rows, inputs, choices.below(5)),
            before: Strided::new(
                &numbers(seed + 3, rows * outputs, 2.0),
                rows,
                outputs,
                choices.below(5),
            ),
            epilogue: choices.among(&EPILOGUES),
            apart: choices.yes(),
        }
    }

    /// Weight `(output, input)`.
    fn weight(&self, output: usize, input: usize) -> f32 {
        match self.transposed {
            true => self.weight[input * self.outputs + output],
            false => self.weight[output * self.inputs + input],
        }
    }

    fn pack(&self, isa: Isa, arithmetic: Arithmetic, threads: usize) -> PackedLinear {
        fn view<'a, T: Copy>(layer: &Layer, data: &'a [T]) -> Matrix<'a, T> {
            match layer.transposed {
                true => {
                    Matrix::from(Rows::strided(data, layer.inputs, layer.outputs, layer.outputs)).transpose()
                }
                false => Matrix::from(Rows::strided(data, layer.outputs, layer.inputs, layer.inputs)),
            }
        }
        let half: Vec<_> = self.weight.iter().copied().map(bf16::from_f32).collect();
        let weight = match self.is_bf16 {
            true => WeightRef::Bf16(view(self, &half)),
            false => WeightRef::F32(view(self, &self.weight)),
        };
        let layer = PackedLinear::pack(isa, arithmetic, threads, &[(weight, self.bias.as_deref())]).unwrap();
        match self.apart {
            true => layer.keeping_outliers(),
            false => layer,
        }
    }

    /// The results of some rows.
    fn run(&self, packed: &PackedLinear, threads: usize, rows: std::ops::Range<usize>) -> Vec<f32> {
        let mut out = self.before.clone();
        let x = self.x.view().rows(rows.clone());
        packed
            .apply(
                threads,
                x,
                self.epilogue,
                out.view_mut().rows(rows.clone()),
                &mut LinearScratch::new(),
            )
            .unwrap();
        out.values()[rows.start * self.outputs..rows.end * self.outputs].to_vec()
    }

    /// The weights that are multiplied, `(outputs, inputs)`: of int4 what [`quantize_rows_int4`] makes of them.
    fn multiplied(&self, arithmetic: Arithmetic) -> Vec<f32> {
        let (inputs, outputs) = (self.inputs, self.outputs);
        let mut weights: Vec<f32> = (0..outputs * inputs)
            .map(|place| self.weight(place / inputs, place % inputs))
            .collect();
        if arithmetic == Arithmetic::Int4 {
            let mut values = vec![0; outputs * inputs.div_ceil(2)];
            let mut scales = vec![0.0; outputs];
            let given = WeightRef::F32(Matrix::new(&weights, inputs));
            quantize_rows_int4(given, &mut values, &mut scales);
            for (place, weight) in weights.iter_mut().enumerate() {
                let (output, input) = (place / inputs, place % inputs);
                let pair = values[output * inputs.div_ceil(2) + input / 2];
                let half = if input % 2 == 0 { pair << 4 } else { pair & 0xf0 };
                *weight = f32::from(half.cast_signed() >> 4) * scales[output];
            }
        }
        weights
    }

    /// Each result in float64, with what rounding may change.
    fn exact(&self, arithmetic: Arithmetic) -> (Vec<f64>, Vec<f64>) {
        let (x, before) = (self.x.view(), self.before.values());
        let weights = self.multiplied(arithmetic);
        let largest_weight = |row: &[f32]| row.iter().fold(0.0, |most: f64, w| most.max(f64::from(w.abs())));
        let largest: Vec<f64> = weights.chunks_exact(self.inputs).map(largest_weight).collect();
        let (mut results, mut bounds) = (Vec::new(), Vec::new());
        for row in 0..self.rows {
            let x: Vec<f64> = x.row(row).iter().map(|&value| f64::from(value)).collect();
            // Half a step of 7 bits, at least.
            let x_step = x.iter().fold(0.0, |largest: f64, value| largest.max(value.abs())) / 63.0;
            for output in 0..self.outputs {
                let bias = self.bias.as_ref().map_or(0.0, |bias| f64::from(bias[output]));
                // Half a step of the weights at least; those of four bits are rounded already.
                let w_step = match arithmetic {
                    Arithmetic::Int4 => 0.0,
                    _ => largest[output] / 254.0 * (1.0 + 1e-6),
                };
                let (mut sum, mut magnitude, mut error) = (bias, bias.abs(), 0.0);
                for (input, &x) in x.iter().enumerate() {
                    let w = f64::from(weights[output * self.inputs + input]);
                    sum += w * x;
                    magnitude += (w * x).abs();
                    error += match arithmetic {
                        Arithmetic::Float32 => 0.0,
                        // The weights are exact.
                        Arithmetic::Bfloat16 => BF16_ROUNDING * (w * x).abs(),
                        Arithmetic::Int8 | Arithmetic::Int4 => {
                            w_step * x.abs() + x_step * w.abs() + w_step * x_step
                        }
                    };
                }
                error += gamma(self.inputs + 8) * (magnitude + error);
                let before = f64::from(before[row * self.outputs + output]);
                let (result, factor) = epilogue(self.epilogue, sum, before);
                results.push(result);
                bounds.push(factor * error + 1e-5 * (sum.abs() + before.abs() + result.abs()) + 1e-30);
            }
        }
        (results, bounds)
    }
}

/// A linear layer in every arithmetic.
pub fn linear(bytes: &[u8]) {
    let mut choices = Choices(bytes.iter());
    let layer = Layer::new(&mut choices);
    let (threads, alone) = (1 + choices.below(3), choices.below(layer.rows.max(1)));
    for arithmetic in ARITHMETICS {
        let (exact, bounds) = layer.exact(arithmetic);
        for isa in isas() {
            let packed = layer.pack(isa, arithmetic, threads);
            let out = layer.run(&packed, threads, 0..layer.rows);
            assert_close(&format!("{isa} {arithmetic:?}"), &out, &exact, &bounds);
            if layer.rows > 0 {
                let single = layer.run(&packed, 1, alone..alone + 1);
                let of_batch = &out[alone * layer.outputs..][..layer.outputs];
                assert_eq!(bits(&single), bits(of_batch), "{isa} {arithmetic:?}: row {alone}");
            }
        }
    }
}

/// Attention over keys held in every element.
pub fn attend(bytes: &[u8]) {
    let mut choices = Choices(bytes.iter());
    let (queries, keys) = (choices.below(20), choices.below(90));
    let num_kv_heads = 1 + choices.below(3);
    let num_heads = num_kv_heads * (1 + choices.below(3));
    let (head_dim, gap, threads) = (1 + choices.below(80), choices.below(4), 1 + choices.below(3));
    let seed = choices.below(256) as u64;
    let mut case = Case::grouped(seed, [queries, keys], [num_heads, num_kv_heads], head_dim, gap);
    let (kind_of_mask, offset) = (choices.below(3), choices.below(keys + 2));
    let removed = 1 + choices.below(7);
    let mut biases = numbers(seed + 3, num_heads * queries * keys, 3.0);
    for bias in biases.iter_mut().step_by(removed) {
        *bias = REMOVED;
    }
    let (head_stride, query_stride) = (queries * keys, keys);
    let bias = |head: usize, query: usize, key: usize| match kind_of_mask {
        0 => 0.0,
        1 if key > offset + query => REMOVED,
        1 => 0.0,
        _ => biases[head * head_stride + query * query_stride + key],
    };
    // The mask of the queries from `first` on.
    let mask = |first: usize| match kind_of_mask {
        0 => Mask::None,
        1 => Mask::Causal {
            offset: offset + first,
        },
        _ => Mask::Bias(LogitBias {
            values: &biases[(first * query_stride).min(biases.len())..],
            head_stride,
            query_stride,
        }),
    };
    let (alone, appended) = (choices.below(queries.max(1)), choices.below(keys + 1));
    let all = case.queries.clone();
    for element in ELEMENTS {
        case.queries = all.clone();
        let (exact, bounds, weights, weight_bounds) = case.exact(element, bias);
        for kind in kinds_of(element) {
            case.queries = all.clone();
            let mut kept = vec![f32::NAN; num_heads * queries * keys];
            let out = case.run(kind, threads, mask(0), Some(&mut kept));
            assert_close(&format!("{kind} out"), &out, &exact, &bounds);
            assert_close(&format!("{kind} weights"), &kept, &weights, &weight_bounds);
            if queries > 0 {
                let width = num_heads * head_dim;
                let of_batch = &out[alone * width..][..width];
                case.queries = Strided::new(&all.values()[alone * width..], 1, width, gap);
                let single = in_two_parts(&case, kind, appended, mask(alone));
                assert_eq!(bits(&single), bits(of_batch), "{kind}: query {alone}");
            }
        }
    }
}

/// The same with keys and values that came in two parts, on one thread.
fn in_two_parts(case: &Case, kind: Kind, first: usize, mask: Mask<'_>) -> Vec<f32> {
    let (keys, values) = (case.keys.view(), case.values.view());
    let mut held =
        saccade_vla_kernels::PackedKeyValues::new(kind.isa, kind.element, case.num_kv_heads, case.head_dim);
    held.pack(1, keys.rows(0..first), values.rows(0..first)).unwrap();
    let rest = first..keys.num_rows();
    held.append(1, keys.rows(rest.clone()), values.rows(rest))
        .unwrap();
    let mut out = case.queries.clone();
    attention(
        1,
        case.queries.view(),
        &held,
        case.scale,
        mask,
        None,
        out.view_mut(),
    );
    out.values()
}
