//! Memory and threads that the system refuses: errors, and fewer threads. In child processes, whose address space is limited.
#![cfg(all(target_os = "linux", not(saccade_portable)))]

mod common;

use std::sync::atomic::{AtomicUsize, Ordering};

use common::rows_mut;
use saccade_vla_kernels::{
    Arithmetic, Element, Epilogue, Isa, KernelError, LinearScratch, Matrix, PackedKeyValues, PackedLinear,
    Rows, WeightRef, parallel_for, peak,
};

/// Width of all matrices, whose rows are one and the same.
const WIDTH: usize = 4096;
static ROW: [f32; WIDTH] = [1.0; WIDTH];

fn repeated(count: usize) -> Rows<'static> {
    Rows::strided(&ROW, count, WIDTH, 0)
}

/// Bytes of address space that this process uses.
fn used() -> libc::rlim_t {
    let pages = std::fs::read_to_string("/proc/self/statm").unwrap();
    pages.split(' ').next().unwrap().parse::<libc::rlim_t>().unwrap() * 4096
}

/// Runs `work` in a child that may claim `more` bytes of address space; whether it returned true.
fn limited(more: libc::rlim_t, work: impl FnOnce() -> bool) -> bool {
    // SAFETY: the child uses the allocator, which glibc keeps usable after fork, the pool, and `_exit`.
    let child = unsafe { libc::fork() };
    assert!(child >= 0, "fork failed");
    if child == 0 {
        let limit = used() + more;
        let limit = libc::rlimit {
            rlim_cur: limit,
            rlim_max: limit,
        };
        // SAFETY: the limit lives during the call.
        let set = unsafe { libc::setrlimit(libc::RLIMIT_AS, &raw const limit) } == 0;
        let code = if set && work() { 0 } else { 1 };
        // SAFETY: ends the child without running anything of the parent's.
        unsafe { libc::_exit(code) };
    }
    let mut status = 0;
    // SAFETY: waits for a child of this process.
    let waited = unsafe { libc::waitpid(child, &raw mut status, 0) };
    waited == child && libc::WIFEXITED(status) && libc::WEXITSTATUS(status) == 0
}

const MORE: libc::rlim_t = 16 << 20;

#[test]
fn packing_weights_without_memory_is_an_error() {
    const OUTPUTS: usize = 1 << 16;
    for (arithmetic, bits) in [
        (Arithmetic::Float32, 32),
        (Arithmetic::Bfloat16, 16),
        (Arithmetic::Int8, 8),
        (Arithmetic::Int4, 4),
    ] {
        assert!(limited(MORE, || {
            let part = (WeightRef::F32(Matrix::from(repeated(OUTPUTS))), None);
            let packed = PackedLinear::pack(Isa::best(), arithmetic, 1, &[part]);
            matches!(packed, Err(KernelError::Alloc(error)) if error.bytes >= bits * OUTPUTS * WIDTH / 8)
        }));
    }
}

#[test]
fn a_scratch_without_memory_is_an_error_and_usable_afterwards() {
    const COUNT: usize = 1 << 15;
    let part = (WeightRef::F32(Matrix::from(repeated(1))), None);
    let layer = PackedLinear::pack(Isa::best(), Arithmetic::Bfloat16, 1, &[part]).unwrap();
    let mut out = vec![0.0; COUNT];
    assert!(limited(MORE, || {
        let mut scratch = LinearScratch::new();
        let mut apply = |count: usize| {
            let out = rows_mut(&mut out[..count], 1);
            layer.apply(1, repeated(count), Epilogue::Store, out, &mut scratch)
        };
        apply(COUNT).is_err_and(|error| error.bytes >= 2 * COUNT * WIDTH) && apply(4).is_ok()
    }));
}

#[test]
fn keys_and_values_without_memory_are_an_error() {
    for element in [Element::F32, Element::Bf16] {
        assert!(limited(MORE, || {
            let mut held = PackedKeyValues::new(Isa::best(), element, 32, WIDTH / 32);
            let (few, many) = (repeated(4), repeated(1 << 15));
            held.pack(1, few, few).unwrap();
            // What is held stays where more cannot be had, and is gone where it was to be replaced.
            held.append(1, many, many).is_err()
                && held.len() == 4
                && held.reserve(1 << (usize::BITS * 5 / 8)).is_err()
                && held.len() == 4
                && held.pack(1, many, many).is_err()
                && held.is_empty()
                && held.pack(1, few, few).is_ok()
                && held.len() == 4
        }));
    }
}

#[test]
fn measuring_memory_without_memory_is_an_error() {
    assert!(limited(MORE, || peak::read_bytes_per_second(1, 16).is_err()));
}

#[test]
fn peaks_of_threads_that_cannot_be_started_are_errors() {
    let peak = |threads| peak::macs_per_second(Isa::Portable, Arithmetic::Float32, threads);
    for more in [1 << 20, 100 << 20, 400 << 20] {
        assert!(limited(more, || peak(500).is_err() && peak(1).is_ok()));
    }
}

/// A thread needs address space for its stack.
#[test]
fn threads_that_cannot_be_started_are_done_without() {
    for more in [1 << 20, 3 << 20, 100 << 20] {
        assert!(limited(more, || {
            let ran = AtomicUsize::new(0);
            parallel_for(64, 1000, &|_| {
                ran.fetch_add(1, Ordering::Relaxed);
            });
            ran.into_inner() == 1000
        }));
    }
}
