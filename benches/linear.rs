//! Packed linear layers at the head's sizes beside faer, rten-gemm and gemmkit, with weights that come from memory.

use std::sync::Arc;

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use gemmkit::{Parallelism, gemm_packed_b, prepack_rhs};
use half::bf16;
use rten_gemm::{GemmExecutor, GemmInputA, GemmInputB, GemmOptions};
use rten_tensor::NdTensorView;
use saccade_benches::measure::{Contender, measure};
use saccade_benches::options::Options;
use saccade_benches::peak::multiply_adds;
use saccade_benches::random::Random;
use saccade_benches::report::Report;
use saccade_kernels::{Arithmetic, Epilogue, Isa, LinearScratch, PackedLinear, WeightRef};

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
    /// `(outputs, inputs)`.
    weight: Vec<f32>,
}

fn main() {
    let options = Options::from_args();
    let mut report = Report::begin("linear, float32 arithmetic", &options);
    for (rows, inputs, outputs) in SHAPES {
        let name = format!("{rows} x {inputs} x {outputs}");
        if !options.wants(&name) {
            continue;
        }
        let mut random = Random::new(1);
        let x = random.vec(rows * inputs, 1.0);
        let weight = random.vec(inputs * outputs, 0.05);
        let shape = Shape {
            rows,
            inputs,
            outputs,
            x,
            weight,
        };
        let mut contenders = Vec::new();
        for &threads in &options.threads {
            for isa in Isa::available() {
                let (work, run) = multiply_adds(isa, threads);
                let name = peak_name(isa);
                contenders.push(Contender {
                    name,
                    threads,
                    work,
                    relative_to: None,
                    run: Box::new(run),
                });
            }
        }
        saccade(&shape, &options, &mut contenders);
        peers(&shape, &options, &mut contenders);
        report.case(&name, &measure(&options, &mut contenders));
    }
    report.end(&options);
}

fn peak_name(isa: Isa) -> String {
    format!("peak {isa}")
}

/// As many copies of what takes `bytes` as stand for weights larger than the caches.
fn copies<T>(bytes: usize, make: impl Fn() -> T) -> Vec<T> {
    (0..(WEIGHT_BYTES / bytes).max(2)).map(|_| make()).collect()
}

fn saccade<'a>(shape: &'a Shape, options: &Options, contenders: &mut Vec<Contender<'a>>) {
    let narrow: Vec<_> = shape.weight.iter().map(|&value| bf16::from_f32(value)).collect();
    for isa in Isa::available() {
        for stored in ["f32", "bf16"] {
            let weight = match stored {
                "f32" => WeightRef::F32(MatRef::from_row_major_slice(
                    &shape.weight,
                    shape.outputs,
                    shape.inputs,
                )),
                _ => WeightRef::Bf16(MatRef::from_row_major_slice(&narrow, shape.outputs, shape.inputs)),
            };
            let pack = || {
                PackedLinear::pack(isa, Arithmetic::Float32, 1, &[(weight, None)])
                    .expect("one part always fits")
            };
            let layers = Arc::new(copies(pack().nbytes(), pack));
            for &threads in &options.threads {
                let layers = Arc::clone(&layers);
                add(
                    shape,
                    contenders,
                    &format!("saccade {isa}, {stored} stored"),
                    threads,
                    isa,
                    move |turn, x, out| {
                        let out = MatMut::from_row_major_slice_mut(out, shape.rows, shape.outputs);
                        let x = MatRef::from_row_major_slice(x, shape.rows, shape.inputs);
                        layers[turn % layers.len()].apply(
                            threads,
                            x,
                            Epilogue::Store,
                            out,
                            &mut LinearScratch::new(),
                        );
                    },
                );
            }
        }
    }
}

fn peers<'a>(shape: &'a Shape, options: &Options, contenders: &mut Vec<Contender<'a>>) {
    let bytes = 4 * shape.weight.len();
    let out_major = MatRef::from_row_major_slice(&shape.weight, shape.outputs, shape.inputs);
    let in_major: Vec<Vec<f32>> = copies(bytes, || {
        (0..shape.weight.len())
            .map(|index| shape.weight[index % shape.outputs * shape.inputs + index / shape.outputs])
            .collect()
    });
    let rten: GemmExecutor = GemmExecutor::new();
    let transposed = NdTensorView::from_data([shape.outputs, shape.inputs], &shape.weight[..]);
    let rten_weights = Arc::new(copies(bytes, || rten.prepack_b(transposed.transposed())));
    let gemmkit_weights = Arc::new(copies(bytes, || {
        let (rows, columns) = (out_major.ncols(), out_major.nrows());
        prepack_rhs(gemmkit::MatRef::from_col_major(&shape.weight, rows, columns))
    }));
    let best = Isa::best();
    // On one thread only: saccade has faer without its threads.
    if options.threads.contains(&1) {
        add(
            shape,
            contenders,
            "faer, weights in x out",
            1,
            best,
            move |turn, x, out| {
                let weight = MatRef::from_row_major_slice(
                    &in_major[turn % in_major.len()],
                    shape.inputs,
                    shape.outputs,
                );
                let x = MatRef::from_row_major_slice(x, shape.rows, shape.inputs);
                let out = MatMut::from_row_major_slice_mut(out, shape.rows, shape.outputs);
                matmul(out, Accum::Replace, x, weight, 1.0, Par::Seq);
            },
        );
    }
    for &threads in &options.threads {
        // rten-gemm uses the whole of the pool that it is called in.
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads can be started");
        let weights = Arc::clone(&rten_weights);
        add(
            shape,
            contenders,
            "rten-gemm, prepacked",
            threads,
            best,
            move |turn, x, out| {
                let x = GemmInputA::Unpacked(NdTensorView::from_data([shape.rows, shape.inputs], x));
                let weight = GemmInputB::Packed(&weights[turn % weights.len()]);
                // An executor only names the kernel; it cannot go from thread to thread.
                let gemm = || <GemmExecutor>::new().gemm(out, x, weight, GemmOptions::default());
                pool.install(gemm).expect("sizes fit");
            },
        );
        let weights = Arc::clone(&gemmkit_weights);
        add(
            shape,
            contenders,
            "gemmkit, prepacked",
            threads,
            best,
            move |turn, x, out| {
                let x = gemmkit::MatRef::from_row_major(x, shape.rows, shape.inputs);
                // Prepacked weights give column-major results only.
                let out = gemmkit::MatMut::from_col_major(out, shape.rows, shape.outputs);
                let parallelism = if threads == 1 {
                    Parallelism::Serial
                } else {
                    Parallelism::Rayon(threads)
                };
                gemm_packed_b(1.0, x, &weights[turn % weights.len()], 0.0, out, parallelism);
            },
        );
    }
}

/// Adds a contender that calls `run(turn, x, out)`.
#[expect(clippy::cast_precision_loss, reason = "a count of operations")]
fn add<'a>(
    shape: &'a Shape,
    contenders: &mut Vec<Contender<'a>>,
    name: &str,
    threads: usize,
    isa: Isa,
    run: impl Fn(usize, &[f32], &mut [f32]) + 'a,
) {
    let mut out = vec![0.0; shape.rows * shape.outputs];
    let mut turn = 0;
    contenders.push(Contender {
        name: name.to_owned(),
        threads,
        work: (shape.rows * shape.inputs * shape.outputs) as f64,
        // The portable path has no peak of its own: what it leaves of the best one is what matters.
        relative_to: Some(peak_name(if isa == Isa::Portable { Isa::best() } else { isa })),
        run: Box::new(move || {
            run(turn, &shape.x, &mut out);
            turn += 1;
        }),
    });
}
