//! Models of the pool for loom, which runs them in every order of threads, and with every value that memory may show them,
//! up to some preemptions. `make loom` runs them.
//!
//! A model fails where a thread waits for ever, and where a job is used after its caller has gone on ([`Life`]). Counts are
//! relaxed, so that a caller that is not synchronised with its workers sees too few.
//!
//! [`Life`]: super::sync::Life

use std::panic::resume_unwind;

use loom::sync::Arc;
use loom::thread::{JoinHandle, spawn};

use super::sync::{AtomicBool, AtomicUsize, Ordering::Relaxed};
use super::workers::Workers;

fn check(preemptions: usize, model: impl Fn() + Send + Sync + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(preemptions);
    builder.check(model);
}

/// A pool with some workers that run.
struct Pool {
    workers: Arc<Workers>,
    over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Pool {
    fn new(count: usize) -> Self {
        let (workers, over) = (Arc::new(Workers::new()), Arc::new(AtomicBool::new(false)));
        let worker = |_| {
            let (workers, over) = (workers.clone(), over.clone());
            spawn(move || workers.work(|| over.load(Relaxed)))
        };
        let threads = (0..count).map(worker).collect();
        Self {
            workers,
            over,
            threads,
        }
    }

    /// Ends the workers, which may be asleep: loom reports them if they do not wake.
    fn end(self) {
        self.over.store(true, Relaxed);
        self.workers.notify(self.threads.len());
        for thread in self.threads {
            thread.join().unwrap();
        }
    }
}

/// A loop of two tasks, each of which must have run once when it ends.
fn run_both(workers: &Workers) {
    let visits = [AtomicUsize::new(0), AtomicUsize::new(0)];
    let task = |task: usize| _ = visits[task].fetch_add(1, Relaxed);
    assert!(workers.run(1, 2, &task, None, || false).is_ok());
    assert_eq!(visits.map(|visits| visits.load(Relaxed)), [1, 1]);
}

#[test]
fn every_task_runs_once_before_the_loop_ends() {
    check(3, || {
        let pool = Pool::new(1);
        run_both(&pool.workers);
        pool.end();
    });
}

/// The worker may be at the first loop, asleep, or on its way there when the second one is offered in the same slot.
#[test]
fn a_worker_that_sleeps_or_lags_behind_does_no_harm_to_the_next_loop() {
    check(2, || {
        let pool = Pool::new(1);
        run_both(&pool.workers);
        run_both(&pool.workers);
        pool.end();
    });
}

#[test]
fn one_of_two_workers_is_woken() {
    check(1, || {
        let pool = Pool::new(2);
        run_both(&pool.workers);
        pool.end();
    });
}

/// No worker ever begins: a caller that waited for one would wait for ever.
#[test]
fn a_caller_does_not_wait_for_a_worker_that_has_not_begun() {
    check(3, || run_both(&Workers::new()));
}

/// There is one slot: the second caller comes to it before, while or after the first one has it.
#[test]
fn callers_at_the_same_time_get_their_own_results() {
    check(2, || {
        let pool = Pool::new(1);
        let workers = pool.workers.clone();
        let other = spawn(move || run_both(&workers));
        run_both(&pool.workers);
        other.join().unwrap();
        pool.end();
    });
}

#[test]
fn a_loop_within_a_task_ends() {
    check(2, || {
        let pool = Pool::new(1);
        let ran = AtomicUsize::new(0);
        let inner = |_| _ = ran.fetch_add(1, Relaxed);
        let outer = |_| assert!(pool.workers.run(1, 2, &inner, None, || false).is_ok());
        assert!(pool.workers.run(1, 2, &outer, None, || false).is_ok());
        assert_eq!(ran.load(Relaxed), 4);
        pool.end();
    });
}

#[test]
fn no_task_begins_after_an_interrupted_loop() {
    check(2, || {
        let pool = Pool::new(1);
        let (stop, ended, ran) = (
            AtomicBool::new(false),
            AtomicBool::new(false),
            AtomicUsize::new(0),
        );
        let task = |_| {
            assert!(!ended.load(Relaxed));
            ran.fetch_add(1, Relaxed);
        };
        // The caller is asked before each of its tasks: the second time it says yes.
        let asks_to_stop = || {
            let stops = ran.load(Relaxed) > 0;
            stop.store(stops, Relaxed);
            stops
        };
        assert!(pool.workers.run(1, 3, &task, Some(&stop), asks_to_stop).is_ok());
        ended.store(true, Relaxed);
        assert!((1..=3).contains(&ran.load(Relaxed)));
        pool.end();
    });
}

#[test]
fn a_panic_reaches_the_caller_after_the_other_tasks() {
    check(2, || {
        let pool = Pool::new(1);
        let ran = AtomicUsize::new(0);
        let task = |task| {
            if task == 0 {
                resume_unwind(Box::new("of the first task"));
            }
            ran.fetch_add(1, Relaxed);
        };
        let panic = pool.workers.run(1, 2, &task, None, || false).unwrap_err();
        assert_eq!(panic.downcast_ref(), Some(&"of the first task"));
        assert_eq!(ran.load(Relaxed), 1);
        pool.end();
    });
}
