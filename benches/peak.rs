//! The ceilings that the other benches are compared with: multiply-accumulates a second, checked against clock x units, and read bandwidth.

use saccade_benches::measure::{Contender, MULTIPLY_ACCUMULATES, measure, quantile};
use saccade_benches::options::Options;
use saccade_benches::report::Report;
use saccade_vla_kernels::peak::{READ_STREAMS, clock_hz, read_bytes_per_second};
use saccade_vla_kernels::{Arithmetic, Isa};

fn main() {
    let options = Options::from_args();
    let mut report = Report::begin("peak", MULTIPLY_ACCUMULATES, &options);
    let mut contenders = Vec::new();
    for &threads in &options.threads {
        for isa in Isa::available() {
            for arithmetic in [Arithmetic::Float32, Arithmetic::Bfloat16, Arithmetic::Int8] {
                contenders.push(Contender::peak(isa, arithmetic, threads));
            }
        }
    }
    let rates = measure(&options, &mut contenders);
    report.case("multiply-accumulates from registers", &rates);
    if let Some(clock) = clock_hz() {
        println!(
            "\nclock {:.2} GHz (a chain of dependent multiplications)",
            clock * 1e-9
        );
        for entry in rates.iter().filter(|entry| entry.threads == 1) {
            // Of float32 a 512-bit unit makes 16 in a cycle, two 256-bit units as many; of bf16 twice, of int8 four times as many.
            println!(
                "{:<34}{:>8.2} multiply-accumulates a cycle",
                entry.name,
                1e9 * quantile(&entry.rates, 0.5) / clock
            );
        }
    }
    println!();
    for &threads in &options.threads {
        for streams in READ_STREAMS {
            println!(
                "{:<34}{:>8.1} GB/s",
                format!("read, {threads} threads, {streams} streams"),
                1e-9 * read_bytes_per_second(threads, streams).expect("there is enough memory")
            );
        }
    }
    report.end(&options);
}
