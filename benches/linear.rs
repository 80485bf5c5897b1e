//! Packed linear layers at the head's sizes, compared with faer, rten-gemm and gemmkit, in float32, bfloat16 and int8, with weights that come from
//! memory.

use std::sync::Arc;

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use gemmkit::{Parallelism, gemm_i8_packed_b, gemm_packed_b, prepack_rhs, prepack_rhs_i8};
use half::bf16;
use rten_gemm::{GemmExecutor, GemmInT, GemmInputA, GemmInputB, GemmOptions, GemmOutT};
use rten_tensor::NdTensorView;
use saccade_benches::measure::{Contender, MULTIPLY_ACCUMULATES, arithmetic_name, measure};
use saccade_benches::options::Options;
use saccade_benches::random::Random;
use saccade_benches::report::Report;
use saccade_vla_kernels::peak::{READ_STREAMS, read_bytes_per_second};
use saccade_vla_kernels::{
    Arithmetic, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, Rows, RowsMut, WeightRef, quantize_rows,
};

/// `(rows, in_features, out_features)`: a DiT block's feed-forward and projections, and a VL self-attention block's projection.
const SHAPES: [(usize, usize, usize); 4] = [
    (49, 1536, 6144),
    (49, 6144, 1536),
    (49, 1536, 1536),
    (296, 2048, 1536),
];

/// Each contender walks through this many bytes of its weights before it meets the first again: several times any cache.
const WEIGHT_BYTES: usize = 160 << 20;

struct Shape {
    rows: usize,
    inputs: usize,
    outputs: usize,
    x: Vec<f32>,
    /// `(outputs, inputs)`, and so the narrower ones.
    weight: Vec<f32>,
    bf16: Vec<bf16>,
    int8: Vec<i8>,
}

impl Shape {
    fn new(rows: usize, inputs: usize, outputs: usize) -> Self {
        let mut random = Random::new(1);
        let x = random.vec(rows * inputs, 1.0);
        let weight = random.vec(inputs * outputs, 0.05);
        let bf16 = weight.iter().map(|&value| bf16::from_f32(value)).collect();
        let (mut int8, mut scales) = (vec![0; weight.len()], vec![0.0; outputs]);
        let view = Matrix::new(&weight, inputs);
        quantize_rows(WeightRef::F32(view), &mut int8, &mut scales);
        Self {
            rows,
            inputs,
            outputs,
            x,
            weight,
            bf16,
            int8,
        }
    }
}

const ARITHMETICS: [Arithmetic; 3] = [Arithmetic::Float32, Arithmetic::Bfloat16, Arithmetic::Int8];

fn main() {
    let options = Options::from_args();
    let mut report = Report::begin("linear", MULTIPLY_ACCUMULATES, &options);
    let bandwidths: Vec<_> = options
        .threads
        .iter()
        .map(|&threads| {
            let rates = READ_STREAMS.map(|streams| read_bytes_per_second(threads, streams));
            let rates = rates.map(|rate| rate.expect("there is enough memory"));
            rates.into_iter().fold(0.0, f64::max)
        })
        .collect();
    for (threads, bandwidth) in options.threads.iter().zip(&bandwidths) {
        println!("read, {threads} threads: {:.1} GB/s", 1e-9 * bandwidth);
    }
    for (rows, inputs, outputs) in SHAPES {
        let name = format!("{rows} x {inputs} x {outputs}");
        if !options.wants(&name) {
            continue;
        }
        // What reading the weights once allows at most, if they come from memory.
        for (threads, bandwidth) in options.threads.iter().zip(&bandwidths) {
            let [f32, bf16, int8] = [4.0, 2.0, 1.0].map(|bytes| 1e-9 * bandwidth / bytes * rows as f64);
            println!(
                "\n{name}, {threads} threads: memory allows {f32:.0} / {bf16:.0} / {int8:.0} (float32 / bfloat16 / int8)"
            );
        }
        let shape = Shape::new(rows, inputs, outputs);
        let mut contenders = Vec::new();
        for &threads in &options.threads {
            for isa in Isa::available() {
                contenders.extend(ARITHMETICS.map(|arithmetic| Contender::peak(isa, arithmetic, threads)));
            }
        }
        saccade(&shape, &options, &mut contenders);
        if options.peers {
            peers(&shape, &options, &mut contenders);
        }
        report.case(&name, &measure(&options, &mut contenders));
    }
    report.end(&options);
}

/// Copies of `bytes` bytes, enough of them to exceed the caches, as the weights of a model do.
fn copies<T>(bytes: usize, make: impl Fn() -> T) -> Vec<T> {
    (0..(WEIGHT_BYTES / bytes).max(2)).map(|_| make()).collect()
}

fn saccade<'a>(shape: &'a Shape, options: &Options, contenders: &mut Vec<Contender<'a>>) {
    let wide = WeightRef::F32(Matrix::new(&shape.weight, shape.inputs));
    let narrow = WeightRef::Bf16(Matrix::new(&shape.bf16, shape.inputs));
    for isa in Isa::available() {
        for (arithmetic, weight, stored) in [
            (Arithmetic::Float32, wide, ""),
            (Arithmetic::Float32, narrow, " of bf16 weights"),
            (Arithmetic::Bfloat16, narrow, ""),
            (Arithmetic::Int8, wide, ""),
            (Arithmetic::Int4, wide, ""),
        ] {
            // Where an instruction set multiplies as the one before does, it is not measured again.
            if isa == Isa::Avx2Vnni && !matches!(arithmetic, Arithmetic::Int8 | Arithmetic::Int4)
                || isa == Isa::Avx512f && arithmetic == Arithmetic::Float32
            {
                continue;
            }
            let pack =
                || PackedLinear::pack(isa, arithmetic, 1, &[(weight, None)]).expect("one part always fits");
            let layers = Arc::new(copies(pack().nbytes(), pack));
            for &threads in &options.threads {
                let layers = Arc::clone(&layers);
                let (mut out, mut scratch) = (vec![0.0; shape.rows * shape.outputs], LinearScratch::new());
                let name = format!("saccade {isa}, {}{stored}", arithmetic_name(arithmetic));
                add(
                    shape,
                    contenders,
                    &name,
                    threads,
                    (isa, arithmetic),
                    move |turn| {
                        let (x, out) = (
                            Rows::new(&shape.x, shape.inputs),
                            RowsMut::new(&mut out, shape.outputs),
                        );
                        let applied =
                            layers[turn % layers.len()].apply(threads, x, Epilogue::Store, out, &mut scratch);
                        applied.expect("there is enough memory");
                    },
                );
            }
        }
    }
}

/// The int8 peers get rows that are quantised already, and leave sums that are integers still.
fn peers<'a>(shape: &'a Shape, options: &Options, contenders: &mut Vec<Contender<'a>>) {
    let best = Isa::best();
    // On one thread only: saccade has faer without its threads.
    if options.threads.contains(&1) {
        let in_major: Vec<Vec<f32>> = copies(4 * shape.weight.len(), || {
            (0..shape.weight.len())
                .map(|index| shape.weight[index % shape.outputs * shape.inputs + index / shape.outputs])
                .collect()
        });
        let mut out = vec![0.0; shape.rows * shape.outputs];
        let peak = (best, Arithmetic::Float32);
        add(shape, contenders, "faer, float32", 1, peak, move |turn| {
            let weight =
                MatRef::from_row_major_slice(&in_major[turn % in_major.len()], shape.inputs, shape.outputs);
            let x = MatRef::from_row_major_slice(&shape.x, shape.rows, shape.inputs);
            let out = MatMut::from_row_major_slice_mut(&mut out, shape.rows, shape.outputs);
            matmul(out, Accum::Replace, x, weight, 1.0, Par::Seq);
        });
    }
    let bytes: Vec<u8> = shape.x.iter().map(|x| ((x + 1.0) * 127.0) as u8).collect();
    let signed: Vec<i8> = shape.x.iter().map(|x| (x * 127.0) as i8).collect();
    let x_bf16: Vec<bf16> = shape.x.iter().map(|&x| bf16::from_f32(x)).collect();
    rten::<f32, f32, f32>(
        shape,
        options,
        "rten-gemm, float32",
        Arithmetic::Float32,
        &shape.x,
        &shape.weight,
        contenders,
    );
    rten::<u8, i8, i32>(
        shape,
        options,
        "rten-gemm, int8",
        Arithmetic::Int8,
        &bytes,
        &shape.int8,
        contenders,
    );
    let pack = || prepack_rhs(gemmkit_weight(shape, &shape.weight));
    gemmkit(
        shape,
        options,
        Arithmetic::Float32,
        4,
        &shape.x,
        pack,
        contenders,
        |x, weight, out, parallelism| {
            gemm_packed_b(1.0, x, weight, 0.0, out, parallelism);
        },
    );
    let pack = || prepack_rhs(gemmkit_weight(shape, &shape.bf16));
    gemmkit(
        shape,
        options,
        Arithmetic::Bfloat16,
        2,
        &x_bf16,
        pack,
        contenders,
        |x, weight, out, parallelism| {
            gemm_packed_b(bf16::ONE, x, weight, bf16::ZERO, out, parallelism);
        },
    );
    let pack = || prepack_rhs_i8(gemmkit_weight(shape, &shape.int8));
    gemmkit(
        shape,
        options,
        Arithmetic::Int8,
        1,
        &signed,
        pack,
        contenders,
        |x, weight, out, parallelism| {
            gemm_i8_packed_b(1, x, weight, 0, out, parallelism);
        },
    );
}

fn rten<'a, X: GemmInT + 'a, W: GemmInT + 'a, O: GemmOutT + 'a>(
    shape: &'a Shape,
    options: &Options,
    name: &str,
    arithmetic: Arithmetic,
    x: &[X],
    weight: &[W],
    contenders: &mut Vec<Contender<'a>>,
) where
    GemmExecutor<X, W, O>: Default,
{
    let executor = GemmExecutor::<X, W, O>::default();
    let transposed = NdTensorView::from_data([shape.outputs, shape.inputs], weight);
    let weights = Arc::new(copies(size_of_val(weight), || {
        executor.prepack_b(transposed.transposed())
    }));
    for &threads in &options.threads {
        // rten-gemm uses the whole of the pool that it is called in.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.expect("threads can be started");
        let (x, weights) = (x.to_vec(), Arc::clone(&weights));
        let mut out = vec![O::default(); shape.rows * shape.outputs];
        add(
            shape,
            contenders,
            name,
            threads,
            (Isa::best(), arithmetic),
            move |turn| {
                let x = GemmInputA::Unpacked(NdTensorView::from_data([shape.rows, shape.inputs], &x[..]));
                let weight = GemmInputB::Packed(&weights[turn % weights.len()]);
                // An executor only names the kernel; it cannot go from thread to thread.
                let gemm =
                    || GemmExecutor::<X, W, O>::default().gemm(&mut out, x, weight, GemmOptions::default());
                pool.install(gemm).expect("sizes fit");
            },
        );
    }
}

fn gemmkit_weight<'a, T>(shape: &Shape, weight: &'a [T]) -> gemmkit::MatRef<'a, T> {
    gemmkit::MatRef::from_col_major(weight, shape.inputs, shape.outputs)
}

#[expect(
    clippy::too_many_arguments,
    reason = "what differs between three element types"
)]
fn gemmkit<'a, T: Copy + 'a, P: 'a, O: Copy + Default + 'a>(
    shape: &'a Shape,
    options: &Options,
    arithmetic: Arithmetic,
    bytes: usize,
    x: &[T],
    pack: impl Fn() -> P,
    contenders: &mut Vec<Contender<'a>>,
    gemm: impl Fn(gemmkit::MatRef<'_, T>, &P, gemmkit::MatMut<'_, O>, Parallelism) + Copy + 'a,
) {
    let weights = Arc::new(copies(bytes * shape.weight.len(), pack));
    for &threads in &options.threads {
        let (x, weights) = (x.to_vec(), Arc::clone(&weights));
        let mut out = vec![O::default(); shape.rows * shape.outputs];
        let name = format!("gemmkit, {}", arithmetic_name(arithmetic));
        add(
            shape,
            contenders,
            &name,
            threads,
            (Isa::best(), arithmetic),
            move |turn| {
                let x = gemmkit::MatRef::from_row_major(&x, shape.rows, shape.inputs);
                // Prepacked weights give column-major results only.
                let out = gemmkit::MatMut::from_col_major(&mut out, shape.rows, shape.outputs);
                let parallelism = if threads == 1 {
                    Parallelism::Serial
                } else {
                    Parallelism::Rayon(threads)
                };
                gemm(x, &weights[turn % weights.len()], out, parallelism);
            },
        );
    }
}

/// Adds a contender that calls `run(turn)`, to be compared with a peak.
#[expect(clippy::cast_precision_loss, reason = "a count of operations")]
fn add<'a>(
    shape: &Shape,
    contenders: &mut Vec<Contender<'a>>,
    name: &str,
    threads: usize,
    (isa, arithmetic): (Isa, Arithmetic),
    mut run: impl FnMut(usize) + 'a,
) {
    // The portable path has no peak of its own: what it leaves of the best one is what matters.
    let isa = if isa == Isa::Portable { Isa::best() } else { isa };
    let mut turn = 0;
    contenders.push(Contender {
        name: name.to_owned(),
        threads,
        work: (shape.rows * shape.inputs * shape.outputs) as f64,
        relative_to: Some(Contender::peak_name(isa, arithmetic)),
        run: Box::new(move || {
            run(turn);
            turn += 1;
        }),
    });
}
