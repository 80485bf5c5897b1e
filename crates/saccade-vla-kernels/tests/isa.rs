//! The names of instruction sets.

use saccade_vla_kernels::Isa;

#[test]
fn every_name_is_that_of_one_instruction_set() {
    let x86 = ["avx2", "avx2vnni", "avx512f", "avx512", "amx"];
    let arm = ["neon", "dotprod", "i8mm", "bf16"];
    for name in x86.iter().chain(&arm).chain(&["portable", "software_tiles"]) {
        assert_eq!(name.parse::<Isa>().unwrap().to_string(), *name);
    }
    for isa in Isa::available() {
        assert_eq!(isa.to_string().parse::<Isa>().unwrap(), isa);
    }
    let error = "avx1024".parse::<Isa>().unwrap_err().to_string();
    assert!(
        error.starts_with("SACCADE_ISA: expected one of portable"),
        "{error}"
    );
    assert!(error.ends_with("got `avx1024`"), "{error}");
}
