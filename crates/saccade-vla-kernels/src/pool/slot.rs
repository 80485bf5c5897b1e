//! One job, and the slot in which its caller offers it to workers.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use super::place::Place;
use super::sync::{
    AtomicBool, AtomicPtr, AtomicUsize, Condvar, Life, Mutex, Ordering, fence, lock, spin, wait,
};

/// One call of [`parallel_for`](crate::parallel_for), on the caller's stack.
pub(super) struct Job<'a> {
    pub f: &'a (dyn Fn(usize) + Sync),
    pub tasks: usize,
    pub next: AtomicUsize,
    pub threads: usize,
    /// The caller's, when it offered the job.
    pub processor: Option<usize>,
    /// Workers that may still join.
    pub vacancies: AtomicUsize,
    /// Set once no further task is to begin.
    pub stop: Option<&'a AtomicBool>,
    /// What the first panicking task threw.
    pub panic: Mutex<Option<Box<dyn Any + Send>>>,
    pub life: Life,
}

/// The last tasks of a job, for each of its threads: among them a worker asks whether it is worth taking another.
const LAST_TASKS: usize = 16;

impl Job<'_> {
    /// Takes tasks until none is left or `asks_to_stop` says so, and counts them. A task that panics counts as done; a
    /// question that panics, as the answer to stop. With a `pace`, it also ends once the job
    /// [`Self::ends_sooner_without`] this thread.
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
                .try_update(Ordering::Relaxed, Ordering::Relaxed, take)
                .ok();
        }
        let task = self.next.fetch_add(1, Ordering::Relaxed);
        (task < self.tasks).then_some(task)
    }

    /// Whether the others finish what is left before this thread finishes one task more, at the pace that all have had
    /// since it joined: it is on a slow core, or shares its core with another program.
    ///
    /// While this thread did `taken` tasks, each of the others did `by_others / others`. They finish what is left in the
    /// time of `1 + left / others` of their tasks, since the last one may have to wait for a thread that is free.
    fn ends_sooner_without(&self, pace: Pace, taken: usize, dealt: usize) -> bool {
        // Those that have joined, with the caller in place of this thread.
        let vacancies = self.vacancies.load(Ordering::Relaxed);
        let others = self.threads - 1 - vacancies.min(self.threads - 1);
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

    /// Takes a vacancy, if there is one and work is left.
    fn joins(&self) -> bool {
        let take = |vacancies: usize| vacancies.checked_sub(1);
        self.next.load(Ordering::Relaxed) < self.tasks
            && self
                .vacancies
                .try_update(Ordering::Relaxed, Ordering::Relaxed, take)
                .is_ok()
    }

    /// Joins as a worker, if there is room and work; returns whether it did.
    fn help(&self, place: &mut Place) -> bool {
        let joins = self.joins();
        if joins {
            place.apart_from(self.processor, self.threads);
            let pace = Pace {
                joined_at: self.next.load(Ordering::Relaxed),
            };
            self.run(Some(pace), || {
                self.stop.is_some_and(|stop| stop.load(Ordering::Relaxed))
            });
            // A worker that has left does not come back to a job that is nearly done, nor does another one.
            self.vacancies.store(0, Ordering::Relaxed);
        }
        self.life.used();
        joins
    }
}

/// What a worker compares its pace with.
#[derive(Clone, Copy)]
pub(super) struct Pace {
    /// Tasks that were dealt before it joined.
    pub joined_at: usize,
}

/// A place where a call offers its job. On cache lines of its own: a caller that waits looks at it all the time, and
/// another caller's workers write to the next one.
#[repr(align(64))]
pub(super) struct Slot {
    /// Null if the slot is free or closed.
    job: AtomicPtr<Job<'static>>,
    /// Whether a caller owns the slot.
    taken: AtomicBool,
    /// Workers that are looking at the job, or running it.
    inside: AtomicUsize,
    /// Whether the caller sleeps until nobody is inside.
    caller_sleeps: AtomicBool,
    sleep_lock: Mutex<()>,
    wake: Condvar,
}

impl Slot {
    pub(super) fn new() -> Self {
        Self {
            job: AtomicPtr::new(std::ptr::null_mut()),
            taken: AtomicBool::new(false),
            inside: AtomicUsize::new(0),
            caller_sleeps: AtomicBool::new(false),
            sleep_lock: Mutex::new(()),
            wake: Condvar::new(),
        }
    }

    /// Makes the caller the owner, unless there is one.
    pub(super) fn take(&self) -> bool {
        !self.taken.swap(true, Ordering::Acquire)
    }

    /// Lets workers join the job while `during` runs. Then waits for those inside, with the patience that `during`
    /// returns, and gives the slot up. For the owner.
    pub(super) fn lend(&self, job: &Job<'_>, during: impl FnOnce() -> Duration) {
        /// Closes the slot also on panic: the job must not end before.
        struct Lent<'a>(&'a Slot, Duration);

        impl Drop for Lent<'_> {
            fn drop(&mut self) {
                self.0.close(self.1);
            }
        }

        let job: *const Job<'_> = job;
        self.job.store(job.cast_mut().cast(), Ordering::Release);
        let mut lent = Lent(self, Duration::ZERO);
        lent.1 = during();
    }

    /// Joins the job in this slot, if there is one with work and a vacancy.
    pub(super) fn help(&self, place: &mut Place) -> bool {
        if self.job.load(Ordering::Relaxed).is_null() {
            return false;
        }
        // Entering comes before reading the pointer here, and clearing the pointer before reading `inside` in `close`,
        // each with a fence between. So either this thread sees null, or the caller sees this thread and waits.
        self.inside.fetch_add(1, Ordering::AcqRel);
        fence(Ordering::SeqCst);
        let job = self.job.load(Ordering::Acquire);
        // SAFETY: null, or a job that is borrowed by `lend`, which does not return before it has seen `inside` zero.
        let helped = unsafe { job.as_ref() }.is_some_and(|job| job.help(place));
        // Everything that this thread wrote is visible to the caller that reads zero. Leaving comes before looking
        // whether the caller sleeps, and it says so before it looks who is inside, each with a fence between: it sees
        // this thread gone, or is seen asleep.
        if self.inside.fetch_sub(1, Ordering::AcqRel) == 1 {
            fence(Ordering::SeqCst);
            if self.caller_sleeps.load(Ordering::Relaxed) {
                // With the lock held, a caller between its last look and its sleep is not missed. The slot is part of
                // the pool and outlives the job; at worst this wakes the next caller, who looks and sleeps again.
                let _guard = lock(&self.sleep_lock);
                self.wake.notify_one();
            }
        }
        helped
    }

    /// Closes the slot to workers, waits for those inside and gives it up: spins for `patience`, then sleeps. Afterwards
    /// nobody knows the job but its caller.
    fn close(&self, patience: Duration) {
        self.job.store(std::ptr::null_mut(), Ordering::Relaxed);
        fence(Ordering::SeqCst);
        // A worker that comes later finds no job, so nobody inside once is enough.
        let is_empty = || self.inside.load(Ordering::Acquire) == 0;
        if !spin(patience, is_empty) {
            let mut guard = lock(&self.sleep_lock);
            self.caller_sleeps.store(true, Ordering::Relaxed);
            fence(Ordering::SeqCst);
            while !is_empty() {
                guard = wait(&self.wake, guard);
            }
            self.caller_sleeps.store(false, Ordering::Relaxed);
        }
        self.taken.store(false, Ordering::Release);
    }
}
