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
    #[cfg(target_os = "linux")]
    {
        linux::processor()
    }
    #[cfg(not(target_os = "linux"))]
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
        #[cfg(target_os = "linux")]
        if let Some(caller) = caller {
            linux::leave(caller, threads);
        }
        #[cfg(not(target_os = "linux"))]
        let _ = threads;
    }
}

#[cfg(target_os = "linux")]
mod linux {
    use libc::{CPU_CLR, CPU_COUNT, cpu_set_t, sched_getaffinity, sched_getcpu, sched_setaffinity};

    pub(super) fn processor() -> Option<usize> {
        // SAFETY: takes nothing and returns a number.
        usize::try_from(unsafe { sched_getcpu() }).ok()
    }

    /// The processors that the calling thread may use. None on a machine with more of them than the set can hold.
    pub(super) fn allowed() -> Option<cpu_set_t> {
        // SAFETY: a set of bits, for which zeros are valid; it lives during the call, which gets its size.
        unsafe {
            let mut set: cpu_set_t = std::mem::zeroed();
            (sched_getaffinity(0, size_of::<cpu_set_t>(), &raw mut set) == 0).then_some(set)
        }
    }

    fn allow(set: &cpu_set_t) -> bool {
        // SAFETY: the set lives during the call, which gets its size.
        unsafe { sched_setaffinity(0, size_of::<cpu_set_t>(), set) == 0 }
    }

    /// Forbids the calling thread `processor` for a moment: the system moves it at once, and it stays where it was moved to.
    pub(super) fn leave(processor: usize, threads: usize) {
        let Some(all) = allowed() else { return };
        let mut others = all;
        // SAFETY: bits of sets that live here; a processor that runs a thread which may use it is within the set.
        let enough = unsafe {
            CPU_CLR(processor, &mut others);
            usize::try_from(CPU_COUNT(&all)).is_ok_and(|count| count >= threads) && CPU_COUNT(&others) > 0
        };
        if enough && allow(&others) {
            allow(&all);
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn a_thread_leaves_and_may_use_the_same_processors_as_before() {
        // In a thread of its own: where it may run must not matter to other tests.
        let moved = std::thread::spawn(|| {
            let bits = |set: libc::cpu_set_t| {
                // SAFETY: looks at bits within the set.
                (0..1024)
                    .map(|cpu| unsafe { libc::CPU_ISSET(cpu, &set) })
                    .collect::<Vec<_>>()
            };
            let before = bits(linux::allowed().unwrap());
            let count = before.iter().filter(|&&bit| bit).count();
            let mut moved = count < 2;
            for _ in 0..20 {
                let here = processor();
                Place::new().apart_from(here, 2);
                moved |= processor() != here;
                assert_eq!(bits(linux::allowed().unwrap()), before);
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
