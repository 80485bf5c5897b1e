//! What the loops of the peaks count.

use saccade_vla_kernels::peak::{clock_hz, macs_per_second, multiply_accumulate};
use saccade_vla_kernels::{Arithmetic, Isa};

#[test]
fn every_peak_counts_its_work() {
    for isa in Isa::available() {
        let [float, bf16, int8, int4] = [
            Arithmetic::Float32,
            Arithmetic::Bfloat16,
            Arithmetic::Int8,
            Arithmetic::Int4,
        ]
        .map(|arithmetic| multiply_accumulate(isa, arithmetic, 1).unwrap());
        // A step does so many 28th of the multiply-adds of one of float32.
        let expected = match (isa, &isa.dot_products()[..]) {
            // Six products of 16 x 16 x 16 words next to a dozen of vectors, in an eighth of the steps.
            (Isa::Amx, _) => [28 * 32, 28 * 64],
            // Rows of a tile times `k` of a step: seven times four of float32, eight times four of
            // bfloat16.
            (Isa::Neon, _) => [28, 5 * 16],
            (Isa::Dotprod, _) => [28, 6 * 16],
            (Isa::I8mm, _) => [28, 8 * 8],
            (Isa::Bf16, ["bf16", "i8mm"]) => [8 * 4, 8 * 8],
            (Isa::Bf16, ["bf16", "dotprod"]) => [8 * 4, 6 * 16],
            (Isa::Bf16, _) => [8 * 4, 5 * 16],
            (_, ["bf16", ..]) => [28 * 2, 28 * 4],
            _ => [28, 28 * 4],
        };
        assert_eq!([28 * bf16 / float, 28 * int8 / float], expected, "{isa}");
        assert_eq!(int4, int8, "{isa}: weights of four bits are multiplied as bytes");
        assert_eq!(
            multiply_accumulate(isa, Arithmetic::Float32, 2).unwrap(),
            2 * float,
            "{isa}"
        );
        assert!(macs_per_second(isa, Arithmetic::Int8, 1).unwrap() > 0.0);
    }
    // An emulator needs several cycles for one.
    assert!(clock_hz().is_none_or(|clock| clock > 1e7));
}
