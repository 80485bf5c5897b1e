//! Chooses loom's types in the pool, and leaves system calls out.

fn main() {
    println!("cargo::rustc-check-cfg=cfg(feature, values(\"peak\"))");
    for name in ["loom", "saccade_portable"] {
        println!("cargo::rustc-check-cfg=cfg({name})");
        println!("cargo::rustc-cfg={name}");
    }
}
