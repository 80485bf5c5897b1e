//! Where a worker runs: not on the processor of the thread that it helps.
//!
//! When every processor is busy, Linux tends to put a thread that is woken on the processor of the thread that woke it. Caller and worker then
//! take turns on one processor while other programs have the rest. Measured on 2 cores with 2 busy processes: 40 % of the time so, until a worker that
//! finds itself there asks to be moved; then under 1 %.

use std::time::{Duration, Instant};

/// A worker asks at most this often: where it is not granted, asking costs no more than a hundredth of the time.
const PATIENCE: Duration = Duration::from_millis(1);

/// The processor that runs the calling thread, if the system reports it.
pub(super) fn processor() -> Option<usize> {
    #[cfg(all(target_os = "linux", not(saccade_portable)))]
    {
        linux::processor()
    }
    #[cfg(not(all(target_os = "linux", not(saccade_portable))))]
    {
        None
    }
}

/// One worker's memory of when it last asked.
pub(super) struct Place {
    asked: Option<Instant>,
}

impl Place {
    pub(super) fn new() -> Self {
        Self { asked: None }
    }

    /// Moves the calling thread away from `caller`'s processor, if it is there and `threads` find a processor each.
    pub(super) fn apart_from(&mut self, caller: Option<usize>, threads: usize) {
        if caller.is_none()
            || processor() != caller
            || self.asked.is_some_and(|asked| asked.elapsed() < PATIENCE)
        {
            return;
        }
        self.asked = Some(Instant::now());
        #[cfg(all(target_os = "linux", not(saccade_portable)))]
        if let Some(caller) = caller {
            linux::leave(caller, threads);
        }
        #[cfg(not(all(target_os = "linux", not(saccade_portable))))]
        let _ = threads;
    }
}

#[cfg(all(target_os = "linux", not(saccade_portable)))]
mod linux {
    /// Processors that a set can hold, as the C library's can. On a machine with more, threads stay where they are.
    const MOST: usize = 1024;

    /// A bit for each processor, as the kernel has them.
    #[derive(Clone, Copy, PartialEq)]
    pub(super) struct Processors([usize; MOST / usize::BITS as usize]);

    impl Processors {
        pub(super) fn len(&self) -> usize {
            self.0.iter().map(|word| word.count_ones() as usize).sum()
        }

        /// The others, where there are any.
        fn without(mut self, processor: usize) -> Option<Self> {
            let bits = usize::BITS as usize;
            *self.0.get_mut(processor / bits)? &= !(1 << (processor % bits));
            (self.len() > 0).then_some(self)
        }
    }

    pub(super) fn processor() -> Option<usize> {
        // SAFETY: takes nothing and returns a number.
        usize::try_from(unsafe { libc::sched_getcpu() }).ok()
    }

    /// The processors that the calling thread may use.
    pub(super) fn allowed() -> Option<Processors> {
        let mut bits = [0; MOST / usize::BITS as usize];
        // SAFETY: writes as many bytes as it is told at most; any bits are numbers.
        let status = unsafe { libc::sched_getaffinity(0, size_of_val(&bits), bits.as_mut_ptr().cast()) };
        (status == 0).then_some(Processors(bits))
    }

    fn allow(Processors(bits): &Processors) -> bool {
        // SAFETY: reads as many bytes as it is told.
        unsafe { libc::sched_setaffinity(0, size_of_val(bits), bits.as_ptr().cast()) == 0 }
    }

    /// Forbids the calling thread `processor` for a moment: the system moves it at once, and it stays where it was moved to.
    ///
    /// Somebody else may change the mask meanwhile (`taskset -a`). Then it is left as they want it, unless their change
    /// comes within the few instructions between two of these calls.
    pub(super) fn leave(processor: usize, threads: usize) {
        let Some(all) = allowed().filter(|all| all.len() >= threads) else {
            return;
        };
        let Some(others) = all.without(processor) else {
            return;
        };
        if allow(&others) && allowed() == Some(others) {
            allow(&all);
        }
    }
}

#[cfg(all(test, target_os = "linux", not(saccade_portable)))]
mod tests {
    use super::*;

    #[test]
    fn a_thread_leaves_and_may_use_the_same_processors_as_before() {
        // In a thread of its own: where it may run must not matter to other tests.
        let moved = std::thread::spawn(|| {
            let before = linux::allowed().unwrap();
            let mut moved = before.len() < 2;
            for _ in 0..20 {
                let here = processor();
                Place::new().apart_from(here, 2);
                moved |= processor() != here;
                assert!(linux::allowed().unwrap() == before);
            }
            moved
        });
        assert!(moved.join().unwrap());
    }

    #[test]
    fn a_worker_stays_where_it_is_not_in_the_way() {
        let mut place = Place::new();
        place.apart_from(None, 2);
        place.apart_from(Some(usize::MAX), 2);
        assert!(place.asked.is_none());
        // More threads than processors: some share one, whoever moves.
        place.apart_from(processor(), 100_000);
    }
}
