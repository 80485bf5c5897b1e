//! The ceilings that the other benches are compared with: multiply-adds a second, checked against clock x units, and read bandwidth.

use saccade_benches::measure::{Contender, measure, quantile};
use saccade_benches::options::Options;
use saccade_benches::peak::{clock, multiply_adds, read_bandwidth};
use saccade_benches::report::Report;
use saccade_kernels::Isa;

fn main() {
    let options = Options::from_args();
    let mut report = Report::begin("peak", &options);
    let mut contenders = Vec::new();
    for &threads in &options.threads {
        for isa in Isa::available() {
            let (work, run) = multiply_adds(isa, threads);
            let name = format!("multiply-adds {isa}");
            contenders.push(Contender {
                name,
                threads,
                work,
                relative_to: None,
                run: Box::new(run),
            });
        }
    }
    let rates = measure(&options, &mut contenders);
    report.case("float32 multiply-adds from registers", &rates);
    if let Some(clock) = clock() {
        println!("\nclock {clock:.2} GHz (a chain of dependent multiplications)");
        for entry in rates.iter().filter(|entry| entry.threads == 1) {
            // A 512-bit unit makes 16 in a cycle, two 256-bit units as many.
            println!(
                "{:<34}{:>8.2} multiply-accumulates a cycle",
                entry.name,
                quantile(&entry.rates, 0.5) / clock
            );
        }
    }
    let memory = vec![1u64; 1 << 26];
    println!();
    for &threads in &options.threads {
        let samples: Vec<_> = (0..options.rounds.min(10))
            .map(|_| read_bandwidth(&memory, threads))
            .collect();
        println!("read, {threads} threads{:>34.1} GB/s", quantile(&samples, 0.5));
    }
    report.end(&options);
}
