//! The private thread pool: one loop over tasks, shared by the caller and by workers that live as long as the process.
//!
//! No thread is started until a call wants more than one. A call puts a [`Job`] on its own stack, offers it in one of a few slots, wakes
//! workers, and takes tasks itself. Tasks are dealt from one counter: whichever thread is free takes the next, so a slow core gets fewer of
//! them. Near the end a worker that is so slow that the others are done without it takes no more. The caller never waits for a
//! worker that has not begun. When no task is left it closes the slot, and waits only for the workers that are still inside.
//!
//! On a machine with more runnable threads than cores, a worker can lose its core within a task; the caller then waits for a tick of the
//! scheduler (4 ms here). It sleeps while it waits, as idle workers do. On Linux a sleeping thread keeps its share of processor time, and
//! runs soon after it is woken, so that caller and workers tend to run at the same time and to pause at the same time. Measured on 2 cores with 2
//! busy processes, 328 tasks of 60 us in 5 loops: 2.12 times as long as alone, where 2.0 is the fair share; 2.5 with a caller that spins and
//! yields.

mod interrupt;
mod place;
mod slot;

use std::cell::Cell;
use std::hint::black_box;
use std::marker::PhantomData;
use std::panic::resume_unwind;
use std::sync::atomic::{AtomicPtr, AtomicU32, AtomicUsize, Ordering};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

pub(crate) use interrupt::is_stopped;
pub use interrupt::{Interrupted, interrupted, interruptible};

use interrupt::Scope;
use place::Place;
use slot::{Job, Slot, lock, spin_until};

/// Calls that can have workers at the same time. A call beyond them runs on its own thread only.
const SLOTS: usize = 8;

/// How long a worker without work spins before it sleeps: about the longest pause between two loops of one forward pass.
/// Waking a sleeping thread costs some 5 us of the caller's time, and as much again until it runs.
const SPIN: Duration = Duration::from_micros(50);

/// The longest time that a caller spins for workers that are inside: a few hundredths of a scheduler's time slice.
const LONGEST_WAIT: Duration = Duration::from_micros(500);

/// The most threads that a call can have: a guard against absurd requests.
const MAX_THREADS: usize = 1024;

/// Address space that must be free before a thread is started: more than the allocator keeps of what was freed before.
const THREAD_ROOM: usize = 80 << 20;

/// Whether a thread can be started. If the system grants a stack and little more, the standard library aborts the process when the thread
/// begins.
pub(crate) fn has_room_for_thread() -> bool {
    let mut memory = Vec::<u8>::new();
    let is_granted = memory.try_reserve_exact(THREAD_ROOM).is_ok();
    // A compiler may leave out memory that is not used, and then takes it for granted.
    black_box(&memory);
    is_granted
}

struct Pool {
    /// Where its workers live. A child of `fork` has this memory but not the threads.
    process: u32,
    /// Workers started.
    workers: AtomicUsize,
    slots: [Slot; SLOTS],
    /// Grows with every job offered, so that a worker about to sleep sees that it should look again.
    offers: AtomicU32,
    sleepers: AtomicUsize,
    bed: Mutex<()>,
    wake: Condvar,
}

impl Pool {
    const fn new(process: u32) -> Self {
        Self {
            process,
            workers: AtomicUsize::new(0),
            slots: [const { Slot::new() }; SLOTS],
            offers: AtomicU32::new(0),
            sleepers: AtomicUsize::new(0),
            bed: Mutex::new(()),
            wake: Condvar::new(),
        }
    }

    /// Starts workers until there are `wanted`, or the system refuses one.
    fn start_workers(&'static self, wanted: usize) {
        while self.workers.load(Ordering::Relaxed) < wanted {
            let take = |count: usize| (count < wanted).then_some(count + 1);
            let Ok(index) = self
                .workers
                .fetch_update(Ordering::Relaxed, Ordering::Relaxed, take)
            else {
                return;
            };
            let thread = std::thread::Builder::new().name(format!("saccade-{}", index + 1));
            if !has_room_for_thread() || thread.spawn(|| self.work()).is_err() {
                // The call uses the threads that there are; a later call tries again.
                self.workers.fetch_sub(1, Ordering::Relaxed);
                return;
            }
        }
    }

    /// What a worker does, for as long as the process runs.
    fn work(&self) -> ! {
        INSIDE.set(true);
        let mut place = Place::new();
        loop {
            let seen = self.offers.load(Ordering::SeqCst);
            if self.help(&mut place) {
                continue;
            }
            let idle_since = Instant::now();
            let is_asked = || self.offers.load(Ordering::Relaxed) != seen;
            while !spin_until(is_asked) && idle_since.elapsed() < SPIN {}
            if self.offers.load(Ordering::SeqCst) == seen {
                self.sleep(seen);
            }
        }
    }

    fn help(&self, place: &mut Place) -> bool {
        let mut helped = false;
        // Not `any`, which stops at the first: a worker visits all slots before it looks for new offers.
        for slot in &self.slots {
            helped |= slot.help(place);
        }
        helped
    }

    fn sleep(&self, seen: u32) {
        let mut bed = lock(&self.bed);
        self.sleepers.fetch_add(1, Ordering::SeqCst);
        while self.offers.load(Ordering::SeqCst) == seen {
            bed = self.wake.wait(bed).unwrap_or_else(PoisonError::into_inner);
        }
        self.sleepers.fetch_sub(1, Ordering::SeqCst);
    }

    /// Tells workers that there is a new job.
    fn ring(&self, wanted: usize) {
        self.offers.fetch_add(1, Ordering::SeqCst);
        // A worker counts itself before it looks at `offers` for the last time: it sees this offer, or is seen here.
        let sleepers = self.sleepers.load(Ordering::SeqCst);
        if sleepers == 0 {
            return;
        }
        // With the lock held, a worker between its last look and its sleep is not missed.
        let _bed = lock(&self.bed);
        if wanted >= sleepers {
            self.wake.notify_all();
        } else {
            (0..wanted).for_each(|_| self.wake.notify_one());
        }
    }

    fn run(&self, threads: usize, tasks: usize, f: &(dyn Fn(usize) + Sync)) {
        let helpers = threads.min(tasks).min(MAX_THREADS) - 1;
        let scope = Scope::current();
        let job = Job {
            f,
            tasks,
            next: AtomicUsize::new(0),
            threads: helpers + 1,
            processor: place::processor(),
            seats: AtomicUsize::new(helpers),
            stop: scope.map(Scope::flag),
            panic: Mutex::new(None),
        };
        let slot = self
            .slots
            .iter()
            .find(|slot| !slot.taken.swap(true, Ordering::Acquire));
        if let Some(slot) = slot {
            slot.job
                .store((&raw const job).cast_mut().cast(), Ordering::SeqCst);
            self.ring(helpers);
        }
        // Panics of tasks are kept in the job, so that this thread always comes to the end of this function.
        INSIDE.set(true);
        let since = Instant::now();
        // The caller has no pace: it takes tasks to the end, whoever leaves.
        let taken = job.run(None, || scope.is_some_and(Scope::asks_to_stop));
        INSIDE.set(false);
        if let Some(slot) = slot {
            // No worker can come to the job from here on, and those inside are waited for: after that nobody knows it but this thread.
            slot.job.store(std::ptr::null_mut(), Ordering::SeqCst);
            // A worker that runs ends its last task in about the time that ours took; one that does not has lost its core.
            let patience = SPIN + 2 * since.elapsed() / taken.max(1);
            slot.wait_until_empty(patience.min(LONGEST_WAIT));
            slot.taken.store(false, Ordering::Release);
        }
        if let Some(panic) = job.panic.into_inner().unwrap_or_else(PoisonError::into_inner) {
            resume_unwind(panic);
        }
    }
}

thread_local! {
    /// Whether this thread is running a task: a loop inside runs on this thread alone.
    static INSIDE: Cell<bool> = const { Cell::new(false) };
    /// How many guards of [`stay_on_this_thread`] there are.
    static STAYS: Cell<usize> = const { Cell::new(0) };
}

/// The pool of this process, or of the one that it was forked from; null before anyone needed one. Never freed.
static POOL: AtomicPtr<Pool> = AtomicPtr::new(std::ptr::null_mut());

/// The pool, made at first use. No lock is involved: in a child of `fork` a lock could be held by a thread that does not exist there.
fn pool() -> &'static Pool {
    let process = std::process::id();
    loop {
        let known = POOL.load(Ordering::Acquire);
        // SAFETY: null, or a pool that was leaked below.
        match unsafe { known.as_ref() } {
            Some(pool) if pool.process == process => return pool,
            _ => {
                let fresh = Box::into_raw(Box::new(Pool::new(process)));
                if POOL
                    .compare_exchange(known, fresh, Ordering::AcqRel, Ordering::Acquire)
                    .is_err()
                {
                    // SAFETY: another thread was faster; nobody has seen this one.
                    drop(unsafe { Box::from_raw(fresh) });
                }
            }
        }
    }
}

/// Runs `f(task)` for every `task` in `0..tasks`, on up to `threads` threads of which the caller is one.
///
/// Tasks are dealt one by one to threads that are free. With one thread, one task, within a task of another loop, or while there is a
/// guard of [`stay_on_this_thread`], everything runs on the calling thread and nothing is started. The pool belongs to the process
/// and may be used from many threads at once, after `fork`, and with more threads than there are cores. Once its threads
/// run, a call allocates nothing.
///
/// Within [`interruptible`], once it is to stop, the remaining tasks do not run.
///
/// # Panics
/// If a task panics: with the first panic, once all other tasks are done.
///
/// ```
/// use std::sync::atomic::{AtomicUsize, Ordering};
/// let sum = AtomicUsize::new(0);
/// saccade_vla_kernels::parallel_for(2, 5, &|task| {
///     sum.fetch_add(task, Ordering::Relaxed);
/// });
/// assert_eq!(sum.into_inner(), 10);
/// ```
pub fn parallel_for(threads: usize, tasks: usize, f: &(dyn Fn(usize) + Sync)) {
    if usable(threads) <= 1 || tasks <= 1 {
        match Scope::current() {
            None => (0..tasks).for_each(f),
            Some(scope) => (0..tasks).take_while(|_| !scope.asks_to_stop()).for_each(f),
        }
    } else {
        let pool = pool();
        pool.start_workers(threads.min(tasks).min(MAX_THREADS) - 1);
        pool.run(threads, tasks, f);
    }
}

/// The loops that the calling thread starts run on this thread alone, as within a task, until what this returns is dropped.
///
/// For a caller that computes several things at the same time, one on each of its threads. Where every loop is short this is faster than all
/// threads in every loop: nothing waits for the last task of a loop.
///
/// ```
/// use saccade_vla_kernels::{parallel_for, stay_on_this_thread};
/// let _alone = stay_on_this_thread();
/// let here = std::thread::current().id();
/// parallel_for(2, 8, &|_| assert_eq!(std::thread::current().id(), here));
/// ```
pub fn stay_on_this_thread() -> StayOnThisThread {
    STAYS.set(STAYS.get() + 1);
    StayOnThisThread(PhantomData)
}

/// The guard of [`stay_on_this_thread`]. It belongs to the thread that made it; of several, the last one dropped ends it.
#[derive(Debug)]
#[must_use = "loops use other threads again once it is dropped"]
pub struct StayOnThisThread(PhantomData<*const ()>);

impl Drop for StayOnThisThread {
    fn drop(&mut self) {
        STAYS.set(STAYS.get() - 1);
    }
}

/// How many of `threads` threads a loop of the calling thread can have.
pub(crate) fn usable(threads: usize) -> usize {
    if INSIDE.get() || STAYS.get() > 0 {
        1
    } else {
        threads
    }
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use super::*;

    fn visits(threads: usize, tasks: usize) -> Vec<usize> {
        let visits: Vec<AtomicUsize> = (0..tasks).map(|_| AtomicUsize::new(0)).collect();
        parallel_for(threads, tasks, &|task| {
            visits[task].fetch_add(1, Ordering::Relaxed);
        });
        visits.into_iter().map(AtomicUsize::into_inner).collect()
    }

    #[test]
    fn a_thread_stays_alone_until_its_last_guard_is_gone_also_after_errors() {
        let fails = || -> Result<(), ()> {
            let _alone = stay_on_this_thread();
            assert_eq!(usable(8), 1);
            Err(())
        };
        assert_eq!((fails(), usable(8)), (Err(()), 8));
        let panics = catch_unwind(|| {
            let _alone = stay_on_this_thread();
            panic!("within");
        });
        assert!(panics.is_err() && usable(8) == 8);
        let (first, second) = (stay_on_this_thread(), stay_on_this_thread());
        drop(first);
        assert_eq!(usable(8), 1);
        drop(second);
        assert_eq!(usable(8), 8);
    }

    #[test]
    fn every_task_runs_once() {
        for threads in [0, 1, 2, 3, 8, 33] {
            for tasks in [0, 1, 2, 3, 7, 100, 5000] {
                assert_eq!(
                    visits(threads, tasks),
                    vec![1; tasks],
                    "{threads} threads, {tasks} tasks"
                );
            }
        }
    }

    #[test]
    fn many_short_loops_in_a_row() {
        for _ in 0..20_000 {
            assert_eq!(visits(2, 3), [1, 1, 1]);
        }
    }

    #[test]
    fn many_callers_at_once() {
        std::thread::scope(|scope| {
            for _ in 0..2 * SLOTS {
                scope.spawn(|| {
                    for _ in 0..200 {
                        assert_eq!(visits(3, 17), vec![1; 17]);
                    }
                });
            }
        });
    }

    #[test]
    fn a_loop_within_a_task_runs_on_its_thread() {
        parallel_for(2, 8, &|_| {
            let here = std::thread::current().id();
            parallel_for(2, 8, &|_| assert_eq!(std::thread::current().id(), here));
        });
    }

    #[test]
    fn a_panic_reaches_the_caller_after_all_tasks_and_the_pool_lives_on() {
        for threads in [2, 8] {
            let done = AtomicUsize::new(0);
            let outcome = catch_unwind(AssertUnwindSafe(|| {
                parallel_for(threads, 50, &|task| {
                    assert_ne!(task, 20, "this one fails");
                    done.fetch_add(1, Ordering::Relaxed);
                });
            }));
            let message = outcome.unwrap_err();
            assert!(
                message
                    .downcast_ref::<String>()
                    .unwrap()
                    .contains("this one fails")
            );
            assert_eq!(done.into_inner(), 49);
            assert_eq!(visits(threads, 50), vec![1; 50]);
        }
    }

    #[test]
    fn workers_that_slept_come_back() {
        for _ in 0..20 {
            std::thread::sleep(4 * SPIN);
            let threads = Mutex::new(std::collections::HashSet::new());
            let since = Instant::now();
            parallel_for(2, 2, &|_| {
                lock(&threads).insert(std::thread::current().id());
                // Neither of the two goes on before the other is there, so that a busy machine only makes this longer.
                while lock(&threads).len() < 2 && since.elapsed() < Duration::from_secs(20) {
                    std::thread::yield_now();
                }
            });
            assert_eq!(lock(&threads).len(), 2);
        }
    }
}
