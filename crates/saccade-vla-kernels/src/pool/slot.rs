//! One job, and the slot in which its caller offers it to workers.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicPtr, AtomicUsize, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::place::Place;

/// One call of [`parallel_for`](crate::parallel_for), on the caller's stack.
pub(super) struct Job<'a> {
    pub f: &'a (dyn Fn(usize) + Sync),
    pub tasks: usize,
    pub next: AtomicUsize,
    pub threads: usize,
    /// The caller's, when it offered the job.
    pub processor: Option<usize>,
    /// Workers that may still join.
    pub seats: AtomicUsize,
    /// Set once no further task is to begin.
    pub stop: Option<&'a AtomicBool>,
    /// What the first panicking task threw.
    pub panic: Mutex<Option<Box<dyn Any + Send>>>,
}

/// The last tasks of a job, for each of its threads: among them a worker asks whether it is worth taking another.
const LAST_TASKS: usize = 16;

impl Job<'_> {
    /// Takes tasks until none is left or `asks_to_stop` says so, and counts them. A task that panics counts as done; a question that
    /// panics, as the answer to stop. With a `pace` until [`Self::ends_sooner_without`] the thread, too.
    pub(super) fn run(&self, pace: Option<Pace>, asks_to_stop: impl Fn() -> bool) -> u32 {
        let mut taken = 0_u32;
        loop {
            let stop = catch_unwind(AssertUnwindSafe(&asks_to_stop)).unwrap_or_else(|panic| {
                self.keep(panic);
                true
            });
            if stop {
                return taken;
            }
            let Some(task) = self.deal(pace, taken) else {
                return taken;
            };
            taken = taken.saturating_add(1);
            if let Err(panic) = catch_unwind(AssertUnwindSafe(|| (self.f)(task))) {
                self.keep(panic);
            }
        }
    }

    /// The next task, if there is one for a thread that has `taken` some.
    fn deal(&self, pace: Option<Pace>, taken: u32) -> Option<usize> {
        let is_near_end =
            self.tasks.saturating_sub(self.next.load(Ordering::Relaxed)) < LAST_TASKS * self.threads;
        if let Some(pace) = pace.filter(|_| is_near_end) {
            let taken = usize::try_from(taken).unwrap_or(usize::MAX);
            let take = |dealt| {
                (dealt < self.tasks && !self.ends_sooner_without(pace, taken, dealt)).then_some(dealt + 1)
            };
            return self
                .next
                .fetch_update(Ordering::Relaxed, Ordering::Relaxed, take)
                .ok();
        }
        let task = self.next.fetch_add(1, Ordering::Relaxed);
        (task < self.tasks).then_some(task)
    }

    /// Whether the others finish what is left before this thread finishes one task more, at the pace that all have had since it joined: it is
    /// on a slow core, or shares its core with another program.
    ///
    /// While this thread did `taken` tasks, each of the others did `by_others / others`. They finish what is left in the time of
    /// `1 + left / others` of their tasks, since the last one may have to wait for a thread that is free.
    fn ends_sooner_without(&self, pace: Pace, taken: usize, dealt: usize) -> bool {
        // Those that have joined, with the caller in place of this thread.
        let others = self.threads - 1 - self.seats.load(Ordering::Relaxed).min(self.threads - 1);
        let left = self.tasks - dealt;
        // Tasks that they have begun but may not have done count for nothing.
        let by_others = dealt.saturating_sub(pace.joined_at + taken + others);
        taken > 0 && by_others > taken.saturating_mul(others + left)
    }

    /// Keeps the first panic for the caller.
    fn keep(&self, panic: Box<dyn Any + Send>) {
        let mut first = lock(&self.panic);
        // A later one is forgotten, not dropped: dropping runs code of its thrower, which may panic again.
        if first.is_none() {
            *first = Some(panic);
        } else {
            std::mem::forget(panic);
        }
    }

    fn is_exhausted(&self) -> bool {
        self.next.load(Ordering::Relaxed) >= self.tasks
    }
}

/// What a worker compares its pace with.
#[derive(Clone, Copy)]
pub(super) struct Pace {
    /// Tasks that were dealt before it joined.
    pub joined_at: usize,
}

/// A place where a call offers its job. On cache lines of its own: a caller that waits looks at it all the time, and another caller's workers
/// write to the next one.
#[repr(align(64))]
pub(super) struct Slot {
    /// Null if the slot is free or closed.
    pub job: AtomicPtr<Job<'static>>,
    /// Whether a caller owns the slot.
    pub taken: AtomicBool,
    /// Workers that are looking at the job, or running it.
    inside: AtomicUsize,
    /// Whether the caller sleeps until nobody is inside.
    caller_sleeps: AtomicBool,
    bed: Mutex<()>,
    wake: Condvar,
}

impl Slot {
    pub(super) const fn new() -> Self {
        Self {
            job: AtomicPtr::new(std::ptr::null_mut()),
            taken: AtomicBool::new(false),
            inside: AtomicUsize::new(0),
            caller_sleeps: AtomicBool::new(false),
            bed: Mutex::new(()),
            wake: Condvar::new(),
        }
    }

    /// Joins the job in this slot, if there is one with work and a seat.
    pub(super) fn help(&self, place: &mut Place) -> bool {
        if self.job.load(Ordering::Relaxed).is_null() {
            return false;
        }
        // Entering comes before reading the pointer, and the caller clears the pointer before it reads `inside`; both sequentially
        // consistent. So either this thread sees null, or the caller sees this thread and waits.
        self.inside.fetch_add(1, Ordering::SeqCst);
        let job = self.job.load(Ordering::SeqCst);
        let mut helped = false;
        // SAFETY: non-null after entering: the caller will not leave, nor end the job's life, before `inside` is zero again.
        if let Some(job) = unsafe { job.as_ref() } {
            let take = |seats: usize| seats.checked_sub(1);
            if !job.is_exhausted()
                && job
                    .seats
                    .fetch_update(Ordering::Relaxed, Ordering::Relaxed, take)
                    .is_ok()
            {
                place.apart_from(job.processor, job.threads);
                let pace = Pace {
                    joined_at: job.next.load(Ordering::Relaxed),
                };
                job.run(Some(pace), || {
                    job.stop.is_some_and(|stop| stop.load(Ordering::Relaxed))
                });
                // A worker that has left does not come back to a job that is nearly done, nor does another one.
                job.seats.store(0, Ordering::Relaxed);
                helped = true;
            }
        }
        // Everything that this thread wrote is visible to the caller that reads zero. Leaving comes before looking whether the caller sleeps,
        // and it says so before it looks who is inside, all sequentially consistent: it sees this thread gone, or is seen asleep.
        if self.inside.fetch_sub(1, Ordering::SeqCst) == 1 && self.caller_sleeps.load(Ordering::SeqCst) {
            // With the lock held, a caller between its last look and its sleep is not missed. The slot is part of the pool and outlives the
            // job; at worst this wakes the next caller, who looks and sleeps again.
            let _bed = lock(&self.bed);
            self.wake.notify_one();
        }
        helped
    }

    /// Waits until nobody is inside: spins for `patience`, then sleeps.
    pub(super) fn wait_until_empty(&self, patience: Duration) {
        let is_empty = || self.inside.load(Ordering::SeqCst) == 0;
        let since = Instant::now();
        loop {
            // A worker that comes later finds no job, so nobody inside once is enough.
            if spin_until(is_empty) {
                return;
            }
            if since.elapsed() >= patience {
                break;
            }
        }
        let mut bed = lock(&self.bed);
        self.caller_sleeps.store(true, Ordering::SeqCst);
        while !is_empty() {
            bed = self.wake.wait(bed).unwrap_or_else(PoisonError::into_inner);
        }
        self.caller_sleeps.store(false, Ordering::SeqCst);
    }
}

/// The lock, whether or not a thread has panicked while it held it.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// At most 32 turns, or until `is_over()`; returns whether it is. Reading the clock costs a few turns, so callers read it only in between.
/// Looking once in 32 turns instead finds work up to 0.6 us late (Zen 4); the loops of a small head take about 10 us.
pub(super) fn spin_until(is_over: impl Fn() -> bool) -> bool {
    (0..32).any(|_| {
        is_over() || {
            std::hint::spin_loop();
            false
        }
    })
}
