//! What the CPU can do at most: float32 multiply-adds, the clock they run at, and reading memory.

use std::hint::black_box;
use std::sync::Barrier;
use std::time::Instant;

use saccade_kernels::Isa;

/// Multiply-accumulates of [`multiply_adds`] with one iteration.
const CHAINS: usize = 12;

/// One call's worth of multiply-adds for `threads` threads: `(multiply-accumulates, call)`.
///
/// Twelve independent chains hide the latency of the instruction on every CPU we know (4 cycles x 2 units), and fit in 16 registers.
#[expect(clippy::cast_precision_loss, reason = "a count of operations")]
pub fn multiply_adds(isa: Isa, threads: usize) -> (f64, impl FnMut()) {
    let iterations = 200_000;
    let lanes = match isa {
        Isa::Avx512f | Isa::Avx512 => 16,
        Isa::Avx2 | Isa::Avx2Vnni => 8,
        _ => 4,
    };
    let work = (iterations * CHAINS * lanes * threads) as f64;
    (work, move || on_threads(threads, &|_| chains(isa, iterations)))
}

fn chains(isa: Isa, iterations: usize) {
    assert!(isa.is_available(), "this CPU lacks {isa}");
    match isa {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the CPU has the instruction set.
        Isa::Avx512f | Isa::Avx512 => unsafe { chains_avx512(iterations) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        Isa::Avx2 | Isa::Avx2Vnni => unsafe { chains_avx2(iterations) },
        _ => chains_portable(iterations),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn chains_avx512(iterations: usize) {
    use std::arch::x86_64::{_mm512_fmadd_ps, _mm512_reduce_add_ps, _mm512_set1_ps};
    let (factor, addend) = (_mm512_set1_ps(black_box(0.5)), _mm512_set1_ps(black_box(1.0)));
    let mut sums = [addend; CHAINS];
    for _ in 0..iterations {
        for sum in &mut sums {
            *sum = _mm512_fmadd_ps(*sum, factor, addend);
        }
    }
    for sum in sums {
        black_box(_mm512_reduce_add_ps(sum));
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn chains_avx2(iterations: usize) {
    use std::arch::x86_64::{_mm256_cvtss_f32, _mm256_fmadd_ps, _mm256_set1_ps};
    let (factor, addend) = (_mm256_set1_ps(black_box(0.5)), _mm256_set1_ps(black_box(1.0)));
    let mut sums = [addend; CHAINS];
    for _ in 0..iterations {
        for sum in &mut sums {
            *sum = _mm256_fmadd_ps(*sum, factor, addend);
        }
    }
    for sum in sums {
        black_box(_mm256_cvtss_f32(sum));
    }
}

/// A multiplication and an addition where there is no fused instruction.
fn chains_portable(iterations: usize) {
    let (factor, addend) = (black_box(0.5f32), black_box(1.0f32));
    let mut sums = [[addend; 4]; CHAINS];
    for _ in 0..iterations {
        for sum in &mut sums {
            for lane in sum {
                *lane = *lane * factor + addend;
            }
        }
    }
    black_box(sums);
}

/// Billions of cycles a second, from a chain of dependent multiplications that take three cycles each on every x86-64 CPU since 2008.
#[cfg(target_arch = "x86_64")]
#[must_use]
pub fn clock() -> Option<f64> {
    const STEPS: u64 = 2_000_000;
    let mut value = black_box(3u64);
    let mut fastest = f64::INFINITY;
    for _ in 0..10 {
        let start = Instant::now();
        for _ in 0..STEPS / 8 {
            // SAFETY: arithmetic on one register.
            unsafe {
                std::arch::asm!(
                    "imul {0}, {0}", "imul {0}, {0}", "imul {0}, {0}", "imul {0}, {0}",
                    "imul {0}, {0}", "imul {0}, {0}", "imul {0}, {0}", "imul {0}, {0}",
                    inout(reg) value, options(pure, nomem, nostack)
                );
            }
        }
        fastest = fastest.min(start.elapsed().as_secs_f64());
        black_box(value);
    }
    #[expect(clippy::cast_precision_loss, reason = "a few millions")]
    Some(3.0 * STEPS as f64 / fastest * 1e-9)
}

/// Not known how to measure it here.
#[cfg(not(target_arch = "x86_64"))]
#[must_use]
pub fn clock() -> Option<f64> {
    None
}

/// `1e9` bytes a second that `threads` threads read from `memory` together.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "a count of bytes")]
pub fn read_bandwidth(memory: &[u64], threads: usize) -> f64 {
    let part = memory.len() / threads;
    let start = Instant::now();
    on_threads(threads, &|thread| {
        let mut sums = [0u64; 16];
        for line in memory[thread * part..][..part].as_chunks::<16>().0 {
            for (sum, value) in sums.iter_mut().zip(line) {
                *sum = sum.wrapping_add(*value);
            }
        }
        black_box(sums);
    });
    (part * threads * 8) as f64 / start.elapsed().as_secs_f64() * 1e-9
}

/// Runs `work` on `threads` threads that start together.
fn on_threads(threads: usize, work: &(dyn Fn(usize) + Sync)) {
    if threads == 1 {
        return work(0);
    }
    let barrier = Barrier::new(threads);
    std::thread::scope(|scope| {
        for thread in 1..threads {
            let barrier = &barrier;
            scope.spawn(move || {
                barrier.wait();
                work(thread);
            });
        }
        barrier.wait();
        work(0);
    });
}
