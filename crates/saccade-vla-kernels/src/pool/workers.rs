//! The workers of a process: how they are told of jobs, help with them, and sleep.

use std::any::Any;
use std::hint::black_box;
use std::time::{Duration, Instant};

use super::place::{self, Place};
use super::slot::{Job, Slot};
use super::sync::{
    AtomicBool, AtomicU32, AtomicUsize, Condvar, Life, Mutex, Ordering, fence, lock, spin, wait,
};

/// Calls that can have workers at the same time. A call beyond them runs on its own thread only.
const SLOTS: usize = if cfg!(loom) { 1 } else { 8 };

/// How long a worker without work spins before it sleeps: about the longest pause between two loops of one forward pass.
/// Waking a sleeping thread costs some 5 us of the caller's time, and as much again until it runs.
const SPIN: Duration = Duration::from_micros(50);

/// The longest time that a caller spins for workers that are inside: a few hundredths of a scheduler's time slice.
const LONGEST_WAIT: Duration = Duration::from_micros(500);

/// Address space that must be free before a thread is started: more than the allocator keeps of what was freed before.
const THREAD_ROOM: usize = 80 << 20;

/// Whether a thread can be started. If the system grants a stack and little more, the standard library aborts the process
/// when the thread begins.
pub(crate) fn has_room_for_thread() -> bool {
    let mut memory = Vec::<u8>::new();
    let is_granted = memory.try_reserve_exact(THREAD_ROOM).is_ok();
    // A compiler may leave out memory that is not used, and then takes it for granted.
    black_box(&memory);
    is_granted
}

pub(super) struct Workers {
    /// Workers started.
    count: AtomicUsize,
    slots: [Slot; SLOTS],
    /// Grows with every job offered, so that a worker about to sleep sees that it should look again.
    offers: AtomicU32,
    sleepers: AtomicUsize,
    sleep_lock: Mutex<()>,
    wake: Condvar,
}

impl Workers {
    pub(super) fn new() -> Self {
        Self {
            count: AtomicUsize::new(0),
            slots: std::array::from_fn(|_| Slot::new()),
            offers: AtomicU32::new(0),
            sleepers: AtomicUsize::new(0),
            sleep_lock: Mutex::new(()),
            wake: Condvar::new(),
        }
    }

    /// Starts workers until there are `wanted`, or the system refuses one. Each begins with `prepare`.
    pub(super) fn start(&'static self, wanted: usize, prepare: fn()) {
        while self.count.load(Ordering::Relaxed) < wanted {
            let take = |count: usize| (count < wanted).then_some(count + 1);
            let Ok(index) = self.count.try_update(Ordering::Relaxed, Ordering::Relaxed, take) else {
                return;
            };
            let thread = std::thread::Builder::new().name(format!("saccade-{}", index + 1));
            let work = move || {
                prepare();
                self.work(|| false);
            };
            if !has_room_for_thread() || thread.spawn(work).is_err() {
                // The call uses the threads that there are; a later call tries again.
                self.count.fetch_sub(1, Ordering::Relaxed);
                return;
            }
        }
    }

    /// Helps with jobs until `is_over`, which is asked after every look at `offers`.
    pub(super) fn work(&self, is_over: impl Fn() -> bool) {
        let mut place = Place::new();
        loop {
            let seen = self.offers.load(Ordering::Acquire);
            if is_over() {
                return;
            }
            if self.help(&mut place) {
                continue;
            }
            if !spin(SPIN, || self.offers.load(Ordering::Relaxed) != seen) {
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

    /// Sleeps until there is another offer than the `seen` ones.
    fn sleep(&self, seen: u32) {
        let mut guard = lock(&self.sleep_lock);
        self.sleepers.fetch_add(1, Ordering::Relaxed);
        fence(Ordering::SeqCst);
        while self.offers.load(Ordering::Relaxed) == seen {
            guard = wait(&self.wake, guard);
        }
        self.sleepers.fetch_sub(1, Ordering::Relaxed);
    }

    /// Tells up to `wanted` workers that there is a new job.
    pub(super) fn notify(&self, wanted: usize) {
        self.offers.fetch_add(1, Ordering::Release);
        // A worker counts itself before it looks at `offers` for the last time, with a fence between: it sees this offer,
        // or is seen here.
        fence(Ordering::SeqCst);
        let sleepers = self.sleepers.load(Ordering::Relaxed);
        if sleepers == 0 {
            return;
        }
        // With the lock held, a worker between its last look and its sleep is not missed.
        let _guard = lock(&self.sleep_lock);
        if wanted >= sleepers {
            self.wake.notify_all();
        } else {
            (0..wanted).for_each(|_| self.wake.notify_one());
        }
    }

    /// Runs `f(task)` for every task, on the calling thread and up to `helpers` workers, unless `asks_to_stop` says no on
    /// the way or `stop` is set.
    ///
    /// # Errors
    /// What the first panicking task threw, once all others are done.
    pub(super) fn run(
        &self,
        helpers: usize,
        tasks: usize,
        f: &(dyn Fn(usize) + Sync),
        stop: Option<&AtomicBool>,
        asks_to_stop: impl Fn() -> bool,
    ) -> Result<(), Box<dyn Any + Send>> {
        let job = Job {
            f,
            tasks,
            next: AtomicUsize::new(0),
            threads: helpers + 1,
            processor: place::processor(),
            vacancies: AtomicUsize::new(helpers),
            stop,
            panic: Mutex::new(None),
            life: Life::begin(),
        };
        // The caller has no pace: it takes tasks to the end, whoever leaves.
        let take_tasks = || job.run(None, asks_to_stop);
        match self.slots.iter().find(|slot| slot.take()) {
            Some(slot) => slot.lend(&job, || {
                self.notify(helpers);
                let since = Instant::now();
                let taken = take_tasks();
                // A worker that runs ends its last task in about the time that ours took; one that does not has lost its
                // core.
                LONGEST_WAIT.min(SPIN + 2 * since.elapsed() / taken.max(1))
            }),
            None => _ = take_tasks(),
        }
        match lock(&job.panic).take() {
            None => Ok(()),
            Some(panic) => Err(panic),
        }
    }
}
