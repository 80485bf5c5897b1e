//! After the first call of a shape, no kernel allocates: a robot's control loop must not meet the allocator.

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Barrier;
use std::sync::atomic::{AtomicUsize, Ordering};

use common::{is_emulated, isas, numbers, rows, rows_mut};
use saccade_vla_kernels::{
    Arithmetic, Element, Epilogue, Isa, LinearScratch, LogitBias, Mask, Matrix, PackedKeyValues,
    PackedLinear, WeightRef, attention, gelu_erf, gelu_tanh, layer_norm, parallel_for, rms_norm_in_place,
    rotary_embedding, silu,
};

/// The system's allocator, counting what all threads ask of it.
struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: everything is passed on to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// One test in this file, so that no other test runs at the same time.
#[test]
fn the_second_call_of_a_shape_allocates_nothing() {
    const WIDTH: usize = 384;
    let weight = numbers(1, WIDTH * WIDTH, 1.0);
    let x = numbers(2, 296 * WIDTH, 1.0);
    let bias = numbers(3, 296, 1.0);
    for isa in isas() {
        let weight = WeightRef::F32(Matrix::new(&weight, WIDTH));
        let pack = |arithmetic| PackedLinear::pack(isa, arithmetic, 1, &[(weight, None)]).unwrap();
        let layers = [
            Arithmetic::Float32,
            Arithmetic::Bfloat16,
            Arithmetic::Int8,
            Arithmetic::Int4,
        ]
        .map(pack);
        let mut scratch = LinearScratch::new();
        let mut held = PackedKeyValues::new(isa, Element::F32, 8, WIDTH / 8);
        let mut appended = PackedKeyValues::new(isa, Element::Bf16, 8, WIDTH / 8);
        let norm_weight = numbers(4, WIDTH / 8, 1.0);
        let mut out = vec![0.0; 296 * WIDTH];
        let mut weights = vec![0.0; 8 * 296 * 296];
        let mut pass = |threads, count: usize| {
            let x = rows(&x[..count * WIDTH], WIDTH);
            let out = &mut out[..count * WIDTH];
            for layer in &layers {
                for epilogue in [Epilogue::GeluTanh, Epilogue::Add] {
                    layer
                        .apply(threads, x, epilogue, rows_mut(out, WIDTH), &mut scratch)
                        .unwrap();
                }
            }
            layer_norm(isa, threads, x, 1e-5, None, rows_mut(out, WIDTH));
            held.pack(threads, x, x).unwrap();
            let bias = LogitBias {
                values: &bias,
                head_stride: 0,
                query_stride: 0,
            };
            attention(
                threads,
                x,
                &held,
                0.1,
                Mask::Bias(bias),
                None,
                rows_mut(out, WIDTH),
            );
            let weights = &mut weights[..8 * count * count];
            attention(
                threads,
                x,
                &held,
                0.1,
                Mask::None,
                Some(weights),
                rows_mut(out, WIDTH),
            );
            let mask = Mask::Causal { offset: 0 };
            attention(threads, x, &held, 0.1, mask, None, rows_mut(out, WIDTH));
            appended.pack(threads, x.rows(0..1), x.rows(0..1)).unwrap();
            appended.reserve(300).unwrap();
            appended.append(threads, x, x).unwrap();
            rms_norm_in_place(isa, threads, rows_mut(out, WIDTH), 1e-6, &norm_weight);
            let angles = rows(&norm_weight, 1).rows(0..1);
            rotary_embedding(
                isa,
                threads,
                rows_mut(&mut out[..WIDTH], WIDTH),
                WIDTH / 8,
                angles,
                angles,
            );
            gelu_tanh(isa, out);
            gelu_erf(isa, out);
            silu(isa, out);
            parallel_for(threads, 10, &|_| {});
        };
        // An emulator takes its time, and after a minute the test runner allocates to say so.
        let all_threads = if isa == Isa::SoftwareTiles || is_emulated() {
            &[2][..]
        } else {
            &[1, 2, 5]
        };
        let counts = if is_emulated() {
            &[49, 1][..]
        } else {
            &[296, 49, 1]
        };
        for &threads in all_threads {
            // Each thread holds one task until all are there: a worker that starts late would allocate what a new thread needs.
            let all = Barrier::new(threads);
            parallel_for(threads, threads, &|_| {
                all.wait();
            });
            for &count in counts {
                pass(threads, count);
                let before = ALLOCATIONS.load(Ordering::Relaxed);
                (0..5).for_each(|_| pass(threads, count));
                let allocations = ALLOCATIONS.load(Ordering::Relaxed) - before;
                assert_eq!(allocations, 0, "{isa}, {threads} threads, {count} rows");
            }
        }
    }
}
