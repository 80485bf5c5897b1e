//! Asking memory for weights as many streams, beside asking for them in their order: what the column `streams` of the table in
//! `saccade-vla-kernels/src/cpu/family.rs` is filled by. Weights come from memory; both are measured by turns.
//!
//! `cargo bench -p saccade-benches --bench streams -- --threads 1,2 --rounds 60`

use saccade_benches::measure::{Contender, MULTIPLY_ACCUMULATES, arithmetic_name, measure};
use saccade_benches::options::Options;
use saccade_benches::random::Random;
use saccade_benches::report::Report;
use saccade_vla_kernels::{
    Arithmetic, Element, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, Rows, RowsMut, WeightRef,
};

/// `(rows, in_features, out_features)`: a DiT block's feed-forward, and layers of the VL self-attention.
const SHAPES: [(usize, usize, usize); 4] = [
    (49, 1536, 6144),
    (49, 6144, 1536),
    (296, 2048, 8192),
    (296, 8192, 2048),
];

/// Each contender walks through this many bytes of its weights before it meets the first again: several times any cache.
const WEIGHT_BYTES: usize = 160 << 20;

/// The widest panel that is asked for in its order either way, as [`PackedLinear::with_streams`] says: one cache line of float32. It holds for
/// NEON too, whose panels are narrower.
const COLUMNS_IN_ORDER: usize = 16;

/// Whether streams change anything for an instruction set.
fn has_streams(isa: Isa) -> bool {
    // One output without inputs is one panel without weights, and holds a bias for each column.
    let columns = PackedLinear::packed_nbytes(isa, Arithmetic::Float32, Element::F32, (1, 0))
        .expect("float32 may have any inputs")
        / size_of::<f32>();
    columns > COLUMNS_IN_ORDER
}

fn main() {
    let options = Options::from_args();
    let mut report = Report::begin("streams", MULTIPLY_ACCUMULATES, &options);
    println!("{}", saccade_vla_kernels::CpuReport::current().family);
    let (measured, left_out): (Vec<_>, Vec<_>) =
        Isa::available().into_iter().partition(|&isa| has_streams(isa));
    let left_out: Vec<_> = left_out.iter().map(Isa::to_string).collect();
    println!(
        "left out, because they ask in order either way: {}",
        left_out.join(", ")
    );
    for (rows, inputs, outputs) in SHAPES {
        let mut random = Random::new(1);
        let (x, weight) = (random.vec(rows * inputs, 1.0), random.vec(inputs * outputs, 0.05));
        let weight = WeightRef::F32(Matrix::new(&weight, inputs));
        for &isa in &measured {
            for arithmetic in [Arithmetic::Float32, Arithmetic::Bfloat16, Arithmetic::Int8] {
                let name = format!(
                    "{isa}, {}, {rows} x {inputs} x {outputs}",
                    arithmetic_name(arithmetic)
                );
                if !options.wants(&name) {
                    continue;
                }
                let pack =
                    || PackedLinear::pack(isa, arithmetic, 1, &[(weight, None)]).expect("one part fits");
                let count = (WEIGHT_BYTES / pack().nbytes()).max(2);
                let layers = [("in order", false), ("streams", true)].map(|(order, streams)| {
                    let layers: Vec<_> = (0..count).map(|_| pack().with_streams(streams)).collect();
                    (order, layers)
                });
                let mut contenders = Vec::new();
                for &threads in &options.threads {
                    for (order, layers) in &layers {
                        let (mut out, mut scratch) = (vec![0.0; rows * outputs], LinearScratch::new());
                        let (x, mut turn) = (&x, 0);
                        contenders.push(Contender {
                            name: (*order).to_owned(),
                            threads,
                            #[expect(clippy::cast_precision_loss, reason = "a count of operations")]
                            work: (rows * inputs * outputs) as f64,
                            relative_to: (*order == "streams").then(|| "in order".to_owned()),
                            run: Box::new(move || {
                                let (x, out) = (Rows::new(x, inputs), RowsMut::new(&mut out, outputs));
                                let layer = &layers[turn % layers.len()];
                                turn += 1;
                                layer
                                    .apply(threads, x, Epilogue::Store, out, &mut scratch)
                                    .expect("there is enough memory");
                            }),
                        });
                    }
                }
                report.case(&name, &measure(&options, &mut contenders));
            }
        }
    }
    report.end(&options);
}
