//! What this CPU can do at most: multiply-accumulates from registers, the clock they run at, and reading memory. Kernels are compared with it.

use std::hint::black_box;
use std::sync::Barrier;
use std::time::Instant;

use crate::aligned::{AlignedBuffer, AllocError};
use crate::gemm::Product;
use crate::isa::Isa;
use crate::simd::{Kernel, Simd, Vector};
use crate::weights::Arithmetic;

/// Calls of which the fastest counts: what disturbs a machine makes some of them slow, never fast.
const CALLS: usize = 10;

/// What is read to measure reading: several times any cache.
const MEMORY: usize = 256 << 20;

/// The most multiply-accumulates a second that the kernels of `isa` and `arithmetic` could do on `threads` threads, measured in a few
/// hundredths of a second: independent chains of the instruction that they are made of, without any memory.
///
/// bfloat16 without an instruction of its own is float32 once it is widened, and has its peak.
///
/// # Panics
/// If this CPU lacks `isa`, or `threads` is 0.
#[must_use]
pub fn macs_per_second(isa: Isa, arithmetic: Arithmetic, threads: usize) -> f64 {
    let rate = |_| {
        let start = Instant::now();
        let macs = multiply_accumulate(isa, arithmetic, threads);
        macs as f64 / start.elapsed().as_secs_f64()
    };
    (0..CALLS).map(rate).fold(0.0, f64::max)
}

/// One sample of [`macs_per_second`], for programs that measure by turns: returns how many multiply-accumulates it has done.
///
/// # Panics
/// As [`macs_per_second`].
pub fn multiply_accumulate(isa: Isa, arithmetic: Arithmetic, threads: usize) -> usize {
    let gemm = isa.gemm(match arithmetic {
        Arithmetic::Float32 => Product::Float32,
        Arithmetic::Bfloat16 => Product::Bf16,
        Arithmetic::Int8 => Product::Int8,
    });
    on_threads(threads, &|_| gemm.chains())
}

/// Bytes a second that `threads` threads read from memory together; takes a few tenths of a second.
///
/// # Errors
/// [`AllocError`] if there is not enough memory: 256 MiB are read.
///
/// # Panics
/// If `threads` is 0.
pub fn read_bytes_per_second(threads: usize) -> Result<f64, AllocError> {
    let mut memory = AlignedBuffer::<u32>::zeroed(MEMORY / size_of::<u32>())?;
    // Pages that were never written may all be the same page of zeros.
    memory.fill(1);
    let rate = |_| {
        let start = Instant::now();
        let words = on_threads(threads, &|thread| {
            let part = memory.len() / threads;
            Isa::best().run(Read(&memory[thread * part..][..part]))
        });
        (words * size_of::<u32>()) as f64 / start.elapsed().as_secs_f64()
    };
    Ok((0..CALLS).map(rate).fold(0.0, f64::max))
}

/// Cycles a second, from a chain of dependent multiplications that take three cycles each on every x86-64 CPU since 2008; `None` where it is
/// not known how to measure it.
#[must_use]
pub fn clock_hz() -> Option<f64> {
    #[cfg(target_arch = "x86_64")]
    {
        const STEPS: u64 = 400_000;
        let mut value = black_box(3u64);
        let mut fastest = f64::INFINITY;
        for _ in 0..CALLS {
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
        Some(3.0 * STEPS as f64 / fastest)
    }
    #[cfg(not(target_arch = "x86_64"))]
    None
}

/// Reads all words; returns how many.
struct Read<'a>(&'a [u32]);

impl Kernel for Read<'_> {
    type Output = usize;

    #[inline(always)]
    unsafe fn run<S: Simd>(self, _: S) -> usize {
        const VECTORS: usize = 8;
        // SAFETY: chunks have as many words as are loaded; the caller has the instruction set.
        unsafe {
            let lanes = S::Vector::LANES;
            let mut sums = [S::Vector::splat_int(0); VECTORS];
            for words in self.0.chunks_exact(VECTORS * lanes) {
                for (vector, sum) in sums.iter_mut().enumerate() {
                    let words = S::Vector::load_ints(words.as_ptr().add(vector * lanes).cast());
                    *sum = S::Vector::add_ints(*sum, words);
                }
            }
            black_box(&sums);
        }
        self.0.len()
    }
}

/// Runs `work` on `threads` threads that begin together; returns the sum of the results.
fn on_threads(threads: usize, work: &(dyn Fn(usize) -> usize + Sync)) -> usize {
    assert!(threads > 0, "threads: expected at least 1");
    if threads == 1 {
        return work(0);
    }
    let barrier = Barrier::new(threads);
    std::thread::scope(|scope| {
        let others: Vec<_> = (1..threads)
            .map(|thread| {
                let barrier = &barrier;
                scope.spawn(move || {
                    barrier.wait();
                    work(thread)
                })
            })
            .collect();
        barrier.wait();
        let own = work(0);
        let joined = others
            .into_iter()
            .map(|other| other.join().expect("a peak loop does not panic"));
        own + joined.sum::<usize>()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_peak_counts_its_work() {
        for isa in Isa::available() {
            let [float, bf16, int8] = [Arithmetic::Float32, Arithmetic::Bfloat16, Arithmetic::Int8]
                .map(|arithmetic| multiply_accumulate(isa, arithmetic, 1));
            assert_eq!(
                bf16 / float,
                if isa.dot_products().contains(&"bf16") {
                    2
                } else {
                    1
                },
                "{isa}"
            );
            assert_eq!(int8 / float, 4, "{isa}");
            assert_eq!(
                multiply_accumulate(isa, Arithmetic::Float32, 2),
                2 * float,
                "{isa}"
            );
            assert!(macs_per_second(isa, Arithmetic::Int8, 1) > 0.0);
        }
        assert!(clock_hz().is_none_or(|clock| clock > 1e8));
    }
}
