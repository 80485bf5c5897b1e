//! What this CPU can do at most: multiply-accumulates without memory, the clock they run at, and reading
//! memory. Kernels are compared with it.

use std::hint::black_box;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Barrier, PoisonError, RwLock};
use std::thread::Builder;
use std::time::Instant;

use crate::aligned::{AlignedBuffer, AllocError};
use crate::isa::Isa;
use crate::pool::has_room_for_thread;
use crate::simd::{Kernel, Simd};
use crate::weights::Arithmetic;

/// Calls of which the fastest counts: what disturbs a machine makes some of them slow, never fast.
const CALLS: usize = 10;

/// What is read to measure reading: several times any cache.
const MEMORY: usize = 256 << 20;

/// Streams that reading is measured with: one after the other, and as many as a core has open at a time
/// without effort. Which is faster depends on the CPU: 18.7 instead of 11.6 GB/s as several streams by one
/// thread of a Sapphire Rapids; two of a Zen 4 read as fast either way.
pub const READ_STREAMS: [usize; 2] = [1, 16];

/// Why a peak was not measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PeakError {
    /// There is not enough memory.
    #[error(transparent)]
    Alloc(#[from] AllocError),
    /// The system has refused a thread.
    #[error("cannot start {threads} threads: {source}")]
    Thread {
        /// How many were asked for.
        threads: usize,
        /// Why.
        source: io::Error,
    },
}

/// The most multiply-accumulates a second that the kernels of `isa` and `arithmetic` could do on `threads`
/// threads, measured in a few hundredths of a second: the micro-kernels' steps, again and again, with rows
/// and weights in the nearest cache.
///
/// Where there is no instruction for bfloat16, it is widened to float32 and has the same peak.
///
/// # Errors
/// [`PeakError::Thread`] if the system refuses a thread.
///
/// # Panics
/// If this CPU lacks `isa`, or `threads` is 0.
pub fn macs_per_second(isa: Isa, arithmetic: Arithmetic, threads: usize) -> Result<f64, PeakError> {
    fastest(|| {
        let start = Instant::now();
        let macs = multiply_accumulate(isa, arithmetic, threads)?;
        Ok(macs as f64 / start.elapsed().as_secs_f64())
    })
}

/// One sample of [`macs_per_second`], for programs that measure by turns: returns how many
/// multiply-accumulates it has done.
///
/// # Errors
/// As [`macs_per_second`].
///
/// # Panics
/// As [`macs_per_second`].
pub fn multiply_accumulate(isa: Isa, arithmetic: Arithmetic, threads: usize) -> Result<usize, PeakError> {
    let gemm = isa.gemm(arithmetic, arithmetic.element());
    on_threads(threads, &|_| gemm.multiply_for_peak())
}

/// The name of the kernel whose peak [`macs_per_second`] is, as in `avx512-vnni-int8`.
///
/// # Panics
/// If this CPU lacks `isa`.
#[must_use]
pub fn kernel_name(isa: Isa, arithmetic: Arithmetic) -> &'static str {
    isa.gemm(arithmetic, arithmetic.element()).name()
}

/// Bytes a second that `threads` threads read from memory together, each of them as `streams` streams: a few
/// lines of each in turn. Takes a few tenths of a second.
///
/// # Errors
/// [`PeakError`] if there is not enough memory, of which 256 MiB are read, or the system refuses a thread.
///
/// # Panics
/// If `threads` or `streams` is 0.
pub fn read_bytes_per_second(threads: usize, streams: usize) -> Result<f64, PeakError> {
    assert!(streams > 0, "streams: expected at least 1");
    let mut memory = AlignedBuffer::<u32>::zeroed(MEMORY / size_of::<u32>())?;
    // Pages that were never written may all be the same page of zeros.
    memory.fill(1);
    fastest(|| {
        let start = Instant::now();
        let words = on_threads(threads, &|thread| {
            let part = memory.len() / threads;
            let words = &memory[thread * part..][..part];
            Isa::best().run(&mut Read { words, streams })
        })?;
        Ok((words * size_of::<u32>()) as f64 / start.elapsed().as_secs_f64())
    })
}

/// The largest of several rates.
fn fastest(rate: impl Fn() -> Result<f64, PeakError>) -> Result<f64, PeakError> {
    (0..CALLS).try_fold(0.0, |largest, _| Ok(f64::max(largest, rate()?)))
}

/// Cycles a second, from a chain of dependent instructions whose latency every CPU of the architecture has:
/// multiplications of three cycles on x86-64 (since 2008), additions of one on 64-bit ARM; `None` where it is
/// not known how to measure it.
#[must_use]
pub fn clock_hz() -> Option<f64> {
    #[cfg(all(any(target_arch = "x86_64", target_arch = "aarch64"), not(saccade_portable)))]
    {
        const STEPS: u64 = 400_000;
        const CYCLES: f64 = if cfg!(target_arch = "x86_64") { 3.0 } else { 1.0 };
        let mut value = black_box(3u64);
        let mut fastest = f64::INFINITY;
        for _ in 0..CALLS {
            let start = Instant::now();
            for _ in 0..STEPS / 8 {
                // SAFETY: arithmetic on one register.
                #[cfg(target_arch = "x86_64")]
                unsafe {
                    std::arch::asm!(
                        "imul {0}, {0}", "imul {0}, {0}", "imul {0}, {0}", "imul {0}, {0}",
                        "imul {0}, {0}", "imul {0}, {0}", "imul {0}, {0}", "imul {0}, {0}",
                        inout(reg) value, options(pure, nomem, nostack)
                    );
                }
                // SAFETY: arithmetic on one register.
                #[cfg(target_arch = "aarch64")]
                unsafe {
                    std::arch::asm!(
                        "add {0}, {0}, {0}", "add {0}, {0}, {0}", "add {0}, {0}, {0}", "add {0}, {0}, {0}",
                        "add {0}, {0}, {0}", "add {0}, {0}, {0}", "add {0}, {0}, {0}", "add {0}, {0}, {0}",
                        inout(reg) value, options(pure, nomem, nostack)
                    );
                }
            }
            fastest = fastest.min(start.elapsed().as_secs_f64());
            black_box(value);
        }
        Some(CYCLES * STEPS as f64 / fastest)
    }
    #[cfg(any(saccade_portable, not(any(target_arch = "x86_64", target_arch = "aarch64"))))]
    None
}

/// Reads all words, as parts side by side; returns how many.
struct Read<'a> {
    words: &'a [u32],
    streams: usize,
}

impl Kernel for Read<'_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) -> usize {
        const VECTORS: usize = 8;
        let turn = VECTORS * S::LANES;
        let turns = self.words.len() / self.streams / turn;
        let mut sums = [simd.splat_i32(0); VECTORS];
        for index in 0..turns {
            for stream in 0..self.streams {
                let words = &self.words[(stream * turns + index) * turn..][..turn];
                for (sum, words) in sums.iter_mut().zip(words.chunks_exact(S::LANES)) {
                    *sum = simd.add_i32(*sum, simd.load_words(words));
                }
            }
        }
        black_box(&sums);
        turns * self.streams * turn
    }
}

/// Runs `work` on `threads` threads that begin together; returns the sum of the results.
///
/// # Errors
/// [`PeakError::Thread`] if the system refuses a thread; then none of them runs `work`.
fn on_threads(threads: usize, work: &(dyn Fn(usize) -> usize + Sync)) -> Result<usize, PeakError> {
    assert!(threads > 0, "threads: expected at least 1");
    if threads == 1 {
        return Ok(work(0));
    }
    let (start_together, is_refused) = (Barrier::new(threads), AtomicBool::new(false));
    // Write-locked until all threads are started or one is refused: the barrier opens for all of them only.
    let gate = RwLock::new(());
    let run = |thread| {
        drop(gate.read().unwrap_or_else(PoisonError::into_inner));
        if is_refused.load(Ordering::Acquire) {
            return 0;
        }
        start_together.wait();
        work(thread)
    };
    let run = &run;
    std::thread::scope(|scope| {
        let closed = gate.write().unwrap_or_else(PoisonError::into_inner);
        let others: Result<Vec<_>, io::Error> = (1..threads)
            .map(|thread| match has_room_for_thread() {
                true => Builder::new().spawn_scoped(scope, move || run(thread)),
                false => Err(io::ErrorKind::OutOfMemory.into()),
            })
            .collect();
        is_refused.store(others.is_err(), Ordering::Release);
        drop(closed);
        let others = others.map_err(|source| PeakError::Thread { threads, source })?;
        let own = run(0);
        let joined = others
            .into_iter()
            .map(|other| other.join().expect("a peak loop does not panic"));
        Ok(own + joined.sum::<usize>())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stream_is_read_to_its_end() {
        let words = vec![1; 1000];
        for streams in [1, 3, 16] {
            let turn = 8 * Isa::Portable.vectors().lanes;
            let read = Isa::Portable.run(&mut Read {
                words: &words,
                streams,
            });
            assert_eq!(read, 1000 / streams / turn * turn * streams, "{streams} streams");
        }
    }
}
